"""A flight for Foxglove and PlotJuggler: messages in the schemas that Foxglove publishes.

| topic                              | schema                    | made of                         |
| ---------------------------------- | ------------------------- | ------------------------------- |
| `/tf`                              | foxglove.FrameTransform   | attitude and position           |
| `/vehicle_N/pose`                  | foxglove.PoseInFrame      | the same                        |
| `/vehicle_N/location`              | foxglove.LocationFix      | GLOBAL_POSITION_INT             |
| `/vehicle_N/gps`                   | foxglove.LocationFix      | GPS_RAW_INT                     |
| `/vehicle_N/state`                 | mavgate.State             | angles, height, speeds          |
| `/log`                             | foxglove.Log              | STATUSTEXT                      |
| `/mavlink/SYSTEM/COMPONENT/NAME`   | mavlink.NAME              | every message, field by field   |

Frame `map` is east, north, up from the first position that a vehicle reports; `vehicle_N` is
forward, left, up: with these the view is upright in Foxglove's 3D panel.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import msgspec
from mcap.writer import Writer
from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import from_euler, multiply, normalise, to_euler
from gateway.recordings.answers import is_station
from gateway.recordings.columns import unit_of
from gateway.recordings.convert import FlightToWrite
from gateway.recordings.formats.parquet import Pieces, decoded
from gateway.records import Quat
from gateway.units import DEG_PER_DEGE7, M_PER_CM, M_PER_MM, US_PER_S
from gateway.wire.mavlink_splitter import frame_of

MAP: Final = "map"
AUTOPILOT: Final = 1
LOG_TOPIC: Final = "/log"
TF_TOPIC: Final = "/tf"

_ENU_OF_NED: Final[Quat] = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
_FRD_OF_FLU: Final[Quat] = (0.0, 1.0, 0.0, 0.0)
LOG_LEVELS: Final = (5, 5, 5, 4, 3, 2, 2, 1)
"""foxglove.LogLevel by MAV_SEVERITY: emergency, alert, critical, error, warning, notice, info,
debug."""
TEXT_LENGTH: Final = 50
"""Of a STATUSTEXT's chunk; a shorter one is the last."""
COVARIANCE_UNKNOWN, COVARIANCE_APPROXIMATED, COVARIANCE_DIAGONAL = 0, 1, 2
"""foxglove.PositionCovarianceType."""
UNKNOWN_U32: Final = 0xFFFFFFFF


def _object(title: str, **fields: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def _number(description: str) -> dict[str, Any]:
    return {"type": "number", "description": description}


_TEXT: Final = {"type": "string"}
_INTEGER: Final = {"type": "integer"}
_TIME: Final = {
    "title": "time",
    "type": "object",
    "properties": {"sec": _INTEGER, "nsec": _INTEGER},
}
_AXIS: Final = {"type": "number"}
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

_NUMBERS: Final = {"float": "number", "double": "number", "char": "string"}


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


def fields_of_message(message: Any) -> dict[str, Any]:
    """Convert a decoded message to JSON; NaN and infinity become null."""
    return {name: _plain(getattr(message, name)) for name in message.fieldnames}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.decode("ascii", "replace") if isinstance(value, bytes) else value


@dataclass(frozen=True, slots=True)
class Shown:
    """One message of a topic."""

    topic: str
    schema: str
    """A key of `SCHEMAS`."""
    content: dict[str, Any]


@dataclass(slots=True)
class _Vehicle:
    """The newest data of one vehicle."""

    frame: str
    q_nb: Quat = (1.0, 0.0, 0.0, 0.0)
    has_attitude: bool = False
    has_quaternion: bool = False
    """It sends its attitude as a quaternion too: the angles are then left out."""
    position: Any = None
    """The newest GLOBAL_POSITION_INT."""
    accuracy_m: tuple[float, float] | None = None
    """Standard deviations along each level axis, and of the height, by the estimator."""
    gps_accuracy_m: tuple[float, float] | None = None
    """The same by the GPS receiver."""
    text: str = ""
    text_id: int = 0


class FoxgloveView:
    """Convert the messages of all vehicles to those of Foxglove's panels."""

    def __init__(self) -> None:
        self.origin: tuple[float, float, float] | None = None
        """Latitude, longitude and height of the frame `map`."""
        self._vehicles: dict[int, _Vehicle] = {}
        self._handlers: dict[str, Callable[[_Vehicle, Any, int], list[Shown]]] = {
            "ATTITUDE": self._attitude,
            "ATTITUDE_QUATERNION": self._quaternion,
            "GLOBAL_POSITION_INT": self._position,
            "GPS_RAW_INT": self._gps,
            "ESTIMATOR_STATUS": self._accuracy,
            "STATUSTEXT": self._text,
        }

    def feed(self, system_id: int, component_id: int, message: Any, time_us: int) -> list[Shown]:
        """Take the next message of a vehicle."""
        handler = self._handlers.get(message.msgname)
        if handler is None or component_id != AUTOPILOT:
            return []
        vehicle = self._vehicles.setdefault(system_id, _Vehicle(f"vehicle_{system_id}"))
        return handler(vehicle, message, time_us)

    def _attitude(self, vehicle: _Vehicle, m: Any, time_us: int) -> list[Shown]:
        if vehicle.has_quaternion or not math.isfinite(m.roll + m.pitch + m.yaw):
            return []
        return self._turned(vehicle, from_euler(m.roll, m.pitch, m.yaw), time_us)

    def _quaternion(self, vehicle: _Vehicle, m: Any, time_us: int) -> list[Shown]:
        q: Quat = (m.q1, m.q2, m.q3, m.q4)
        if not math.isfinite(sum(q)) or not any(q):
            return []
        vehicle.has_quaternion = True
        return self._turned(vehicle, normalise(q), time_us)

    def _turned(self, vehicle: _Vehicle, q_nb: Quat, time_us: int) -> list[Shown]:
        vehicle.q_nb, vehicle.has_attitude = q_nb, True
        w, x, y, z = multiply(multiply(_ENU_OF_NED, q_nb), _FRD_OF_FLU)
        turned = {"x": x, "y": y, "z": z, "w": w}
        at = {"timestamp": _time(time_us)}
        on_map_m = self._on_map_m(vehicle)
        shown = [
            Shown(
                TF_TOPIC,
                "foxglove.FrameTransform",
                at
                | {"parent_frame_id": MAP, "child_frame_id": vehicle.frame}
                | {"translation": on_map_m, "rotation": turned},
            )
        ]
        if vehicle.position is not None:
            pose = {"position": on_map_m, "orientation": turned}
            content = at | {"frame_id": MAP, "pose": pose}
            shown.append(Shown(f"/{vehicle.frame}/pose", "foxglove.PoseInFrame", content))
        return [*shown, self._state(vehicle)]

    def _on_map_m(self, vehicle: _Vehicle) -> dict[str, float]:
        """Return the position in the frame `map`; its origin before the first position."""
        if vehicle.position is None or self.origin is None:
            return {"x": 0.0, "y": 0.0, "z": 0.0}
        lat_deg, lon_deg, alt_m = _degrees(vehicle.position)
        north, east = displacement_m(*self.origin[:2], lat_deg, lon_deg, self.origin[2])
        return {"x": east, "y": north, "z": alt_m - self.origin[2]}

    def _state(self, vehicle: _Vehicle) -> Shown:
        roll, pitch, yaw = map(math.degrees, to_euler(vehicle.q_nb))
        content: dict[str, float | None] = dict.fromkeys(SCHEMAS["mavgate.State"]["properties"])
        if vehicle.has_attitude:
            content |= {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": yaw % 360.0}
        position = vehicle.position
        if position is not None:
            content |= {
                "alt_amsl_m": position.alt * M_PER_MM,
                "height_m": position.relative_alt * M_PER_MM,
                "speed_mps": math.hypot(position.vx, position.vy) * M_PER_CM,
                "climb_mps": -position.vz * M_PER_CM,
            }
        return Shown(f"/{vehicle.frame}/state", "mavgate.State", content)

    def _position(self, vehicle: _Vehicle, m: Any, time_us: int) -> list[Shown]:
        if not m.lat and not m.lon:
            return []
        vehicle.position = m
        if self.origin is None:
            self.origin = _degrees(m)
        known = COVARIANCE_DIAGONAL if vehicle.accuracy_m else COVARIANCE_APPROXIMATED
        accuracy_m = vehicle.accuracy_m or vehicle.gps_accuracy_m
        fix = _fix(vehicle.frame, time_us, _degrees(m), accuracy_m, known)
        shown = [Shown(f"/{vehicle.frame}/location", "foxglove.LocationFix", fix)]
        return shown if vehicle.has_attitude else [*shown, self._state(vehicle)]

    def _gps(self, vehicle: _Vehicle, m: Any, time_us: int) -> list[Shown]:
        if m.fix_type < 2 or (not m.lat and not m.lon):
            return []
        vehicle.gps_accuracy_m = None
        if 0 < m.h_acc < UNKNOWN_U32 and 0 < m.v_acc < UNKNOWN_U32:
            level_m = m.h_acc * M_PER_MM / math.sqrt(2.0)
            vehicle.gps_accuracy_m = (level_m, m.v_acc * M_PER_MM)
        fix = _fix(vehicle.frame, time_us, _degrees(m), vehicle.gps_accuracy_m, COVARIANCE_DIAGONAL)
        return [Shown(f"/{vehicle.frame}/gps", "foxglove.LocationFix", fix)]

    def _accuracy(self, vehicle: _Vehicle, m: Any, _time_us: int) -> list[Shown]:
        level_m, height_m = m.pos_horiz_accuracy, m.pos_vert_accuracy
        known = math.isfinite(level_m) and math.isfinite(height_m)
        vehicle.accuracy_m = (level_m / math.sqrt(2.0), height_m) if known else None
        return []

    def _text(self, vehicle: _Vehicle, m: Any, time_us: int) -> list[Shown]:
        """Put the chunks of a long text together."""
        part = str(_plain(m.text)).partition("\0")[0]
        begun = vehicle.text if m.id and m.id == vehicle.text_id and m.chunk_seq else ""
        vehicle.text, vehicle.text_id = begun + part, m.id
        if m.id and len(part) == TEXT_LENGTH:
            return []
        content = {
            "timestamp": _time(time_us),
            "level": LOG_LEVELS[min(m.severity, len(LOG_LEVELS) - 1)],
            "message": vehicle.text,
            "name": vehicle.frame,
            "file": "",
            "line": 0,
        }
        return [Shown(LOG_TOPIC, "foxglove.Log", content)]


def _degrees(m: Any) -> tuple[float, float, float]:
    return (m.lat * DEG_PER_DEGE7, m.lon * DEG_PER_DEGE7, m.alt * M_PER_MM)


def _fix(
    frame: str,
    time_us: int,
    position: tuple[float, float, float],
    accuracy_m: tuple[float, float] | None,
    covariance_type: int,
) -> dict[str, Any]:
    lat_deg, lon_deg, alt_m = position
    covariance = [0.0] * 9
    if accuracy_m is not None:
        level_m, height_m = accuracy_m
        covariance[0] = covariance[4] = level_m**2
        covariance[8] = height_m**2
    return {
        "timestamp": _time(time_us),
        "frame_id": frame,
        "latitude": lat_deg,
        "longitude": lon_deg,
        "altitude": alt_m,
        "position_covariance": covariance,
        "position_covariance_type": covariance_type if accuracy_m else COVARIANCE_UNKNOWN,
    }


def _time(time_us: int) -> dict[str, int]:
    seconds, us = divmod(time_us, US_PER_S)
    return {"sec": seconds, "nsec": us * 1000}


LAST_US: Final = (2**64 - 1) // 1000
"""Later times are written as this one, the last that the format holds, µs."""


class _Topics:
    """Channels and schemas of one file, each registered at its first use."""

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
    topics, view = _Topics(writer), FoxgloveView()
    stations: set[int] = set()
    for record, message in decoded(flight):
        frame, time_us = frame_of(record.frame), record.time_us
        system, component = frame.origin
        origin = system << 8 | component
        if frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT and frame.is_station_heartbeat:
            stations.add(origin)
        topic = f"/mavlink/{system}/{component}/{message.msgname}"
        kind, fields = mavlink.mavlink_map[frame.message_id], fields_of_message(message)
        topics.add(topic, schema_of_message(kind), fields, time_us, frame.sequence)
        if not is_station(origin, stations):
            for shown in view.feed(system, component, message, time_us):
                topics.add(shown.topic, SCHEMAS[shown.schema], shown.content, time_us)
        if data := pieces.taken():
            yield data
    if view.origin is not None:
        lat_deg, lon_deg, alt_m = map(str, view.origin)
        origin_facts = {"latitude": lat_deg, "longitude": lon_deg, "altitude_amsl_m": alt_m}
        writer.add_metadata("origin of the frame map", origin_facts)
    writer.finish()  # type: ignore[no-untyped-call]
    yield pieces.taken()
