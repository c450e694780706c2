"""The states of an aircraft over time."""

from array import array
from typing import Final

from gateway.panel.state.instant import Instant

MAX_TRACK: Final = 20_000
"""Maximum moments of the history: more than an hour at 5 Hz; the oldest are dropped."""
TRACK_INTERVAL_US: Final = 200_000
HISTORY_COLUMNS: Final = {
    "lat_deg": "d", "lon_deg": "d",
    **dict.fromkeys(
        (
            "alt_amsl_m", "alt_home_m", "q_nb.0", "q_nb.1", "q_nb.2", "q_nb.3", "rate_b_radps.0",
            "rate_b_radps.1", "rate_b_radps.2", "vel_n_mps.0", "vel_n_mps.1", "vel_n_mps.2",
            "groundspeed_mps", "airspeed_mps", "climb_mps", "heading_deg", "pos_std_m", "fix_type",
            "satellites", "battery_v", "battery_percent",
        ),
        "f",
    ),
}  # fmt: skip
"""Columns of a history and their types: fields of `Instant`, with `.n` for one of its numbers."""


class FlightHistory:
    """States of one aircraft as columns over time."""

    def __init__(self, limit: int = MAX_TRACK) -> None:
        self._limit = limit
        self.time_us = array("q")
        self.columns = {name: array(kind) for name, kind in HISTORY_COLUMNS.items()}

    def __len__(self) -> int:
        return len(self.time_us)

    @property
    def newest_us(self) -> int:
        """Time of the newest state; far in the past without any."""
        return self.time_us[-1] if self.time_us else -TRACK_INTERVAL_US

    def add(self, time_us: int, now: Instant) -> None:
        """Add the state of one moment."""
        self.time_us.append(time_us)
        for name, column in self.columns.items():
            field, _, index = name.partition(".")
            value = getattr(now, field)
            column.append(value[int(index)] if index else value)
        if len(self.time_us) > self._limit:
            # A quarter at once, so that the rest is seldom moved.
            for column in (self.time_us, *self.columns.values()):
                del column[: self._limit // 4]

    def clear(self) -> None:
        """Delete all states."""
        for column in (self.time_us, *self.columns.values()):
            del column[:]

    def track(self) -> list[tuple[float, float, float, int]]:
        """Return latitude, longitude, height AMSL and time of all moments."""
        names = ("lat_deg", "lon_deg", "alt_amsl_m")
        return list(zip(*(self.columns[name] for name in names), self.time_us, strict=True))
