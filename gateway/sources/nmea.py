"""Convert NMEA 0183 sentences of any talker to fixes: GGA, RMC, VTG, GSA, GST and HDT.

Receivers distribute one fix over several sentences of the same time of day, in any order. A fix is
complete with GGA and RMC of one time, or with one of them if the receiver sends only that. The
content of the other sentences is added to the next fix.
"""

import math
import re
from datetime import UTC, datetime
from typing import Final

from gateway.records import NAN, GpsFix, GpsFixType, NodeId, VehicleReport
from gateway.sources.sampling import fix_at, velocity
from gateway.sources.source import unusable
from gateway.units import KMH_PER_MPS, KNOTS_PER_MPS, US_PER_S
from gateway.wire.framing import Fault, xor_of

SENTENCE: Final = re.compile(r"[$!](\w{2})(\w{3})((?:,[^*]*)?)(?:\*([0-9A-Fa-f]{2}))?")
DEG_MIN: Final = re.compile(r"(\d{0,3}?)(\d{1,2}(?:\.\d*)?)")
LIMITS_DEG: Final = {"N": 90.0, "S": 90.0, "E": 180.0, "W": 180.0}
FIRST_CENTURY: Final = 80
"""Years of two digits from this one on are before 2000: the epoch of GPS is in 1980."""
UERE_M: Final = 4.0
"""User-equivalent range error, m, which converts a DOP to an accuracy if there is no GST."""
MAX_AGE_US: Final = 3 * US_PER_S
"""Maximum age of VTG, GSA and GST, to be used with a fix."""
FIX_TYPES: Final = {"1": GpsFixType.NONE, "2": GpsFixType.FIX_2D, "3": GpsFixType.FIX_3D}
IGNORED: Final = frozenset({"GSV", "GLL", "TXT", "ZDA", "GNS", "GBS", "GRS", "DTM", "VLW"})


class NmeaReader:
    """Combine the sentences of one receiver to fixes."""

    def __init__(self, node: NodeId) -> None:
        self._node = node
        self._epoch: dict[str, list[str]] = {}
        """GGA and RMC of the time in progress."""
        self._time = ""
        self._both = False
        """Whether the previous time had both GGA and RMC."""
        self._done = False
        self._extra: dict[str, tuple[int, list[str]]] = {}
        """Arrival time and fields of the newest VTG, GSA and GST."""

    def line(self, line: str, arrival_us: int) -> list[GpsFix | VehicleReport | Fault]:
        """Process one sentence."""
        found = SENTENCE.fullmatch(line)
        if found is None:
            return [unusable("nmea", line, "not an NMEA sentence")]
        _, kind, fields, check = found.groups()
        content = line[1:].partition("*")[0].encode("latin-1", "replace")
        if check is not None and int(check, 16) != xor_of(content):
            return [unusable("nmea checksum", line, "wrong checksum")]
        try:
            return self._sentence(kind, fields.split(",")[1:], arrival_us)
        except (ValueError, IndexError):
            return [unusable("nmea", line, f"{kind} has a field that cannot be read")]

    def _sentence(
        self, kind: str, fields: list[str], arrival_us: int
    ) -> list[GpsFix | VehicleReport | Fault]:
        if kind in ("GGA", "RMC"):
            fix = self._collect(kind, fields, arrival_us)
            return [] if fix is None else [fix]
        if kind in ("VTG", "GSA", "GST"):
            self._extra[kind] = (arrival_us, fields)
            return []
        if kind == "HDT" and fields[0]:
            heading = math.radians(float(fields[0]))
            return [VehicleReport(time_us=arrival_us, node=self._node, heading_rad=heading)]
        if kind in IGNORED or kind == "HDT":
            return []
        return [unusable("nmea unknown", kind, "sentence is not used")]

    def _collect(self, kind: str, fields: list[str], arrival_us: int) -> GpsFix | None:
        if fields[0] != self._time or kind in self._epoch:
            self._both = len(self._epoch) > 1
            self._epoch, self._time, self._done = {}, fields[0], False
        self._epoch[kind] = fields
        if self._done or (self._both and len(self._epoch) < 2):
            return None
        self._done = True
        return self._fix(arrival_us)

    def _newest(self, kind: str, arrival_us: int) -> list[str]:
        since_us, fields = self._extra.get(kind, (-MAX_AGE_US - 1, []))
        return fields if arrival_us - since_us <= MAX_AGE_US else []

    def _fix(self, arrival_us: int) -> GpsFix | None:
        gga, rmc = self._epoch.get("GGA", []), self._epoch.get("RMC", [])
        at = gga[1:] if gga else rmc[2:]
        lat, lon = _degrees(at[0], at[1]), _degrees(at[2], at[3])
        gsa = self._newest("GSA", arrival_us)
        hdop = _number(gga[7]) if gga else NAN
        pdop = _number(gsa[14]) if len(gsa) > 14 else NAN
        h_acc, v_acc = self._accuracies(hdop, pdop, arrival_us)
        valid = gga[5] not in ("", "0") if gga else rmc[1] == "A"
        if rmc and (rmc[1] == "V" or rmc[11:12] == ["N"]):
            # NMEA 2.3 adds a mode, of which N means that the data is not valid.
            valid = False
        fix_type = FIX_TYPES.get(gsa[1]) if len(gsa) > 1 and valid else None
        return fix_at(
            arrival_us,
            self._node,
            lat if valid else 0.0,
            lon if valid else 0.0,
            _number(gga[8]) if gga else NAN,
            vel_n_mps=velocity(*self._motion(rmc, arrival_us), climb_mps=NAN),
            satellites=int(gga[6] or 0) if gga else 0,
            fix_type=fix_type if valid else GpsFixType.NONE,
            h_acc_m=h_acc,
            v_acc_m=v_acc,
            pdop=pdop,
            utc_us=_utc_us(rmc) if rmc and valid else None,
        )

    def _motion(self, rmc: list[str], arrival_us: int) -> tuple[float, float]:
        """Return ground speed in m/s and course in degrees."""
        if rmc:
            return _number(rmc[6]) / KNOTS_PER_MPS, _number(rmc[7])
        vtg = self._newest("VTG", arrival_us)
        return (_number(vtg[6]) / KMH_PER_MPS, _number(vtg[0])) if len(vtg) > 6 else (NAN, NAN)

    def _accuracies(self, hdop: float, pdop: float, arrival_us: int) -> tuple[float, float]:
        gst = self._newest("GST", arrival_us)
        if len(gst) > 7:
            lat_m, lon_m, alt_m = (_number(gst[k]) for k in (5, 6, 7))
            if lat_m == lat_m and lon_m == lon_m:
                return math.hypot(lat_m, lon_m), alt_m
        v_sq = pdop * pdop - hdop * hdop
        return hdop * UERE_M, math.sqrt(v_sq) * UERE_M if v_sq > 0.0 else NAN


def _number(text: str) -> float:
    if not text:
        return NAN
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _degrees(text: str, side: str) -> float:
    """Convert degrees and minutes, such as 4807.038 and N, to degrees; NaN if empty."""
    if not text:
        return NAN
    found = DEG_MIN.fullmatch(text)
    if found is None or side not in LIMITS_DEG or float(found[2]) >= 60.0:
        raise ValueError(text)
    value = int(found[1] or 0) + float(found[2]) / 60.0
    if value > LIMITS_DEG[side]:
        raise ValueError(text)
    return -value if side in ("S", "W") else value


def _utc_us(rmc: list[str]) -> int | None:
    time, date = rmc[0], rmc[8]
    if len(time) < 6 or len(date) != 6:
        return None
    day, month, year = (int(date[k : k + 2]) for k in (0, 2, 4))
    year += 1900 if year >= FIRST_CENTURY else 2000
    hour, minute = int(time[:2]), int(time[2:4])
    whole_us = datetime(year, month, day, hour, minute, tzinfo=UTC).timestamp() * US_PER_S
    return round(whole_us + _number(time[4:]) * US_PER_S)
