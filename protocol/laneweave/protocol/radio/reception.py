"""Probability that a message arrives by sidelink, by distance and by how many vehicles send.

The published analytical models for vehicles that are evenly distributed along a road and send
periodically: C-V2X mode 4 [1] and IEEE 802.11p [2], both in a channel of 10 MHz at 5.9 GHz with the
path loss of WINNER+ B1 in line of sight and log-normal shadowing. A message is lost if

- the receiver sends at the same time (C-V2X), or is busy with another message (802.11p);
- its power is below the sensing threshold;
- it has errors, by noise and fading;
- it collides with a message of another vehicle.

The models give curves over the distance for one density of senders and one transmission power.
They were validated up to 0.3 vehicles/m (C-V2X) and 0.12 vehicles/m at 25 Hz (802.11p). Beyond
that, vehicles with C-V2X raise their sensing threshold by 3 dB until enough resources are left, as
in the standard (3GPP TS 36.213, 14.1.1.6), which [1] leaves out.

[1] M. Gonzalez-Martín, M. Sepulcre, R. Molina-Masegosa, J. Gozalvez, "Analytical Models of the
    Performance of C-V2X Mode 4 Vehicular Communications", IEEE Transactions on Vehicular
    Technology 68(2), 2019, arXiv:1807.06508. Four subchannels; messages of 190 bytes in 10 resource
    blocks; errors by the curve of 3GPP R1-160284.
[2] M. Sepulcre, M. Gonzalez-Martín, J. Gozalvez, R. Molina-Masegosa, B. Coll-Perales, "Analytical
    Models of the Performance of IEEE 802.11p Vehicle to Vehicle Communications", IEEE Transactions
    on Vehicular Technology 71(1), 2022, arXiv:2104.07923. 6 Mbit/s; errors by Figure 14 of
    O. Goubet et al., "Low-Complexity Scalable Iterative Algorithms for IEEE 802.11p Receivers",
    ibid. 64(9), 2015.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.protocol.scenario.radio_table import C_V2X, DSRC

Floats = NDArray[np.float64]

MESSAGE_BYTES = 190
"""Size of the messages in both models."""
DISTANCE_STEP_M = 10.0
DISTANCES_M: Floats = np.arange(0.0, 1000.0 + DISTANCE_STEP_M, DISTANCE_STEP_M)
"""Distances from sender to receiver at which a curve is computed."""
DENSITY_STEP_PER_KM = 10.0
"""Curves are computed for multiples of this density."""
MAX_DENSITY_PER_KM = 500.0

_SHADOWING_DB = 3.0
_POWER_STEP_DB = 0.25
_DEVIATIONS: Floats = np.linspace(-4.0, 4.0, 81)
_WEIGHTS: Floats = np.exp(-0.5 * _DEVIATIONS**2) / np.exp(-0.5 * _DEVIATIONS**2).sum()
_NEAREST_M = 3.0
"""The path loss of shorter distances is that of this one."""
_ANTENNA_M = 1.5
_MAX_INTERFERENCE_M = 1000
"""Distance up to which other senders disturb a receiver."""
_SENSED_M: Floats = np.arange(-1500.0, 1501.0)
"""Distances at which a radio may sense others, every metre."""
_NOISE_DBM = -95.0
"""Noise in 10 MHz, with a noise figure of 9 dB."""


@frozen
class Sidelink(ABC):
    """Messages between vehicles with one technology and transmission power."""

    carrier_ghz: ClassVar[float]
    surroundings_m: ClassVar[float]
    """Height of the surroundings, which reflect the signal."""
    sensing_dbm: ClassVar[float]
    """Smallest power that a radio detects as a message."""
    noise_dbm: ClassVar[float]
    """Noise in the bandwidth of a message."""
    errors: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]]
    """Ratio of signal to noise [dB], ascending, and share of messages with errors at this ratio."""

    power_dbm: float
    rate_hz: float
    """Number of messages per second of each vehicle."""

    @abstractmethod
    def _arrival(self, spacing_m: float) -> Floats:
        """Return the share that arrives at each of `DISTANCES_M`.

        `spacing_m` is the distance between neighbouring senders.
        """

    def arrival(self, density_per_km: float) -> Floats:
        """Return the share of messages that arrive at each of `DISTANCES_M`.

        `density_per_km` is the number of vehicles per km of road that send, at least one step.
        """
        density_per_km = min(max(density_per_km, DENSITY_STEP_PER_KM), MAX_DENSITY_PER_KM)
        return np.clip(self._arrival(1000.0 / density_per_km), 0.0, 1.0)

    def path_loss_db(self, distance_m: Floats) -> Floats:
        """Return the path loss by WINNER+ B1 in line of sight, at least that of free space."""
        distance_m = np.maximum(np.abs(distance_m), _NEAREST_M)
        height_m = _ANTENNA_M - self.surroundings_m
        break_m = 4.0 * height_m**2 * self.carrier_ghz * 1e9 / 3e8
        near = 22.7 * np.log10(distance_m) + 27.0 + 20.0 * np.log10(self.carrier_ghz)
        far = 40.0 * np.log10(distance_m) + 7.56 - 34.6 * np.log10(height_m)
        far += 2.7 * np.log10(self.carrier_ghz)
        free = 20.0 * np.log10(distance_m) + 46.4 + 20.0 * np.log10(self.carrier_ghz / 5.0)
        return np.asarray(np.maximum(np.where(distance_m < break_m, near, far), free))

    def sensed(self, distance_m: Floats, threshold_db: float = 0.0) -> Floats:
        """Return the probability that a radio senses another one.

        `threshold_db` raises the threshold.
        """
        from scipy.special import ndtr  # noqa: PLC0415 (not in a base install)

        margin_db = self.power_dbm - self.path_loss_db(distance_m) - self.sensing_dbm - threshold_db
        return np.asarray(ndtr(margin_db / _SHADOWING_DB), dtype=np.float64)

    @cached_property
    def _sensed_everywhere(self) -> Floats:
        return self.sensed(_SENSED_M)

    @cached_property
    def _sensing_overlap(self) -> Floats:
        """Share of what a radio senses that another one senses, too, by their distance [m]."""
        sensed = self._sensed_everywhere
        overlap = np.correlate(sensed, sensed, mode="full")[sensed.size - 1 :]
        return np.asarray(overlap / overlap[0])

    @cached_property
    def _errors_by_noise(self) -> Floats:
        """Share of sensed messages with errors when no other vehicle sends, by `DISTANCES_M`."""
        return self._errors_at(self.noise_dbm)[:, 0]

    @cached_property
    def _errors_by_interference(self) -> Floats:
        """Share of messages with errors only because another vehicle sends at the same time.

        Rows: `DISTANCES_M`; columns: distance of the other vehicle to the receiver, every metre.
        """
        mean_dbm = self.power_dbm - self.path_loss_db(np.arange(_MAX_INTERFERENCE_M + 1.0))
        others_dbm = mean_dbm[:, None] + _SHADOWING_DB * _DEVIATIONS
        total_dbm = 10.0 * np.log10(10.0 ** (others_dbm / 10.0) + 10.0 ** (self.noise_dbm / 10.0))
        levels_dbm = np.arange(self.noise_dbm, total_dbm.max() + _POWER_STEP_DB, _POWER_STEP_DB)
        index = np.rint((total_dbm - self.noise_dbm) / _POWER_STEP_DB).astype(int)
        shares = np.zeros((levels_dbm.size, mean_dbm.size))
        columns = np.broadcast_to(np.arange(mean_dbm.size)[:, None], index.shape)
        np.add.at(shares, (index, columns), _WEIGHTS)
        errors = self._errors_at(levels_dbm) @ shares
        alone = self._errors_by_noise[:, None]
        return np.divide(errors - alone, 1.0 - alone, out=np.zeros_like(errors), where=alone < 1.0)

    def _errors_at(self, disturbance_dbm: Floats | float) -> Floats:
        """Return the share of sensed messages with errors.

        Rows: `DISTANCES_M`; columns: power of noise and interference.
        """
        powers_dbm = np.arange(self.sensing_dbm, self.power_dbm + 15.0, _POWER_STEP_DB)
        mean_dbm = self.power_dbm - self.path_loss_db(DISTANCES_M)
        exponent = -0.5 * ((powers_dbm - mean_dbm[:, None]) / _SHADOWING_DB) ** 2
        density = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        density /= density.sum(axis=1, keepdims=True)
        ratio_db = powers_dbm[:, None] - np.atleast_1d(disturbance_dbm)
        return np.asarray(density @ np.interp(ratio_db, *self.errors), dtype=np.float64)

    def _others(self, spacing_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return where other vehicles are.

        Returns:
            Their distance to the receiver [m], and their distance to the sender, with a row for
            each of `DISTANCES_M`.
        """
        count = round(_MAX_INTERFERENCE_M / spacing_m)
        numbers = np.concatenate([np.arange(-count, 0), np.arange(1, count + 1)])
        to_receiver_m = numbers * spacing_m
        to_sender_m = to_receiver_m + DISTANCES_M[:, None]
        whole = np.minimum(np.rint(np.abs(to_receiver_m)), _MAX_INTERFERENCE_M)
        return whole.astype(int), np.rint(np.abs(to_sender_m)).astype(int)


@frozen
class CellularSidelink(Sidelink):
    """C-V2X mode 4: vehicles reserve resources by themselves, for several messages [1]."""

    carrier_ghz = 5.91
    surroundings_m = 0.0
    sensing_dbm = -90.5
    noise_dbm = _NOISE_DBM - 10.0 * float(np.log10(50.0 / 10.0))
    errors = (
        (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 20.000001),
        (1.0, 0.9, 0.7, 0.4, 0.13, 0.045, 0.017, 0.007, 0.001, 0.001, 0.0001),
    )
    subchannels: ClassVar[int] = 4
    _candidates: ClassVar[float] = 0.2
    """Share of the resources from which a vehicle draws."""

    def _arrival(self, spacing_m: float) -> Floats:
        """Apply equations (6) to (34) of [1]; see `Sidelink._arrival`."""
        resources = self.subchannels * 1000.0 / self.rate_hz
        excluded, raised_db = self._excluded(spacing_m, resources, 1.0, 3.0)
        busy = min(self._excluded(spacing_m, resources, 1.0, None)[0] / resources, 1.0)
        weight = min(max(2.0 * busy - 0.4, 0.0), 1.0)
        by_reservation = self._collisions(spacing_m, resources, excluded, raised_db)
        by_power = self._collisions(
            spacing_m, resources, *self._excluded(spacing_m, resources, 2.0, 0.1)
        )
        collided = weight * by_reservation + (1.0 - weight) * by_power
        sent = 1.0 - self.rate_hz / 1000.0
        heard = sent * self.sensed(DISTANCES_M) * (1.0 - self._errors_by_noise)
        return np.asarray(heard * (1.0 - collided))

    def _excluded(
        self, spacing_m: float, resources: float, factor: float, step_db: float | None
    ) -> tuple[float, float]:
        """Return how many resources a vehicle excludes, and by how much it raises its threshold.

        It raises the threshold by steps until enough resources are left; None: it does not.
        `factor` is 2 for the ranking by received power ([1], (33)), which counts both halves.
        """
        raised_db = 0.0
        while True:
            reserved = factor * self.sensed(_SENSED_M, raised_db).sum() / spacing_m / 2.0
            free = resources - reserved
            excluded = resources
            if free > 0.0:
                others = np.arange(1, int(reserved) + 1)
                excluded = reserved + np.maximum(1.0 - others / free, 0.0).sum()
            if step_db is None or resources - excluded >= self._candidates * resources:
                return float(excluded), raised_db
            raised_db += step_db

    def _collisions(
        self, spacing_m: float, resources: float, excluded: float, raised_db: float
    ) -> Floats:
        """Return the share of messages that collide, by `DISTANCES_M`; [1], (14) to (31)."""
        to_receiver, to_sender = self._others(spacing_m)
        candidates, available = self._candidates * resources, resources - excluded
        both = (
            self._sensing_overlap * (excluded * self._sensing_norm - excluded**2 / resources)
            + excluded**2 / resources
        )
        common = (resources - 2.0 * excluded + both) * (candidates / available) ** 2
        unaware = 1.0 - (1.0 - 1.0 / self.rate_hz) * self.sensed(to_sender.astype(float), raised_db)
        same_resource = unaware * common[to_sender] / candidates**2
        collides = same_resource * self._errors_by_interference[:, to_receiver]
        return np.asarray(1.0 - np.prod(1.0 - np.clip(collides, 0.0, 1.0), axis=1))

    @cached_property
    def _sensing_norm(self) -> float:
        """Share of the sensed vehicles that two radios at the same place both sense."""
        sensed = self._sensed_everywhere
        return float((sensed**2).sum() / sensed.sum())


@frozen
class DsrcSidelink(Sidelink):
    """IEEE 802.11p (DSRC, ITS-G5): vehicles send when they sense no other one sending [2]."""

    carrier_ghz = 5.89
    surroundings_m = 0.5
    sensing_dbm = -85.0
    noise_dbm = _NOISE_DBM
    errors = (
        tuple(
            one - 10.0 * float(np.log10(10.0 / 6.0))
            for one in (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
        ),
        (1.0, 0.4, 0.015, 0.004, 0.003, 0.002, 0.001),
    )
    _slot_s: ClassVar[float] = 13e-6
    _duration_s: ClassVar[float] = 40e-6 + (MESSAGE_BYTES + 30) * 8 / 6e6
    """Preamble, header and message at 6 Mbit/s."""

    def _arrival(self, spacing_m: float) -> Floats:
        """Apply equations (1) to (35) of [2]; see `Sidelink._arrival`."""
        to_receiver, to_sender = self._others(spacing_m)
        load = self.rate_hz * self._duration_s * self._sensed_everywhere.sum() / spacing_m
        load = min(load, 0.913 / (2.0 * 0.2481))  # the fit's maximum
        busy = -0.2481 * load**2 + 0.913 * load + 0.003844
        at_receiver = self.sensed(to_receiver.astype(float))
        at_sender = self.sensed(to_sender.astype(float))
        idle = 1.0 - busy * self._sensing_overlap[to_sender]
        together = self._slot_s * self.rate_hz * at_sender / idle
        hidden = self._duration_s * self.rate_hz * (1.0 - at_sender) / idle
        closer = to_receiver < DISTANCES_M[:, None]
        occupied = at_receiver * (np.where(closer, together, 0.0) + hidden)
        spoiled = self._errors_by_interference[:, to_receiver]
        collides = spoiled * (np.where(closer, 0.0, together) + hidden * (2.0 - at_receiver))
        heard = self.sensed(DISTANCES_M) * (1.0 - self._errors_by_noise)
        free = np.prod(1.0 - np.clip(occupied, 0.0, 1.0), axis=1)
        return np.asarray(heard * free * np.prod(1.0 - np.clip(collides, 0.0, 1.0), axis=1))


_TECHNOLOGIES: dict[str, type[Sidelink]] = {C_V2X: CellularSidelink, DSRC: DsrcSidelink}


@lru_cache(maxsize=16)
def sidelink_of(technology: str, power_dbm: float, rate_hz: float) -> Sidelink:
    """Return the sidelink of a technology, `C_V2X` or `DSRC`."""
    return _TECHNOLOGIES[technology](power_dbm, rate_hz)
