"""A vehicle's sensors, with independent normally distributed measurement errors.

The errors (table `sensing` of the scenario) are seeded with the scenario's seed and the vehicle's
name, so the same seed gives the same run.
"""

from __future__ import annotations

import zlib

import numpy as np

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Name, Neighbour
from laneweave.sim_bridge.bodies.overlaps_and_gaps import ExactNeighbours, Neighbours

_DRAWN = 1024
"""Number of random numbers drawn at once."""


class Sensors:
    """The sensors of one vehicle."""

    def __init__(self, scenario: Scenario, vehicle: Name) -> None:
        """Create the sensors with a random generator seeded for the vehicle."""
        noise = scenario.sensing
        self._random = np.random.default_rng([scenario.seed, zlib.crc32(vehicle.encode())])
        self._normal: list[float] = []
        """Samples drawn in advance, because drawing single numbers is slow."""
        self._used = 0
        self._state_noise = (
            noise.position_noise_m,
            noise.speed_noise_mps,
            noise.accel_noise_mps2,
            noise.lateral_noise_m,
            noise.speed_noise_mps,
            noise.accel_noise_mps2,
        )
        self._other_noise = (
            noise.gap_noise_m,
            noise.other_speed_noise_mps,
            noise.other_accel_noise_mps2,
        )

    def measure(self, state: State) -> State:
        """Return the measurement of a state (s, v, a, y, v_y, a_y)."""
        s, v, a, y, v_y, a_y = state
        s_m, v_mps, a_mps2, y_m, vy_mps, ay_mps2 = self._state_noise
        e_s, e_v, e_a, e_y, e_vy, e_ay = self._draw(6)
        return (
            s + e_s * s_m,
            max(v + e_v * v_mps, 0.0),
            a + e_a * a_mps2,
            y + e_y * y_m,
            v_y + e_vy * vy_mps,
            a_y + e_ay * ay_mps2,
        )

    def measure_neighbours(self, neighbours: ExactNeighbours) -> Neighbours:
        """Return the measurement of all neighbours."""
        ahead, behind = neighbours
        sigma_m, sigma_mps, sigma_mps2 = self._other_noise
        errors = self._draw(3 * (len(ahead) + len(behind)))
        seen = []
        index = 0
        for lane, gap_m, speed_mps, accel_mps2 in (*ahead, *behind):
            speed = speed_mps + errors[index + 1] * sigma_mps
            if speed < 0.0:
                speed = 0.0
            seen.append(
                Neighbour(
                    lane,
                    gap_m + errors[index] * sigma_m,
                    speed,
                    accel_mps2 + errors[index + 2] * sigma_mps2,
                )
            )
            index += 3
        return Neighbours(tuple(seen[: len(ahead)]), tuple(seen[len(ahead) :]))

    def _draw(self, count: int) -> list[float]:
        """Return the next samples of the standard normal distribution."""
        first, self._used = self._used, self._used + count
        if self._used > len(self._normal):
            self._normal = self._normal[first:] + self._random.standard_normal(_DRAWN).tolist()
            first, self._used = 0, count
        return self._normal[first : self._used]
