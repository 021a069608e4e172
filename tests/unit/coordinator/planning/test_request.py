"""Reading requests: errors name the field, the value and the allowed values."""

import json
import math
from collections.abc import Callable
from typing import Any

import attrs
import pytest
from hypothesis import given

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import block_request
from laneweave.protocol.errors import BadInputError
from support.planning_oracles import requests
from support.tables import for_each

Document = dict[str, Any]


def document() -> Document:
    """Return the example of the interface."""
    return {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 8, "lanes": 3, "blocked": [[0, 2]]},
        "mode": 1,
        "conflicts": ["node", "edge", "special-1"],
        "vehicles": [
            {"id": "v1", "cell": [2, 0], "lane": 1},
            {"id": "v2", "cell": [3, 1], "eligible": [0, 2]},
        ],
        "targets": [[2, 1], [3, 1], [4, 0]],
        "deadline_s": 4.0,
    }


def test_the_example() -> None:
    request = PlanRequest.from_dict(document())
    assert request.grid == Grid(8, 3, [(0, 2)])
    assert request.vehicles[0] == VehicleRequest("v1", (2, 0), lane=1)
    assert request.vehicles[1] == VehicleRequest("v2", (3, 1), eligible=(0, 2))
    assert request.choices() == [{0, 1}, {0, 2}]
    assert request.to_dict() == document()


def test_defaults() -> None:
    short = document()
    for key in ("mode", "conflicts", "deadline_s"):
        del short[key]
    del short["grid"]["blocked"]
    request = PlanRequest.from_dict(short)
    assert (request.mode, request.deadline_s) == (1, 4.0)
    assert request.conflicts == ("node", "edge", "special-1")
    assert PlanRequest.from_dict({**short, "mode": 2}).conflicts == ("geometric",)
    assert PlanRequest.from_dict({**short, "deadline_s": 2}).deadline_s == 2.0


def _set(*path: str | int, to: object = None, drop: bool = False) -> Callable[[Document], None]:
    def change(target: Any) -> None:  # noqa: ANN401
        for key in path[:-1]:
            target = target[key]
        if drop:
            del target[path[-1]]
        else:
            target[path[-1]] = to

    return change


def _drop(*path: str | int) -> Callable[[Document], None]:
    return _set(*path, drop=True)


WRONG: list[tuple[Callable[[Document], None], str]] = [
    (_drop("schema"), "schema"),
    (_set("schema", to="laneweave.plan.request/2"), "schema"),
    (_set("speed", to=3), "speed"),
    (_drop("grid"), "grid"),
    (_set("grid", to=[8, 3]), "grid"),
    (_set("grid", "rows", to=3), "grid.rows"),
    (_drop("grid", "columns"), "grid.columns"),
    (_set("grid", "columns", to=0), "grid.columns"),
    (_set("grid", "columns", to=1001), "grid.columns"),
    (_set("grid", "columns", to=8.0), "grid.columns"),
    (_set("grid", "columns", to=True), "grid.columns"),
    (_set("grid", "columns", to="8"), "grid.columns"),
    (_set("grid", "lanes", to=17), "grid.lanes"),
    (_set("grid", "blocked", to=[[8, 0]]), "grid.blocked[0]"),
    (_set("grid", "blocked", to=[[0, 2], [0, 2]]), "grid.blocked[1]"),
    (_set("grid", "blocked", to=[[0]]), "grid.blocked[0]"),
    (_set("grid", "blocked", to=None), "grid.blocked"),
    (_set("mode", to=3), "mode"),
    (_set("mode", to=True), "mode"),
    (_set("mode", to="1"), "mode"),
    (_set("conflicts", to="node"), "conflicts"),
    (_set("conflicts", to=["node", "special-5"]), "conflicts[1]"),
    (_set("conflicts", to=["node", "node"]), "conflicts[1]"),
    (_set("conflicts", to=[1]), "conflicts[0]"),
    (_drop("vehicles"), "vehicles"),
    (_set("vehicles", to=[]), "vehicles"),
    (_set("vehicles", to={}), "vehicles"),
    (_set("vehicles", to=[{"id": str(i), "cell": [0, 0]} for i in range(201)]), "vehicles"),
    (_set("vehicles", 0, to="v1"), "vehicles[0]"),
    (_set("vehicles", 1, "speed", to=3), "vehicles[1].speed"),
    (_drop("vehicles", 0, "id"), "vehicles[0].id"),
    (_set("vehicles", 0, "id", to=1), "vehicles[0].id"),
    (_set("vehicles", 0, "id", to=""), "vehicles[0].id"),
    (_set("vehicles", 1, "id", to="v1"), "vehicles[1].id"),
    (_drop("vehicles", 1, "cell"), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[2, 0]), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[0, 2]), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[8, 0]), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[-1, 0]), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[1, 1, 1]), "vehicles[1].cell"),
    (_set("vehicles", 1, "cell", to=[1.0, 1]), "vehicles[1].cell[0]"),
    (_set("vehicles", 1, "cell", to=[True, 1]), "vehicles[1].cell[0]"),
    (_set("vehicles", 0, "lane", to=3), "vehicles[0].lane"),
    (_set("vehicles", 0, "lane", to=None), "vehicles[0].lane"),
    (_set("vehicles", 0, "eligible", to=[0]), "vehicles[0].eligible"),
    (_set("vehicles", 1, "lane", to=1), "vehicles[1].eligible"),
    (_set("vehicles", 1, "eligible", to=[0, 3]), "vehicles[1].eligible[1]"),
    (_set("vehicles", 1, "eligible", to=[0, 0]), "vehicles[1].eligible[1]"),
    (_set("vehicles", 1, "eligible", to=[False]), "vehicles[1].eligible[0]"),
    (_set("vehicles", 1, "eligible", to=0), "vehicles[1].eligible"),
    (_set("vehicles", 1, "moves", to=[[0, 1], [1, 1]]), "vehicles[1].moves[1]"),
    (_set("vehicles", 1, "moves", to=[[0, 1], [0, 1]]), "vehicles[1].moves[1]"),
    (_set("vehicles", 1, "moves", to=[[0, 0]]), "vehicles[1].moves[0]"),
    (_set("vehicles", 1, "moves", to="lanes"), "vehicles[1].moves"),
    (_drop("targets"), "targets"),
    (_set("targets", to=[]), "targets"),
    (_set("targets", to=[[c, 0] for c in range(401)]), "targets"),
    (_set("targets", 2, to=[2, 1]), "targets[2]"),
    (_set("targets", 2, to=[0, 2]), "targets[2]"),
    (_set("targets", 2, to=[4, 3]), "targets[2]"),
    (_set("targets", 2, to="4,0"), "targets[2]"),
    (_set("deadline_s", to=0), "deadline_s"),
    (_set("deadline_s", to=-1.0), "deadline_s"),
    (_set("deadline_s", to=3600.5), "deadline_s"),
    (_set("deadline_s", to=10**400), "deadline_s"),
    (_set("deadline_s", to=math.inf), "deadline_s"),
    (_set("deadline_s", to=math.nan), "deadline_s"),
    (_set("deadline_s", to=True), "deadline_s"),
    (_set("deadline_s", to="4"), "deadline_s"),
    (_set("deadline_s", to=None), "deadline_s"),
]


@for_each(("change", "field"), WRONG)
def test_errors_name_the_wrong_field(change: Callable[[Document], None], field: str) -> None:
    wrong = document()
    change(wrong)
    with pytest.raises(BadInputError) as caught:
        PlanRequest.from_dict(wrong)
    assert caught.value.field == field
    message = str(caught.value)
    assert message.startswith(f"{field}: got ")
    assert "allowed: " in message
    assert "\n" not in message


def test_all_errors_of_a_request_are_reported_at_once() -> None:
    wrong = document()
    for change in (
        _set("conflict", to=["node"]),
        _set("grid", "blocked", to=[[0, 2], [9, 9]]),
        _set("vehicles", 0, "id", to="\x1b[2J"),
        _set("vehicles", 0, "lane", to=7),
        _set("vehicles", 1, "cell", to=[-1, 0]),
        _set("targets", 2, to=[4, 3]),
        _set("solver", to="ta pa"),
        _set("deadline_s", to=-1),
        _set("id", to="a\nb"),
    ):
        change(wrong)
    with pytest.raises(BadInputError) as caught:
        PlanRequest.from_dict(wrong)
    problems = {one.field: one for one in caught.value.problems}
    assert set(problems) == {
        "conflict",
        "grid.blocked[1]",
        "vehicles[0].id",
        "vehicles[0].lane",
        "vehicles[1].cell",
        "targets[2]",
        "solver",
        "deadline_s",
        "id",
    }
    assert problems["conflict"].suggestion == "conflicts"


def test_a_request_is_examined_up_to_a_number_of_errors() -> None:
    for changes in (
        {f"key{number:05}": 1 for number in range(5000)},
        {"targets": [None] * 5000},
        {"grid": {"columns": 4, "lanes": 2, "blocked": [[9, 9]] * 5000}},
        {"conflicts": [f"kind {number}" for number in range(5000)]},
    ):
        with pytest.raises(BadInputError) as caught:
            PlanRequest.from_dict(document() | changes)
        assert 100 <= len(caught.value.problems) <= 205


@pytest.mark.parametrize("text", ["a\nb", "\x00", "\x7f", "\u2028", "\u202e", "\ud800"])
def test_ids_are_printable(text: str) -> None:
    for change, field in (
        (_set("id", to=text), "id"),
        (_set("vehicles", 0, "id", to=text), "vehicles[0].id"),
    ):
        wrong = document()
        change(wrong)
        with pytest.raises(BadInputError, match="allowed: printable characters") as caught:
            PlanRequest.from_dict(wrong)
        assert caught.value.field == field


@pytest.mark.parametrize("value", [None, [], "request", 1, True])
def test_a_request_is_an_object(value: object) -> None:
    with pytest.raises(BadInputError):
        PlanRequest.from_dict(value)


def test_requests_made_in_code_are_checked_too() -> None:
    request = block_request(0)
    with pytest.raises(BadInputError) as caught:
        attrs.evolve(request, targets=(*request.targets, request.targets[0]))
    assert caught.value.field == "targets[6]"
    with pytest.raises(BadInputError):
        attrs.evolve(request, deadline_s=0.0)
    with pytest.raises(BadInputError):
        attrs.evolve(request, conflicts=("nodes",))


@given(requests())
def test_json_round_trip(request: PlanRequest) -> None:
    assert PlanRequest.from_dict(json.loads(json.dumps(request.to_dict()))) == request


class TestResponse:
    def test_json_round_trip(self) -> None:
        for seed in range(3):
            response = plan(block_request(seed, deadline_s=60.0))
            assert PlanResponse.from_dict(json.loads(json.dumps(response.to_dict()))) == response

    def test_without_a_plan(self) -> None:
        response = plan(block_request(25), max_nodes=0)
        written = json.loads(json.dumps(response.to_dict()))
        assert written["status"] == "timeout"
        assert written["cost"] is written["steps"] is None
        assert written["paths"] == written["assignment"] == []
        assert PlanResponse.from_dict(written) == response

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("schema", "laneweave.plan.request/1"),
            ("status", "good"),
            ("cost", -1),
            ("cost", True),
            ("solve_ms", "1"),
            ("assignment", [1.5]),
            ("paths", [[[0]]]),
        ],
    )
    def test_errors_name_the_wrong_field(self, field: str, value: object) -> None:
        wrong = {**plan(block_request(0)).to_dict(), field: value}
        with pytest.raises(BadInputError) as caught:
            PlanResponse.from_dict(wrong)
        assert caught.value.field.startswith(field)
