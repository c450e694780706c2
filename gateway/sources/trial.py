"""Test a source: describe records and faults, rates, and data that a vehicle would lack."""

import math
import re
from collections import Counter
from typing import Final

from gateway.records import BaroRaw, GpsFix, ImuFlags, ImuRaw, VehicleReport
from gateway.sources.sampling import COUNTS_PER_DPS, COUNTS_PER_MPS2, COUNTS_PER_UT
from gateway.sources.settings import SourceUrl
from gateway.sources.source import SourceRecord
from gateway.units import DEG_PER_DEGE7, DEGE7_PER_DEG
from gateway.wire.framing import Fault

GUESSES: Final = (
    (r"^(t|time|timestamp|millis|t_?ms)$", "time_us"),
    *((rf"^(a|acc|accel\w*)_?{axis}\b", f"accel_{axis}_b_mps2") for axis in "xyz"),
    *((rf"^(g|gyr|gyro\w*)_?{axis}\b", f"gyro_{axis}_b_radps") for axis in "xyz"),
    *((rf"^(m|mag\w*)_?{axis}\b", f"mag_{axis}_b_ut") for axis in "xyz"),
    (r"^(p|press\w*|baro\w*)\b", "baro_pressure_pa"),
    (r"^(lat|latitude)\b", "gps_lat_dege7"),
    (r"^(lon|lng|longitude)\b", "gps_lon_dege7"),
    (r"^(alt|altitude)\b", "gps_alt_amsl_m"),
    (r"^(speed|gspeed|groundspeed)\b", "gps_speed_mps"),
    (r"^(course|heading|cog)\b", "gps_course_deg"),
)
"""Column names that users and this project use, by quantity."""
DEGE7: Final = frozenset({"gps_lat_dege7", "gps_lon_dege7"})
LEAST_NAMES: Final = 3
WIRING: Final = "its TX to the RX here, and a common ground"
NAMES: Final = {
    "lines": "a line of JSON, NMEA or mapped CSV",
    "crsf": "CRSF",
    "ltm": "LTM",
    "phone": "from a known app",
}
NEEDS: Final = {
    "lines": (
        "accelerometer and gyroscope in one object (accel_mps2, gyro_dps), or attitude_deg",
        "lat, lon and alt_m, or NMEA with GGA",
    ),
    "crsf": ("attitude frames (0x1E) of the flight controller", "GPS frames (0x02) with a fix"),
    "ltm": ("A frames of the flight controller", "G frames with a fix"),
    "phone": ("accelerometer and gyroscope, both switched on in the app", "location with height"),
}
"""What attitude and position need, by kind."""
KINDS: Final[dict[type, str]] = {
    ImuRaw: "accelerometer and gyroscope",
    BaroRaw: "barometer",
    GpsFix: "GPS",
    VehicleReport: "states",
}
"""Names of the types of records."""


def describe(event: SourceRecord | Fault) -> str:
    """Describe a record or a fault in one line."""
    match event:
        case Fault():
            return f"unused ({event.kind}): {event.detail}"
        case ImuRaw():
            accel = _vector(event.accel_raw, COUNTS_PER_MPS2)
            gyro = _vector(event.gyro_raw, COUNTS_PER_DPS)
            has_mag = event.flags & ImuFlags.MAG_NEW
            mag = f", compass {_vector(event.mag_raw, COUNTS_PER_UT)} uT" if has_mag else ""
            return f"accelerometer {accel} m/s2, gyroscope {gyro} deg/s{mag}"
        case BaroRaw():
            return f"barometer {event.pressure_pa / 100.0:.2f} hPa"
        case GpsFix():
            place = f"{event.lat_dege7 * DEG_PER_DEGE7:.6f} {event.lon_dege7 * DEG_PER_DEGE7:.6f}"
            fix = f"fix {place} {event.alt_amsl_m:.1f} m" if event.fix_ok else "no fix"
            return f"GPS {fix}, {event.satellites} satellites"
        case VehicleReport():
            return f"state {', '.join(_fields(event))}"


def _vector(counts: tuple[int, int, int], per_unit: float) -> str:
    return " ".join(f"{count / per_unit:.2f}" for count in counts)


def _fields(report: VehicleReport) -> list[str]:
    """List the fields of a report with their values."""
    found = []
    for name in report.__struct_fields__[2:]:
        value = getattr(report, name)
        if value in (None, "", ()) or value != value:
            continue
        if name == "attitude_rad":
            angles = (f"{math.degrees(angle):.1f}" for angle in value)
            found.append(f"roll, pitch, yaw {' '.join(angles)} deg")
        elif name == "battery":
            found.append(f"battery {value.voltage_v:.2f} V")
        elif name == "signal":
            found.append(f"signal {value.rssi_dbm} dBm, SNR {value.snr_db:g} dB")
        else:
            found.append(f"{name} {value}")
    return found


class SourceTrial:
    """Count the records and faults of a source, and summarise them."""

    def __init__(self, url: SourceUrl) -> None:
        self._url = url
        self.counts: Counter[str] = Counter()
        """Number of records and faults, by kind."""
        self.records = 0
        self._bytes = 0
        self._has_mag = self._has_fix = self._has_height = self._has_attitude = False
        self._header = ""

    def feed(self, event: SourceRecord | Fault) -> int:
        """Count a record or a fault; return the number of its kind so far."""
        kind = f"fault {event.kind}" if isinstance(event, Fault) else KINDS[type(event)]
        self.counts[kind] += 1
        self.records += not isinstance(event, Fault)
        if isinstance(event, ImuRaw):
            self._has_mag |= bool(event.flags & ImuFlags.MAG_NEW)
        elif isinstance(event, GpsFix):
            self._has_fix |= event.fix_ok
            self._has_height |= event.fix_ok and math.isfinite(event.alt_amsl_m)
        elif isinstance(event, VehicleReport):
            self._has_attitude |= event.attitude_rad is not None
        return self.counts[kind]

    def look_at(self, data: bytes) -> None:
        """Count bytes, and store the first line that may contain column names for a map."""
        self._bytes += len(data)
        for line in data.decode("utf-8", "replace").splitlines():
            names = re.findall(r"[A-Za-z]\w*", line)
            if not self._header and len(names) >= LEAST_NAMES and suggested_map(line):
                self._header = line

    def summary(self, seconds: float, reason: str = "") -> list[str]:
        """Summarise the test: rates, missing data, and a map with which CSV can be read.

        `reason` is that for which the source is not connected.
        """
        if not self._bytes:
            why = f"not connected: {reason}" if reason else self._checks()
            return [f"nothing received in {seconds:g} s: {why}"]
        lines = [f"{kind}: {n}, {n / seconds:.1f} a second" for kind, n in self.counts.items()]
        if self.records:
            lines += self._missing()
        else:
            what = NAMES.get(self._url.kind, self._url.kind)
            causes = "does the sender use another protocol?"
            if self._url.transport == "serial" and self._url.endpoint is not None:
                baud = self._url.endpoint.port
                causes = f"baud rate {baud} (?baud=)? inverted signal? another protocol?"
            lines.append(f"{self._bytes} bytes arrive, none is {what}: {causes}")
        if self._url.kind == "lines" and self._header and not self.counts[KINDS[ImuRaw]]:
            lines += ["a map for ?columns=FILE; check its units:", *suggested_map(self._header)]
        return lines

    def _checks(self) -> str:
        """Name what may be wrong outside of this program if nothing arrives."""
        endpoint = self._url.endpoint
        if endpoint is None:
            return "check the sender"
        if self._url.transport == "serial":
            rate = f"baud rate {endpoint.port} (?baud=)"
            return f"check port {endpoint.host}, {rate} and wiring ({WIRING})"
        return f"check that the sender uses {endpoint.address} of this machine, and the firewall"

    def _missing(self) -> list[str]:
        """Name the data that attitude, heading and position lack."""
        attitude_needs, position_needs = NEEDS.get(self._url.kind, ("IMU samples", "a GPS fix"))
        lines = ["attitude: yes"]
        if not self._has_attitude and not self.counts[KINDS[ImuRaw]]:
            lines = [f"attitude: no; it needs {attitude_needs}"]
        if self.counts[KINDS[ImuRaw]] and not self._has_mag:
            lines.append("heading: only in flight, from GPS; else from a compass")
        if self._has_height:
            return [*lines, "position: yes"]
        needs = "a height" if self._has_fix else position_needs
        return [*lines, f"position: no; it needs {needs}"]


def suggested_map(header: str) -> list[str]:
    """Suggest a map for the columns in a line of names; empty if it has no known ones."""
    cells = [cell.strip(' "') for cell in re.split(r"[,;\t]", header)]
    found = {}
    for cell in cells:
        ours = next((name for pattern, name in GUESSES if re.match(pattern, cell.lower())), None)
        if ours is not None and ours not in found:
            scale = DEGE7_PER_DEG if ours in DEGE7 else 1000.0 if ours == "time_us" else 1.0
            found[ours] = f'{ours} = {{ column = "{cell}", scale = {scale:g} }}'
    return ["[columns]", *found.values()] if "time_us" in found and len(found) > 1 else []
