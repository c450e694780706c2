"""Lines of text: JSON objects, NMEA 0183 sentences and CSV, mixed in one stream.

| a line begins with | it is                                                             |
| ------------------ | ----------------------------------------------------------------- |
| `{`                | a JSON object; its keys are those of `KEYS`                       |
| `$` or `!`         | an NMEA 0183 sentence                                             |
| `#`                | a comment                                                         |
| anything else      | CSV, with the column map in the option `columns`                  |
"""

import json
from collections.abc import Mapping
from typing import Any, Final

from gateway.records import NAN, BaroRaw, BatteryReport, NodeId, RadioSignal, Vec3, VehicleReport
from gateway.sources.csv_lines import CsvLines, read_column_map
from gateway.sources.nmea import NmeaReader
from gateway.sources.sampling import SampleClock, fix_at, imu_raw, velocity
from gateway.sources.settings import MAX_VEHICLE, SourceUrl
from gateway.sources.source import SourceRecord, TextLines, unusable
from gateway.units import PA_PER_HPA, RAD_PER_DEG, STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.wire.framing import Fault
from gateway.wire.timesync import WRAP_MASK

MAX_LINE: Final = 4096
VECTORS: Final = {
    "accel_mps2": ("accel", 1.0),
    "accel_g": ("accel", STANDARD_GRAVITY_MPS2),
    "gyro_dps": ("gyro", 1.0),
    "gyro_radps": ("gyro", 1.0 / RAD_PER_DEG),
    "mag_ut": ("mag", 1.0),
    "mag_gauss": ("mag", UT_PER_GAUSS),
    "vel_n_mps": ("vel", 1.0),
    "attitude_deg": ("attitude", RAD_PER_DEG),
}
"""Quantity and factor by key, for keys with three numbers."""
NUMBERS: Final = {
    **{
        key: (key, 1.0)
        for key in (
            *("pressure_pa", "temperature_degc", "lat", "lon", "alt_m", "speed_mps", "course_deg"),
            *("climb_mps", "satellites", "h_acc_m", "v_acc_m", "airspeed_mps", "battery_v"),
            *("battery_a", "battery_mah", "battery_percent", "rssi_dbm", "snr_db", "link_percent"),
            *("t_ms", "id"),
        )
    },
    "pressure_hpa": ("pressure_pa", PA_PER_HPA),
    "heading_deg": ("heading_rad", RAD_PER_DEG),
}
"""Quantity and factor by key, for keys with one number."""
TEXTS: Final = ("mode", "text")
KEYS: Final = (*VECTORS, *NUMBERS, *TEXTS, "armed")
_NOTICE: Final = 5
"""MAV_SEVERITY_NOTICE."""
STATES: Final = {
    "attitude": "attitude_rad", "heading_rad": "heading_rad", "airspeed_mps": "airspeed_mps",
    "mode": "mode", "armed": "armed", "link_percent": "link_quality_percent",
}  # fmt: skip
BATTERY: Final = {
    "battery_v": "voltage_v", "battery_a": "current_a", "battery_mah": "used_mah",
    "battery_percent": "remaining_percent",
}  # fmt: skip
"""Fields of `VehicleReport` and of `BatteryReport` by quantity."""


class LinesDecoder(TextLines):
    """Decode lines of all three kinds."""

    def __init__(self, url: SourceUrl, node: NodeId) -> None:
        super().__init__(url.transport, MAX_LINE)
        self._node = node
        self._nmea = NmeaReader(node)
        column_map = url.options.get("columns")
        self._csv = None
        if column_map is not None:
            names = url.options.get("names", "")
            self._csv = CsvLines(read_column_map(column_map), names, node)
        self._clocks: dict[int, SampleClock] = {}
        self._has_own_id = "id" in url.options

    def line(self, line: str, arrival_us: int) -> list[SourceRecord | Fault]:
        """Return the records and faults in a line of any kind."""
        if line[0] == "{":
            return self._json(line, arrival_us)
        if line[0] in "$!":
            return [*self._nmea.line(line, arrival_us)]
        if line[0] == "#":
            return []
        if self._csv is not None:
            return self._csv.line(line, arrival_us)
        return [unusable("text", line, "neither JSON, NMEA nor CSV with a map (?columns=FILE)")]

    def _json(self, line: str, arrival_us: int) -> list[SourceRecord | Fault]:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError):
            return [unusable("json", line, "not a JSON object")]
        values = read_keys(content)
        unknown = [key for key in content if key not in KEYS]
        vehicle = values.get("id")
        node = self._node
        if isinstance(vehicle, float):
            if not (vehicle.is_integer() and 1 <= vehicle <= MAX_VEHICLE):
                return [unusable("id", line, f"id must be 1 to {MAX_VEHICLE}")]
            if self._has_own_id and vehicle != node.vehicle_id:
                return [unusable("id", line, f"this source is of vehicle {node.vehicle_id} only")]
            node = NodeId(int(vehicle), node.node_id)
        clock = self._clocks.setdefault(node.vehicle_id, SampleClock())
        stamp = values.get("t_ms")
        if isinstance(stamp, float) and 0.0 <= stamp < 1e15:
            time_us = clock.own(round(stamp * 1000.0), arrival_us)
        else:
            time_us = clock.arrival(arrival_us)
        records = records_of(values, node, time_us)
        faults: list[SourceRecord | Fault] = []
        if unknown:
            faults.append(unusable("json key", str(unknown[0]), "unknown key, ignored"))
        elif not records:
            faults.append(unusable("json", line, "has no key with a valid value"))
        return [*records, *faults]


def read_keys(content: Mapping[str, Any]) -> dict[str, float | Vec3 | str | bool]:
    """Read the known keys of an object by quantity, in SI except for deg/s; skip invalid values."""
    found: dict[str, float | Vec3 | str | bool] = {}
    for key, value in content.items():
        if key in VECTORS and isinstance(value, list) and len(value) == 3:
            quantity, factor = VECTORS[key]
            if all(is_number(each) for each in value):
                x, y, z = (float(each) * factor for each in value)
                found[quantity] = (x, y, z)
        elif key in NUMBERS and is_number(value):
            quantity, factor = NUMBERS[key]
            found[quantity] = float(value) * factor
        elif (key in TEXTS and isinstance(value, str)) or (
            key == "armed" and isinstance(value, bool)
        ):
            found[key] = value
    return found


def is_number(value: object) -> bool:
    """Return whether a JSON value is a finite number of plausible size."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e18


def records_of(
    values: Mapping[str, float | Vec3 | str | bool], node: NodeId, time_us: int
) -> list[SourceRecord]:
    """Make records from the quantities of one moment."""
    found: list[SourceRecord | None] = []
    get: Any = values.get
    degc = get("temperature_degc", NAN)
    if "pressure_pa" in values:
        found.append(BaroRaw(time_us, node, time_us & WRAP_MASK, get("pressure_pa"), degc))
    if "lat" in values and "lon" in values:
        found.append(_fix(values, node, time_us))
    if "accel" in values and "gyro" in values:
        found.append(imu_raw(time_us, node, get("accel"), get("gyro"), get("mag"), degc))
    found.append(_report(values, node, time_us))
    return [record for record in found if record is not None]


def _fix(values: Mapping[str, Any], node: NodeId, time_us: int) -> SourceRecord | None:
    get = values.get
    vel = get("vel")
    if vel is None:
        vel = velocity(get("speed_mps", NAN), get("course_deg", NAN), get("climb_mps", NAN))
    return fix_at(
        time_us,
        node,
        values["lat"],
        values["lon"],
        get("alt_m", NAN),
        vel_n_mps=vel,
        satellites=round(get("satellites", 0.0)),
        h_acc_m=get("h_acc_m", NAN),
        v_acc_m=get("v_acc_m", NAN),
    )


def _report(values: Mapping[str, Any], node: NodeId, time_us: int) -> VehicleReport | None:
    fields = {field: values[name] for name, field in STATES.items() if name in values}
    if battery := {field: values[name] for name, field in BATTERY.items() if name in values}:
        fields["battery"] = BatteryReport(**battery)
    if "text" in values:
        fields["text"] = (_NOTICE, values["text"])
    if "rssi_dbm" in values:
        fields["signal"] = RadioSignal(round(values["rssi_dbm"]), values.get("snr_db", NAN))
    return VehicleReport(time_us=time_us, node=node, **fields) if fields else None
