"""Table `radio` of a scenario file: the radio channels between vehicles and with coordinators."""

from __future__ import annotations

from typing import Final

from attrs import field, frozen

from laneweave.protocol.field_validators import one_of, within

NO_RADIO: Final = "none"
C_V2X: Final = "c-v2x"
DSRC: Final = "802.11p"


@frozen
class Radio:
    """How messages between vehicles, and between vehicles and coordinators, are lost and delayed.

    Vehicles send to each other by sidelink; vehicles and coordinators use a cellular network.
    """

    technology: str = field(default=NO_RADIO, validator=one_of(NO_RADIO, C_V2X, DSRC))
    """Technology of the sidelink; "none": no radio is simulated, and nothing is lost."""
    power_dbm: float = field(default=23.0, validator=within(-20.0, 33.0))
    """Transmission power of the sidelink."""
    rate_hz: float = field(default=10.0, validator=within(1.0, 50.0))
    """Number of messages per second that every vehicle is assumed to send by sidelink."""
    other_senders_per_km: float = field(default=0.0, validator=within(0.0, 500.0))
    """Density of senders that are not on the road, such as those of the opposite direction."""
    burst_share: float = field(default=0.02, validator=within(0.0, 0.9))
    """Share of time for which a link loses all messages, in bursts (Gilbert-Elliott)."""
    burst_s: float = field(default=0.5, validator=within(0.01, 60.0))
    """Mean duration of a burst."""
    cellular_loss: float = field(default=0.01, validator=within(0.0, 1.0))
    """Probability that the cellular network loses a message, apart from bursts."""
    cellular_delay_s: float = field(default=0.03, validator=within(0.0, 10.0))
    """Minimum delay of a message by the cellular network."""
    cellular_jitter_s: float = field(default=0.03, validator=within(0.0, 10.0))
    """Maximum additional delay, drawn uniformly."""

    @property
    def enabled(self) -> bool:
        """Whether a radio is simulated."""
        return self.technology != NO_RADIO
