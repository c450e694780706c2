"""Extract a recorded vehicle's texts, events, subtitles and geotags, each with its time."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, cast

from pymavlink.dialects.v20 import all as mavlink

from gateway.printable import UNKNOWN, figure, printable
from gateway.recordings.formats.message_csv import csv_lines, data_cell
from gateway.recordings.moment import iso_time
from gateway.recordings.recorded_clock import DAY_US
from gateway.recordings.vehicle_reader import VehicleMessage
from gateway.records import NAN
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import GroundDistance, Position, is_located
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS, MESSAGE_NAMES
from gateway.wire.mavlink_splitter import origin_of

REACHED_ID: Final = MESSAGE_IDS["MISSION_ITEM_REACHED"]
LANDED_ID: Final = MESSAGE_IDS["EXTENDED_SYS_STATE"]
CAMERA_FEEDBACK_ID: Final = MESSAGE_IDS["CAMERA_FEEDBACK"]
CAPTURED_ID: Final = MESSAGE_IDS["CAMERA_IMAGE_CAPTURED"]
WANTED: Final = (
    HEARTBEAT_ID,
    MESSAGE_IDS["SYS_STATUS"],
    MESSAGE_IDS["BATTERY_STATUS"],
    REACHED_ID,
    LANDED_ID,
    CAMERA_FEEDBACK_ID,
    CAPTURED_ID,
)

SUBTITLE_FIELDS: Final = ("mode", "height", "speed", "distance", "battery", "coordinates")
MAX_RATE_HZ: Final = 60.0
MAX_GAP_US: Final = 5 * US_PER_S
"""Maximum age of a state that is shown."""
_LANDED: Final = {1: "on the ground", 2: "in flight", 3: "taking off", 4: "landing"}
"""Texts by MAV_LANDED_STATE."""


def texts(messages: Iterable[VehicleMessage]) -> str:
    """Write the texts as CSV, with their time, sender and severity."""
    found = [
        (iso_time(m.time_us), m.text.origin >> 8, m.text.origin & 0xFF, m.text.severity,
         data_cell(printable(m.text.text)))
        for m in messages
        if m.text is not None
    ]  # fmt: skip
    return csv_lines([("time", "system", "component", "severity", "text"), *found])


def events(messages: Iterable[VehicleMessage]) -> str:
    """Write changes of mode, arming and landing, and reached items of the mission, as CSV."""
    state: dict[tuple[int, str], object] = {}
    found = []
    for message in messages:
        for kind, value in _event_values(message):
            if kind == "reached" or state.get((message.system_id, kind)) != value:
                state[message.system_id, kind] = value
                found.append((iso_time(message.time_us), message.system_id, kind, value))
    return csv_lines([("time", "system", "event", "value"), *found])


def _event_values(message: VehicleMessage) -> list[tuple[str, str]]:
    fields = message.fields
    if message.message_id == HEARTBEAT_ID:
        is_armed = fields["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        return [("armed", "yes" if is_armed else "no"), ("mode", message.mode)]
    if message.message_id == LANDED_ID:
        return [("landed", _LANDED.get(fields["landed_state"], "unknown"))]
    if message.message_id == REACHED_ID:
        return [("reached", str(fields["seq"]))]
    return []


def images(messages: Iterable[VehicleMessage]) -> str:
    """Write the location of each image as CSV: CAMERA_FEEDBACK has angles, the other one names.

    An image that was sent several times is one image, at the camera's time for it.
    """
    found: dict[tuple[object, ...], tuple[object, ...]] = {}
    for message in messages:
        fields = message.fields
        if message.message_id == CAMERA_FEEDBACK_ID:
            time_us, name = fields["time_usec"], ""
            number, lon_dege7 = fields["img_idx"], fields["lng"]
            heights, angles = (fields["alt_msl"], fields["alt_rel"]), ["roll", "pitch", "yaw"]
        elif message.message_id == CAPTURED_ID and fields["capture_result"] == 1:
            time_us, name = fields["time_utc"], data_cell(printable(text_of(fields["file_url"])))
            number, lon_dege7 = fields["image_index"], fields["lon"]
            heights, angles = (fields["alt"] / 1e3, fields["relative_alt"] / 1e3), []
        else:
            continue
        place: tuple[object, ...] = ("", "", "", "")
        if is_located(fields["lat"], lon_dege7):
            place = (fields["lat"] / DEGE7_PER_DEG, lon_dege7 / DEGE7_PER_DEG, *heights)
        at_us = time_us if abs(time_us - message.time_us) < DAY_US else message.time_us
        row = (message.system_id, number, name, *place, *(fields[each] for each in angles))
        same = (origin_of(message.frame), time_us, *row)
        found.setdefault(same, (at_us, *row, *[""] * (3 - len(angles))))
    columns = ("time", "system", "image", "file", "lat_deg", "lon_deg", "alt_amsl_m",
               "alt_home_m", "roll_deg", "pitch_deg", "yaw_deg")  # fmt: skip
    rows = sorted(found.values(), key=lambda row: cast(int, row[0]))
    return csv_lines([columns, *((iso_time(cast(int, at)), *row) for at, *row in rows)])


class _Shown:
    """The newest state of the vehicle for subtitles."""

    def __init__(self) -> None:
        self.newest_us: int | None = None
        self._state, self._ground = NewestState(), GroundDistance()
        self._at: Position | None = None
        self._mode = UNKNOWN

    def feed(self, message: VehicleMessage) -> None:
        """Process the next message of the vehicle."""
        self.newest_us = message.time_us
        self._state.update(MESSAGE_NAMES[message.message_id], message.fields, message.time_us)
        self._mode = message.mode or self._mode
        if (at := message.position) is not None:
            self._at = at
            self._ground.update(message.time_us, at.lat_deg, at.lon_deg, message.boot_us)

    def text(self, names: Sequence[str]) -> str:
        """Return one line of the chosen fields that are known."""
        at = self._at or Position(NAN, NAN)
        volts, percent = self._state.battery()
        is_above_home = math.isfinite(at.alt_home_m)
        known = {
            "mode": [self._mode],
            "height": [figure(at.alt_home_m if is_above_home else at.alt_amsl_m, ".1f", "m")],
            "speed": [figure(at.groundspeed_mps, ".1f", "m/s")],
            "distance": [figure(self._ground.distance_m, ".0f", "m flown")],
            "battery": [figure(volts or NAN, ".1f", "V"), figure(percent, ".0f", "%")],
            "coordinates": [f"{at.lat_deg:.6f}, {at.lon_deg:.6f}" if self._at else UNKNOWN],
        }
        texts = (" ".join(one for one in known[name] if one != UNKNOWN) for name in names)
        return "  ".join(filter(None, texts))


@dataclass(frozen=True, slots=True)
class Subtitle:
    """A text and its interval, in s of the video."""

    begin_s: float
    end_s: float
    text: str


def subtitles(
    messages: Iterable[VehicleMessage],
    begin: Callable[[], int],
    names: Sequence[str] = SUBTITLE_FIELDS,
    rate_hz: float = 5.0,
) -> Iterator[Subtitle]:
    """Yield the state of a vehicle at a rate; `begin` returns the start of the video in µs."""
    shown, step, number = _Shown(), US_PER_S / rate_hz, 0
    begin_us: int | None = None
    for message in messages:
        begin_us = begin() if begin_us is None else begin_us
        if message.text is not None:
            continue
        while begin_us + number * step <= message.time_us:
            now_us = begin_us + number * step
            if shown.newest_us is None or now_us - shown.newest_us > MAX_GAP_US:
                # No data until the next message, which may be days after the start of the video.
                number = max(number + 1, math.ceil((message.time_us - begin_us) / step))
                break
            if (text := shown.text(names)) and now_us >= shown.newest_us:
                yield Subtitle(number / rate_hz, (number + 1) / rate_hz, text)
            number += 1
        shown.feed(message)


def srt(found: Iterable[Subtitle]) -> Iterator[str]:
    """Write subtitles as SubRip."""
    for number, one in enumerate(found, 1):
        yield f"{number}\n{_clock(one.begin_s, ',')} --> {_clock(one.end_s, ',')}\n{one.text}\n\n"


def ass(found: Iterable[Subtitle]) -> Iterator[str]:
    """Write subtitles as Advanced SubStation Alpha."""
    yield "[Script Info]\nScriptType: v4.00+\n\n[V4+ Styles]\n"
    yield "Format: Name, Fontname, Fontsize, PrimaryColour, Alignment, MarginL, MarginR, MarginV\n"
    yield "Style: Default,Arial,16,&H00FFFFFF,2,10,10,10\n\n[Events]\n"
    yield "Format: Layer, Start, End, Style, Text\n"
    for one in found:
        begin, end = (_clock(at_s, ".")[1:-1] for at_s in (one.begin_s, one.end_s))
        yield f"Dialogue: 0,{begin},{end},Default,{one.text}\n"


def _clock(seconds: float, point: str) -> str:
    ms = round(seconds * 1000)
    return (
        f"{ms // 3_600_000:02d}:{ms // 60_000 % 60:02d}:{ms // 1000 % 60:02d}{point}{ms % 1000:03d}"
    )
