"""Write a flight for Foxglove and PlotJuggler, in the schemas that Foxglove publishes.

| topic                              | schema                    | source                          |
| ---------------------------------- | ------------------------- | ------------------------------- |
| `/tf`                              | foxglove.FrameTransform   | attitude and position           |
| `/vehicle_N/pose`                  | foxglove.PoseInFrame      | attitude and position           |
| `/vehicle_N/location`              | foxglove.LocationFix      | the best positions              |
| `/vehicle_N/gps`                   | foxglove.LocationFix      | GPS_RAW_INT                     |
| `/vehicle_N/state`                 | mavgate.State             | angles, height, speeds          |
| `/log`                             | foxglove.Log              | STATUSTEXT                      |
| `/mavlink/SYSTEM/COMPONENT/NAME`   | mavlink.NAME              | every message, field by field   |

Frame `map` is east, north, up from the first position that a vehicle reports. `vehicle_N` is
forward, left, up, so that the view is upright in Foxglove's 3D panel.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import msgspec
import numpy as np
from mcap.writer import Writer

from gateway import __version__
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import multiply, to_euler
from gateway.recordings.columns import unit_of
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.recordings.workshop.convert import FlightToWrite, Pieces
from gateway.records import Quat
from gateway.units import M_PER_MM, US_PER_S, counted
from gateway.vehicle_state.positions import Position, position_of
from gateway.vehicle_state.status_texts import JoinedText, text_of
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS
from gateway.wire.mavlink_splitter import frame_of
from gateway.wire.recorded_frames import fields_of

MAP: Final = "map"
LOG_TOPIC: Final = "/log"
TF_TOPIC: Final = "/tf"

_ENU_OF_NED: Final[Quat] = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
_FRD_OF_FLU: Final[Quat] = (0.0, 1.0, 0.0, 0.0)
LOG_LEVELS: Final = (5, 5, 5, 4, 3, 2, 2, 1)
"""foxglove.LogLevel by MAV_SEVERITY: emergency, alert, critical, error, warning, notice, info,
debug."""
COVARIANCE_UNKNOWN, COVARIANCE_APPROXIMATED, COVARIANCE_DIAGONAL = 0, 1, 2
"""foxglove.PositionCovarianceType."""
UNKNOWN_U32: Final = 0xFFFFFFFF
_TEXT: Final = {"type": "string"}
_INTEGER: Final = {"type": "integer"}
_TIME: Final = {
    "title": "time",
    "type": "object",
    "properties": {"sec": _INTEGER, "nsec": _INTEGER},
}
_AXIS: Final = {"type": "number"}
_NUMBERS: Final = {"float": "number", "double": "number", "char": "string"}
GPS_ID: Final = MESSAGE_IDS["GPS_RAW_INT"]
ESTIMATOR_ID: Final = MESSAGE_IDS["ESTIMATOR_STATUS"]
LAST_US: Final = (2**64 - 1) // 1000
"""Latest time that the format can hold, µs; later times are replaced by it."""


def _object(title: str, **fields: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def _number(description: str) -> dict[str, Any]:
    return {"type": "number", "description": description}


_VECTOR3: Final = _object("foxglove.Vector3", x=_AXIS, y=_AXIS, z=_AXIS)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_AXIS, y=_AXIS, z=_AXIS, w=_AXIS)

SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    schema["title"]: schema
    for schema in (
        _object(
            "foxglove.FrameTransform",
            timestamp=_TIME,
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_VECTOR3,
            rotation=_QUATERNION,
        ),
        _object(
            "foxglove.PoseInFrame",
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_object("foxglove.Pose", position=_VECTOR3, orientation=_QUATERNION),
        ),
        _object(
            "foxglove.LocationFix",
            timestamp=_TIME,
            frame_id=_TEXT,
            latitude=_number("degrees"),
            longitude=_number("degrees"),
            altitude=_number("m above mean sea level"),
            position_covariance={"type": "array", "items": _AXIS, "minItems": 9, "maxItems": 9},
            position_covariance_type=_INTEGER,
        ),
        _object(
            "foxglove.Log",
            timestamp=_TIME,
            level=_INTEGER,
            message=_TEXT,
            name=_TEXT,
            file=_TEXT,
            line=_INTEGER,
        ),
        _object(
            "mavgate.State",
            **{
                name: _number(unit_of(name).replace("deg", "degrees") + meaning)
                for name, meaning in (
                    ("roll_deg", ", right wing down positive"),
                    ("pitch_deg", ", nose up positive"),
                    ("heading_deg", " from true north, clockwise"),
                    ("alt_amsl_m", " above mean sea level"),
                    ("height_m", " above home"),
                    ("speed_mps", " over the ground"),
                    ("climb_mps", ", upwards positive"),
                )
            },
        ),
    )
}


@cache
def schema_of_message(kind: Any) -> dict[str, Any]:
    """Describe the fields of a MAVLink message, with their units, as a JSON schema."""
    fields: dict[str, Any] = {}
    for name, written in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        one: dict[str, Any] = {"type": _NUMBERS.get(written, "integer")}
        length = kind.array_lengths[kind.ordered_fieldnames.index(name)]
        fields[name] = {"type": "array", "items": one} if length and written != "char" else one
        unit = kind.fieldunits_by_name.get(name)
        if unit:
            fields[name]["description"] = f"unit: {unit}"
    return {"title": f"mavlink.{kind.msgname}", "type": "object", "properties": fields}


def plain(value: Any) -> Any:
    """Convert a field to JSON: text, numbers and lists; NaN and infinity become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value.tolist()]
    return text_of(value) if isinstance(value, bytes) else value


@dataclass(frozen=True, slots=True)
class Shown:
    """A message of a topic."""

    topic: str
    schema: str
    """Key of `SCHEMAS`."""
    content: dict[str, Any]


@dataclass(slots=True)
class _Vehicle:
    """The newest data of one vehicle."""

    frame: str
    q_nb: Quat = (1.0, 0.0, 0.0, 0.0)
    has_attitude: bool = False
    position: Position | None = None
    accuracy_m: tuple[float, float] | None = None
    """Standard deviations along each horizontal axis, and of the height, from the estimator."""
    gps_accuracy_m: tuple[float, float] | None = None
    """The same from the GPS receiver."""


class FoxgloveView:
    """Convert the messages of all vehicles to the schemas of Foxglove's panels."""

    def __init__(self) -> None:
        self.origin: Position | None = None
        """Origin of the frame `map`."""
        self._vehicles: dict[int, _Vehicle] = {}

    def feed(self, message: VehicleMessage) -> Iterator[Shown]:
        """Process the next message of a vehicle; these include GPS_RAW_INT and ESTIMATOR_STATUS."""
        frame, time_us = f"vehicle_{message.system_id}", message.time_us
        vehicle = self._vehicles.setdefault(message.system_id, _Vehicle(frame))
        if message.text is not None:
            yield _log(frame, message.text)
        if message.q_nb is not None:
            yield from self._turned(vehicle, message.q_nb, time_us)
        if message.message_id == GPS_ID:
            yield from self._gps(vehicle, message.fields, time_us)
        if message.position is not None:
            yield from self._located(vehicle, message.position, time_us)
        if message.message_id == ESTIMATOR_ID:
            names = ("pos_horiz_accuracy", "pos_vert_accuracy")
            level_m, height_m = (message.fields[name] for name in names)
            known = math.isfinite(level_m) and math.isfinite(height_m)
            vehicle.accuracy_m = (level_m / math.sqrt(2.0), height_m) if known else None

    def _turned(self, vehicle: _Vehicle, q_nb: Quat, time_us: int) -> Iterator[Shown]:
        vehicle.q_nb, vehicle.has_attitude = q_nb, True
        w, x, y, z = multiply(multiply(_ENU_OF_NED, q_nb), _FRD_OF_FLU)
        turned = {"x": x, "y": y, "z": z, "w": w}
        at = {"timestamp": _time(time_us)}
        on_map_m = self._on_map_m(vehicle)
        frames = {"parent_frame_id": MAP, "child_frame_id": vehicle.frame}
        transform = at | frames | {"translation": on_map_m, "rotation": turned}
        yield Shown(TF_TOPIC, "foxglove.FrameTransform", transform)
        if vehicle.position is not None:
            pose = {"position": on_map_m, "orientation": turned}
            content = at | {"frame_id": MAP, "pose": pose}
            yield Shown(f"/{vehicle.frame}/pose", "foxglove.PoseInFrame", content)
        yield self._state(vehicle)

    def _on_map_m(self, vehicle: _Vehicle) -> dict[str, float]:
        """Return the position in the frame `map`; the origin before the first position."""
        at, zero = vehicle.position, self.origin
        if at is None or zero is None:
            return {"x": 0.0, "y": 0.0, "z": 0.0}
        ground = (zero.lat_deg, zero.lon_deg, at.lat_deg, at.lon_deg, _or_zero(zero.alt_amsl_m))
        north, east = displacement_m(*ground)
        return {"x": east, "y": north, "z": _or_zero(at.alt_amsl_m - zero.alt_amsl_m)}

    def _state(self, vehicle: _Vehicle) -> Shown:
        roll, pitch, yaw = map(math.degrees, to_euler(vehicle.q_nb))
        content: dict[str, float | None] = dict.fromkeys(SCHEMAS["mavgate.State"]["properties"])
        if vehicle.has_attitude:
            content |= {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": yaw % 360.0}
        at = vehicle.position
        if at is not None:
            content |= {
                "alt_amsl_m": plain(at.alt_amsl_m),
                "height_m": plain(at.alt_home_m),
                "speed_mps": plain(at.groundspeed_mps),
                "climb_mps": plain(-at.vel_n_mps[2]),
            }
        return Shown(f"/{vehicle.frame}/state", "mavgate.State", content)

    def _located(self, vehicle: _Vehicle, at: Position, time_us: int) -> Iterator[Shown]:
        vehicle.position = at
        self.origin = self.origin or at
        known = COVARIANCE_DIAGONAL if vehicle.accuracy_m else COVARIANCE_APPROXIMATED
        accuracy_m = vehicle.accuracy_m or vehicle.gps_accuracy_m
        fix = _fix(vehicle.frame, time_us, at, accuracy_m, known)
        yield Shown(f"/{vehicle.frame}/location", "foxglove.LocationFix", fix)
        if not vehicle.has_attitude:
            yield self._state(vehicle)

    def _gps(self, vehicle: _Vehicle, m: Mapping[str, Any], time_us: int) -> Iterator[Shown]:
        at = position_of(GPS_ID, m)
        if at is None:
            return
        vehicle.gps_accuracy_m = None
        if 0 < m["h_acc"] < UNKNOWN_U32 and 0 < m["v_acc"] < UNKNOWN_U32:
            level_m = m["h_acc"] * M_PER_MM / math.sqrt(2.0)
            vehicle.gps_accuracy_m = (level_m, m["v_acc"] * M_PER_MM)
        fix = _fix(vehicle.frame, time_us, at, vehicle.gps_accuracy_m, COVARIANCE_DIAGONAL)
        yield Shown(f"/{vehicle.frame}/gps", "foxglove.LocationFix", fix)


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _log(frame: str, text: JoinedText) -> Shown:
    level = LOG_LEVELS[min(text.severity, len(LOG_LEVELS) - 1)]
    content = {"timestamp": _time(text.time_us), "level": level, "message": text.text}
    return Shown(LOG_TOPIC, "foxglove.Log", content | {"name": frame, "file": "", "line": 0})


def _fix(
    frame: str,
    time_us: int,
    at: Position,
    accuracy_m: tuple[float, float] | None,
    covariance_type: int,
) -> dict[str, Any]:
    covariance = [0.0] * 9
    if accuracy_m is not None:
        level_m, height_m = accuracy_m
        covariance[0] = covariance[4] = level_m**2
        covariance[8] = height_m**2
    return {
        "timestamp": _time(time_us),
        "frame_id": frame,
        "latitude": at.lat_deg,
        "longitude": at.lon_deg,
        "altitude": plain(at.alt_amsl_m),
        "position_covariance": covariance,
        "position_covariance_type": covariance_type if accuracy_m else COVARIANCE_UNKNOWN,
    }


def _time(time_us: int) -> dict[str, int]:
    seconds, us = divmod(time_us, US_PER_S)
    return {"sec": seconds, "nsec": us * 1000}


class _Topics:
    """Channels and schemas of one file, each registered on first use."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(
        self, topic: str, schema: dict[str, Any], content: Any, time_us: int, sequence: int = 0
    ) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            number = self._schema(schema)
            channel = self._writer.register_channel(topic, "json", number)
            self._channels[topic] = channel
        time_ns = min(time_us, LAST_US) * 1000
        data = msgspec.json.encode(content)
        self._writer.add_message(channel, time_ns, data, time_ns, sequence)

    def add_shown(self, shown: Iterable[Shown], time_us: int) -> None:
        for one in shown:
            self.add(one.topic, SCHEMAS[one.schema], one.content, time_us)

    def _schema(self, schema: dict[str, Any]) -> int:
        name = schema["title"]
        if name not in self._schemas:
            data = msgspec.json.encode(schema)
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", data)
        return self._schemas[name]


def write(flight: FlightToWrite) -> Iterator[bytes]:
    """Write a flight, at its civil times."""
    pieces = Pieces()
    writer = Writer(pieces)  # type: ignore[arg-type]
    writer.start(library=f"mavgate {__version__}")
    topics, view, unknown = _Topics(writer), FoxgloveView(), 0
    records = flight.frames()
    reader = VehicleReader(flight.senders, (GPS_ID, ESTIMATOR_ID))
    for record in records:
        frame, time_us = frame_of(record.frame), record.time_us
        kind = DEFINITIONS.get(frame.message_id)
        unknown += kind is None
        if kind is not None:
            system, component = frame.origin
            topic = f"/mavlink/{system}/{component}/{kind.msgname}"
            fields = {name: plain(value) for name, value in fields_of(record.frame).items()}
            topics.add(topic, schema_of_message(kind), fields, time_us, frame.sequence)
        for message in reader.feed(record):
            topics.add_shown(view.feed(message), message.time_us)
        if data := pieces.take():
            yield data
    for message in reader.flush():
        topics.add_shown(view.feed(message), message.time_us)
    if unknown:
        flight.remark(
            f"left out {counted(unknown, 'message')} that no supported MAVLink dialect contains"
        )
    if view.origin is not None:
        zero = view.origin
        lat_deg, lon_deg, alt_m = map(str, (zero.lat_deg, zero.lon_deg, zero.alt_amsl_m))
        origin_facts = {"latitude": lat_deg, "longitude": lon_deg, "altitude_amsl_m": alt_m}
        writer.add_metadata("origin of the frame map", origin_facts)
    writer.finish()  # type: ignore[no-untyped-call]
    yield pieces.take()
