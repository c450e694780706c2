"""Metrics of every vehicle of the hub, foreign ones included, from their newest MAVLink."""

from collections.abc import Callable, Iterator
from typing import Final

from prometheus_client.core import Metric

from gateway.live.metrics import counter, gauge
from gateway.live.vehicle_watch import VehicleWatch
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import NewestState

SYSTEM: Final = ("system",)
Value = Callable[[NewestState, int], float]


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


def system_families(watch: VehicleWatch, now_us: int) -> Iterator[Metric]:
    """Yield the metrics of the systems that were received recently."""
    present = watch.present(now_us)
    for name, (text, value_of) in GAUGES.items():
        samples = [((str(key),), value_of(state, now_us)) for key, state in present.items()]
        yield gauge(f"system_{name}", text, SYSTEM, samples)
    streams = [((str(key),), watch.streams[key]) for key in present if key in watch.streams]
    text = "Frames of the vehicle that were received; copies by a second link are not counted."
    frames = [(label, float(stream.count)) for label, stream in streams]
    yield counter("system_frames", text, SYSTEM, frames)
    text = "Frames of the vehicle that were lost on the way here, by their sequence numbers."
    lost = [(label, float(stream.lost)) for label, stream in streams]
    yield counter("system_frames_lost", text, SYSTEM, lost)
