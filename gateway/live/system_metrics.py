"""Metrics of every vehicle of the hub, foreign ones included, from their newest MAVLink.

The lost frames of a system are counted by its sequence numbers; with several links to one system,
only frames that all of them lost count.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from prometheus_client.core import Metric

from gateway.live.metrics import Labels, counter, gauge
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import STATE_IDS, NewestState, NewestVehicles
from gateway.wire.mavlink_splitter import MavFrame

MAX_SYSTEMS: Final = 32
"""Maximum values of the label, each a time series; more are forged."""
SYSTEM: Final = ("system",)
HALF: Final = 128
"""A sequence number that is further ahead is an older one, of a late or repeated frame."""
Value = Callable[[NewestState, int], float]


@dataclass(slots=True)
class _Stream:
    """Frame counters of the vehicle of a system."""

    sequence: int
    frames: int = 0
    lost: int = 0

    def count(self, sequence: int) -> None:
        ahead = (sequence - self.sequence) & 0xFF
        if self.frames and not 0 < ahead < HALF:
            return
        self.lost += ahead - 1 if self.frames else 0
        self.frames += 1
        self.sequence = sequence


def _position(name: str) -> Value:
    return lambda state, now_us: getattr(state.valid_position(now_us), name, NAN)


GAUGES: Final[dict[str, tuple[str, Value]]] = {
    "altitude_metres": (
        "Height above mean sea level, of a valid position.",
        _position("alt_amsl_m"),
    ),
    "height_metres": ("Height above home, of a valid position.", _position("alt_home_m")),
    "ground_speed_metres_per_second": ("Horizontal speed.", _position("groundspeed_mps")),
    "satellites": ("Satellites of the GPS receiver.", lambda state, _: state.satellites()),
    "battery_volts": ("Voltage of the first battery.", lambda state, _: state.battery()[0]),
    "battery_percent": ("Remaining charge.", lambda state, _: state.battery()[1]),
    "armed": ("1 while the vehicle is armed.", lambda state, _: float(state.is_armed())),
    "silent_seconds": (
        "Time since the newest message: above some seconds the link is broken.",
        lambda state, now_us: state.age_us(now_us, *state.heard_us) / US_PER_S,
    ),
}


class SystemMetrics:
    """The values of all systems, fed with the frames of the hub."""

    def __init__(self) -> None:
        self._vehicles = NewestVehicles()
        self._streams: dict[int, _Stream] = {}

    def feed(self, frame: MavFrame, now_us: int, *, is_received: bool) -> None:
        """Process a frame of a vehicle, received or of our own."""
        system_id = frame.origin[0]
        known = self._vehicles.states
        if system_id not in known and len(self._present(now_us)) >= MAX_SYSTEMS:
            return
        if frame.message_id in STATE_IDS:
            self._vehicles.feed(frame, now_us)
        if is_received and self._vehicles.components.is_known(*frame.origin):
            stream = self._streams.setdefault(system_id, _Stream(frame.sequence))
            stream.count(frame.sequence)

    def families(self, now_us: int) -> Iterator[Metric]:
        """Yield the metrics of the systems that were received recently."""
        present = self._present(now_us)
        for name, (text, value_of) in GAUGES.items():
            samples = [
                (_label(system_id), _known(value_of(state, now_us)))
                for system_id, state in present.items()
            ]
            yield gauge(f"system_{name}", text, SYSTEM, samples)
        streams = [(_label(key), self._streams[key]) for key in present if key in self._streams]
        text = "Frames of the vehicle that were received; copies by a second link are not counted."
        frames = [(label, float(stream.frames)) for label, stream in streams]
        yield counter("system_frames", text, SYSTEM, frames)
        text = "Frames of the vehicle that were lost on the way here, by their sequence numbers."
        lost = [(label, float(stream.lost)) for label, stream in streams]
        yield counter("system_frames_lost", text, SYSTEM, lost)

    def _present(self, now_us: int) -> dict[int, NewestState]:
        return dict(list(self._vehicles.heard(now_us).items())[:MAX_SYSTEMS])


def _label(system_id: int) -> Labels:
    return (str(system_id),)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
