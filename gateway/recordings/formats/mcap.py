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
from operator import itemgetter
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway import __version__
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import multiply, to_euler
from gateway.recordings.columns import unit_of
from gateway.recordings.formats.mcap_writer import McapWriter
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.records import NAN, Quat
from gateway.units import M_PER_MM, US_PER_S, counted
from gateway.vehicle_state.positions import Position, position_of
from gateway.vehicle_state.status_texts import JoinedText, text_of
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS
from gateway.wire.mavlink_splitter import SEQUENCE_V1, SEQUENCE_V2, START_V2
from gateway.wire.recorded_frames import Batch, columns_of

Row = tuple[int, int, bytes, int]
"""Time in µs, channel, JSON, and sequence number of a message of the file."""

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
_COVARIANCE: Final = {"type": "array", "items": _AXIS, "minItems": 9, "maxItems": 9}
_STATE: Final = {
    "roll_deg": ", right wing down positive", "pitch_deg": ", nose up positive",
    "heading_deg": " from true north, clockwise", "alt_amsl_m": " above mean sea level",
    "height_m": " above home", "speed_mps": " over the ground", "climb_mps": ", upwards positive",
}  # fmt: skip
"""Meaning of each number of a state, after its unit."""
_NUMBERS: Final = {"float": "number", "double": "number", "char": "string"}
GPS_ID: Final = MESSAGE_IDS["GPS_RAW_INT"]
ESTIMATOR_ID: Final = MESSAGE_IDS["ESTIMATOR_STATUS"]
_UNKNOWN: Final = Position(NAN, NAN)
LAST_US: Final = (2**64 - 1) // 1000
"""Latest time that the format can hold, µs; later times are replaced by it."""


def _object(title: str, **fields: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def _number(description: str) -> dict[str, Any]:
    return {"type": "number", "description": description}


_VECTOR3: Final = _object("foxglove.Vector3", x=_AXIS, y=_AXIS, z=_AXIS)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_AXIS, y=_AXIS, z=_AXIS, w=_AXIS)

_POSE: Final = _object("foxglove.Pose", position=_VECTOR3, orientation=_QUATERNION)
_FIELDS: Final[dict[str, dict[str, Any]]] = {
    "foxglove.FrameTransform": {
        "parent_frame_id": _TEXT, "child_frame_id": _TEXT, "translation": _VECTOR3,
        "rotation": _QUATERNION,
    },
    "foxglove.PoseInFrame": {"frame_id": _TEXT, "pose": _POSE},
    "foxglove.LocationFix": {
        "frame_id": _TEXT, "latitude": _number("degrees"), "longitude": _number("degrees"),
        "altitude": _number("m above mean sea level"), "position_covariance": _COVARIANCE,
        "position_covariance_type": _INTEGER,
    },
    "foxglove.Log": {
        "level": _INTEGER, "message": _TEXT, "name": _TEXT, "file": _TEXT, "line": _INTEGER,
    },
}  # fmt: skip
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    title: _object(title, timestamp=_TIME, **fields) for title, fields in _FIELDS.items()
} | {
    "mavgate.State": _object(
        "mavgate.State",
        **{n: _number(unit_of(n).replace("deg", "degrees") + how) for n, how in _STATE.items()},
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
        on_map_m, timestamp = self._on_map_m(vehicle), _time(time_us)
        transform = {
            "timestamp": timestamp, "parent_frame_id": MAP, "child_frame_id": vehicle.frame,
            "translation": on_map_m, "rotation": turned,
        }  # fmt: skip
        yield Shown(TF_TOPIC, "foxglove.FrameTransform", transform)
        if vehicle.position is not None:
            pose = {"position": on_map_m, "orientation": turned}
            content = {"timestamp": timestamp, "frame_id": MAP, "pose": pose}
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
        """Return the state, in which unknown values are NaN, thus null in JSON."""
        roll, pitch, yaw = (NAN, NAN, NAN)
        if vehicle.has_attitude:
            roll, pitch, yaw = map(math.degrees, to_euler(vehicle.q_nb))
        at = vehicle.position or _UNKNOWN
        content = {
            "roll_deg": roll, "pitch_deg": pitch, "heading_deg": yaw % 360.0,
            "alt_amsl_m": at.alt_amsl_m, "height_m": at.alt_home_m,
            "speed_mps": at.groundspeed_mps, "climb_mps": -at.vel_n_mps[2],
        }  # fmt: skip
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
        "altitude": at.alt_amsl_m,
        "position_covariance": covariance,
        "position_covariance_type": covariance_type if accuracy_m else COVARIANCE_UNKNOWN,
    }


def _time(time_us: int) -> dict[str, int]:
    seconds, us = divmod(time_us, US_PER_S)
    return {"sec": seconds, "nsec": us * 1000}


class _Topics:
    """Channels and schemas of one file, each registered on first use."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def channel(self, topic: str, schema: dict[str, Any]) -> int:
        """Return the channel of a topic."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._writer.add_channel(topic, "json", self._schema(schema))
            self._channels[topic] = channel
        return channel

    def _schema(self, schema: dict[str, Any]) -> int:
        name = schema["title"]
        if name not in self._schemas:
            data = msgspec.json.encode(schema)
            self._schemas[name] = self._writer.add_schema(name, "jsonschema", data)
        return self._schemas[name]


def _recorded(batch: Batch, topics: _Topics) -> Iterator[Row]:
    """Yield the MAVLink messages of the dialect, of one sender and type after the other."""
    is_v2 = np.frombuffer(batch.data, np.uint8)[batch.starts + TIME_SIZE] == START_V2
    at = batch.starts + TIME_SIZE + np.where(is_v2, SEQUENCE_V2, SEQUENCE_V1)
    sequences = np.frombuffer(batch.data, np.uint8)[at]
    for key in np.unique(batch.origins << 24 | batch.message_ids).tolist():
        origin, message_id = key >> 24, key & 0xFFFFFF
        kind = DEFINITIONS.get(message_id)
        if kind is None:
            continue
        rows = np.flatnonzero((batch.origins == origin) & (batch.message_ids == message_id))
        topic = f"/mavlink/{origin >> 8}/{origin & 0xFF}/{kind.msgname}"
        channel = topics.channel(topic, schema_of_message(kind))
        values = columns_of(batch, rows, message_id)
        columns = [_listed(values[name]) for name in values.dtype.names or ()]
        contents = zip(*columns, strict=True)
        for time_us, sequence, content in zip(
            batch.time_us[rows].tolist(), sequences[rows].tolist(), contents, strict=True
        ):
            fields = dict(zip(kind.ordered_fieldnames, content, strict=True))
            yield time_us, channel, msgspec.json.encode(fields), sequence


def _listed(column: NDArray[Any]) -> list[Any]:
    """Return a column of fields as they are in JSON, where NaN becomes null."""
    if column.dtype.kind == "S":
        return [text_of(data) for data in column.tolist()]
    found: list[Any] = column.tolist()
    return found


def write(flight: FlightToWrite) -> Iterator[bytes]:
    """Write a flight, at its civil times."""
    writer = McapWriter(f"mavgate {__version__}")
    topics, view, unknown = _Topics(writer), FoxgloveView(), 0

    def shown(messages: Iterable[VehicleMessage]) -> Iterator[Row]:
        for message in messages:
            for one in view.feed(message):
                channel = topics.channel(one.topic, SCHEMAS[one.schema])
                yield message.time_us, channel, msgspec.json.encode(one.content), 0

    def add(rows: Iterable[Row]) -> None:
        for time_us, channel, data, sequence in sorted(rows, key=itemgetter(0)):
            writer.add_message(channel, min(time_us, LAST_US) * 1000, data, sequence)

    batches = flight.chosen()
    reader = VehicleReader(flight.senders, (GPS_ID, ESTIMATOR_ID))
    for batch in batches:
        unknown += int(np.sum(~np.isin(batch.message_ids, [*DEFINITIONS])))
        add([*_recorded(batch, topics), *shown(reader.feed_batch(batch))])
        if data := writer.take():
            yield data
    add(shown(reader.flush()))
    if unknown:
        flight.remark(
            f"left out {counted(unknown, 'message')} that no supported MAVLink dialect contains"
        )
    if view.origin is not None:
        zero = view.origin
        lat_deg, lon_deg, alt_m = map(str, (zero.lat_deg, zero.lon_deg, zero.alt_amsl_m))
        origin_facts = {"latitude": lat_deg, "longitude": lon_deg, "altitude_amsl_m": alt_m}
        writer.add_metadata("origin of the frame map", origin_facts)
    yield writer.finish()
