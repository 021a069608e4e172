"""Actions that do not exist, the state of all agents, and pictures of the road."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from laneweave.env import parallel_env
from laneweave.env.observations import OWN
from laneweave.launch.drawing.colours import lane_colours
from laneweave.protocol.errors import BadInputError, SeveralBadInputsError
from support.environments import ROAD, TINY, same

WRONG: dict[str, Any] = {
    "None": None,
    "text": "x",
    "float": 1.0,
    "float of numpy": np.float32(1.0),
    "nan": math.nan,
    "negative": -1,
    "too large": 5,
    "list": [1],
    "array": np.array([1, 2]),
}


@pytest.mark.parametrize("action", [pytest.param(value, id=key) for key, value in WRONG.items()])
def test_actions_that_do_not_exist_are_refused_as_a_whole(action: Any) -> None:  # noqa: ANN401
    env, other = parallel_env(TINY), parallel_env(TINY)
    for one in (env, other):
        one.reset(seed=1)
        one.step({})
    first, *_, last = env.agents
    state = env.state()
    with pytest.raises(BadInputError, match="allowed: integers 0 to 4") as caught:
        env.step({first: 1, last: action})
    assert caught.value.field == f"actions[{last}]"
    assert caught.value.value is action
    assert "\n" not in str(caught.value)
    assert same(env.state(), state)
    # Nothing of the refused step is left.
    assert same(env.step({}), other.step({}))


def test_unknown_agents_and_several_errors() -> None:
    env = parallel_env(TINY)
    env.reset(seed=1)
    last = env.possible_agents[-1]
    with pytest.raises(BadInputError, match=f"got 'v000'; allowed: agents v0001 to {last}"):
        env.step({"v000": 0})
    with pytest.raises(BadInputError, match="got 7"):
        env.step({7: 0})  # type: ignore[dict-item]
    with pytest.raises(SeveralBadInputsError) as caught:
        env.step({"v0001": None, "v0002": "x", "y": 0})  # type: ignore[dict-item]
    assert len(caught.value.problems) == 3
    for actions in (None, [0, 1], "v0001"):
        with pytest.raises(BadInputError, match="allowed: a dict"):
            env.step(actions)  # type: ignore[arg-type]
    assert env.step({})[0]


def test_integers_of_all_kinds_and_agents_that_are_not_on_the_road() -> None:
    results = []
    for kind in (int, np.uint8, np.array):
        env = parallel_env(TINY)
        _, infos = env.reset(seed=1)
        for _ in range(2):
            actions: dict[str, Any] = {
                name: kind(np.flatnonzero(infos[name]["action_mask"])[-1]) for name in env.agents
            }
            # They have no effect: the vehicle has not entered yet.
            away = [name for name in env.possible_agents if name not in env.agents]
            *stepped, infos = env.step(actions | {away[-1]: kind(1)})
        results.append([*stepped, infos])
    assert all(same(one, results[0]) for one in results)


def test_the_state_has_a_row_for_each_possible_agent() -> None:
    env = parallel_env(TINY)
    with pytest.raises(RuntimeError, match="reset"):
        env.state()
    observations, _ = env.reset(seed=1)
    present = []
    while env.agents:
        state = env.state()
        assert state.shape == env.state_space.shape == (len(env.possible_agents), 1 + len(OWN))
        assert env.state_space.contains(state)
        on_road = [*env.agents]
        for row, name in zip(state, env.possible_agents, strict=True):
            assert row[0] == (name in on_road)
            own = observations[name][: len(OWN)] if name in on_road else np.zeros(len(OWN))
            assert row[1:].tolist() == own.tolist()
        for one in observations.values():
            one[:] = 0.0
        assert env.state().any()  # as before
        present.append(len(on_road))
        observations, *_ = env.step({})
    assert not env.state().any()
    assert max(present) > 3
    assert env.state() is not env.state()


def test_pictures_show_the_vehicles_in_their_colours() -> None:
    env = parallel_env(TINY, render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="reset"):
        env.render()
    env.reset(seed=1)
    env.step({})
    full = env.render()
    assert full is not None
    assert full.dtype == np.uint8
    assert full.ndim == 3
    assert full.shape[2] == 3
    assert full.min() < 100
    assert full.max() == 255
    wanted = {vehicle.arrival.preferred_lane for vehicle in env._running.vehicles.values()}
    colours = lane_colours(3)
    for lane in range(3):
        colour = np.round(np.array(to_rgb(colours[lane])) * 255)
        shown = (np.abs(full.astype(int) - colour).max(axis=2) <= 1).sum()
        assert (shown > 50) == (lane in wanted)
    while env.agents:
        env.step({})
    empty = env.render()
    assert empty is not None
    assert empty.shape == full.shape
    assert (empty != full).any()


@pytest.mark.more
def test_pictures_of_long_roads_and_roads_with_closed_parts() -> None:
    closed = {"s3_m": 300.0, "closures": [{"lane": 0, "from_m": 300.0, "to_m": 450.0}]}
    shapes = []
    for road in (ROAD | closed, ROAD | {"s3_m": 9000.0}):
        env = parallel_env({"road": road, "demand": TINY["demand"]}, render_mode="rgb_array")
        env.reset(seed=1)
        picture = env.render()
        assert picture is not None
        shapes.append(picture.shape)
    assert shapes[0][1] == shapes[1][1]
    assert all(height < 3000 for height, _, _ in shapes)


def test_render_modes() -> None:
    env = parallel_env(TINY)
    env.reset(seed=1)
    assert env.render() is None
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert env.render_mode is None
    assert parallel_env(TINY, render_mode="rgb_array").render_mode == "rgb_array"
    with pytest.raises(BadInputError, match="render_mode: got 'human'; allowed: one of rgb_array"):
        parallel_env(TINY, render_mode="human")
