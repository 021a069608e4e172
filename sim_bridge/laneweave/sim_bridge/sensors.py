"""What a vehicle's sensors make of the truth: every measurement with an error of its own.

Errors are normally distributed, independent of each other and of those before (`sensing` of the
scenario), and drawn from the scenario's seed and the vehicle's name: equal seeds, equal runs.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np

from laneweave.protocol.messages import Name, Neighbour
from laneweave.protocol.motion import State
from laneweave.protocol.scenario import Scenario
from laneweave.sim_bridge.overlap import Around, Pose, neighbours


class Sensors:
    """The sensors of one vehicle."""

    def __init__(self, scenario: Scenario, vehicle: Name) -> None:
        """Prepare the errors of a vehicle."""
        noise = scenario.sensing
        self._random = np.random.default_rng([scenario.seed, zlib.crc32(vehicle.encode())])
        self._state_noise = np.array(
            [
                noise.position_noise_m,
                noise.speed_noise_mps,
                noise.accel_noise_mps2,
                noise.lateral_noise_m,
                noise.speed_noise_mps,
                noise.accel_noise_mps2,
            ]
        )
        self._other_noise = np.array(
            [noise.gap_noise_m, noise.other_speed_noise_mps, noise.other_accel_noise_mps2]
        )

    def measure(self, state: State) -> State:
        """Return what the vehicle takes for its state (s, v, a, y, v_y, a_y), in m and s."""
        errors = (self._random.standard_normal(6) * self._state_noise).tolist()
        s, v, a, y, v_y, a_y = (true + error for true, error in zip(state, errors, strict=True))
        return s, max(v, 0.0), a, y, v_y, a_y

    def look(self, around: Around) -> Around:
        """Return what the vehicle sees of those around it."""
        return Around(self._seen(around.ahead), self._seen(around.behind))

    def _seen(self, others: tuple[Neighbour, ...]) -> tuple[Neighbour, ...]:
        if not others:
            return ()
        errors = (self._random.standard_normal((len(others), 3)) * self._other_noise).tolist()
        return tuple(
            Neighbour(
                other.lane,
                other.gap_m + gap_m,
                max(other.speed_mps + speed_mps, 0.0),
                other.accel_mps2 + accel_mps2,
            )
            for other, (gap_m, speed_mps, accel_mps2) in zip(others, errors, strict=True)
        )


def who_is_around(
    scenario: Scenario, poses: Mapping[str, Pose], accels_mps2: Mapping[str, float]
) -> dict[str, Around]:
    """Return whom each vehicle would see if its sensors were exact.

    Args:
        scenario: size of vehicles and lanes.
        poses: of all vehicles on the road.
        accels_mps2: their accelerations along the road.
    """
    road, vehicle = scenario.road, scenario.vehicle
    return neighbours(
        poses,
        lanes=road.lanes,
        lane_width_m=road.lane_width_m,
        length_m=vehicle.length_m,
        width_m=vehicle.width_m,
        accels_mps2=accels_mps2,
    )
