"""Facts of a flight: one accumulator, fed in one pass; all commands, files and pages use it.

Theory of operation. `FlightTally` collects the positions of one vehicle's best source, thinned to
one per `POINT_US`, with its armed and landed state; the facts are computed from these columns at
the end, because home may be known late. A `VehicleTally` is fed with the messages of a vehicle, a
`RowTally` with the rows of a table. Heights are above home, or else above the first position; a
fact names which. In the air is, for each position:

| known                                     | in the air                                          |
| ----------------------------------------- | --------------------------------------------------- |
| the vehicle moves on the surface          | never                                               |
| it was armed during the recording         | not while disarmed                                  |
| EXTENDED_SYS_STATE                        | as it reports                                       |
| otherwise, armed                          | faster than 3 m/s, or 3 m from the height of home   |
| otherwise, home                           | faster than 3 m/s and 3 m from its height, or 10 m  |
| otherwise                                 | faster than 3 m/s, or 10 m from the first height    |

Intervals shorter than `HELD_S` are merged with their neighbours.
"""

import math
from array import array
from dataclasses import dataclass
from hashlib import sha256
from typing import Final

import numpy as np

from gateway.recordings.columns import BoolArray, FloatArray
from gateway.recordings.recorded_clock import DAY_US, Gap, TimesSpan
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import (
    INTERRUPTION_US,
    Continuity,
    GroundDistance,
    LocalFrame,
    Position,
    TrackPoint,
)
from gateway.wire.recorded_frames import IntArray

POINT_US: Final = US_PER_S // 10
"""Minimum interval of positions and attitudes; closer ones add no information on a flight."""
MAX_TEXTS: Final = 10_000
"""Maximum number of texts, and of changes of mode, that are stored."""
AIRBORNE_MPS: Final = 3.0
"""Minimum ground speed in the air, more than that of a person who carries the aircraft."""
AIRBORNE_M: Final = 3.0
"""Minimum height in the air of an armed vehicle, more than the height noise of a take-off."""
UNARMED_M: Final = 10.0
"""The same where arming is unknown: heights of a GPS at rest drift by several metres."""
HELD_S: Final = 2.0
"""Minimum duration of an interval in the air or on the ground."""
HOME, FIRST = "home", "first position"
"""Zero of heights and distances."""
CHECKSUM_DIGITS: Final = 12
OUTAGE_US: Final = US_PER_S
"""Minimum length of an outage: a longer gap between fixes is one."""
OUTAGE_STEPS: Final = 2.5
"""Minimum length of an outage in usual intervals, for receivers with a low rate."""
NODE_WRAP_US: Final = 1 << 32
"""Period after which a node's 32-bit clock wraps to zero."""
LONGEST_LOSS_US: Final = 60 * US_PER_S
"""Longest gap counted as lost samples; in a longer one the node was switched off."""
_POINT: Final = (
    *("time_us", "lat_deg", "lon_deg", "alt_amsl_m", "alt_home_m", "speed_mps", "climb_mps"),
    *("armed", "landed", "broken"),
)
"""Columns of a position: the last three are 0 or 1; NaN is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightFacts:
    """Facts of one vehicle's flight; None is unknown. Times are those of the recording."""

    first_us: int | None
    duration_s: float
    gaps: tuple[Gap, ...]
    distance_m: float | None
    """Distance over ground; see `GroundDistance`."""
    airborne_s: float | None
    armed_s: float | None
    height_above: str | None
    """Zero of the heights and distances, `home` or `first position`."""
    highest_m: float | None
    fastest_mps: float | None
    climb_mps: float | None
    """Greatest climb rate, averaged over a second."""
    farthest_m: float | None
    take_off: tuple[float, float] | None
    """Latitude and longitude of the last position before the first flight."""
    gps_outages_us: tuple[tuple[int, int], ...] | None
    """Start and end of each outage."""
    errors: int
    """Number of bus errors and failed sensors of nodes, and of texts of severity ERROR or worse."""
    radio_loss: float | None
    """Proportion lost on the radio link: samples of a table, or as the vehicle reports it."""
    frames_lost: int
    """Frames missing in the sequence numbers of the vehicle."""
    frames_received: int
    used_mah: dict[int, int]
    """Charge used, by battery."""
    vibration_mps2: float | None
    satellites: int | None
    """Smallest number of satellites."""


@dataclass(frozen=True, slots=True)
class FlightTrackPoints:
    """Positions of a flight as columns, in the order of time; NaN is unknown."""

    time_us: IntArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    height_m: FloatArray
    """Height above home, or above the first position; see `FlightFacts.height_above`."""
    speed_mps: FloatArray
    climb_mps: FloatArray
    airborne: BoolArray
    broken: BoolArray
    """Whether the track is interrupted before a position."""

    def __len__(self) -> int:
        return len(self.time_us)

    def segments(self) -> list[list[TrackPoint]]:
        """Return the uninterrupted parts of the track."""
        columns = (self.time_us, self.lat_deg, self.lon_deg, self.alt_amsl_m)
        points = [TrackPoint(*one) for one in zip(*(c.tolist() for c in columns), strict=True)]
        edges = (np.flatnonzero(self.broken[1:]) + 1).tolist()
        begins, ends = [0, *edges], [*edges, len(points)]
        return [points[b:e] for b, e in zip(begins, ends, strict=True) if e > b]


class _Columns:
    """Columns of numbers that grow row by row."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._values) // len(self._names)

    def add(self, *row: float) -> None:
        self._values.extend(row)

    def arrays(self) -> dict[str, FloatArray]:
        table = np.frombuffer(self._values, np.float64).reshape(-1, len(self._names))
        return dict(zip(self._names, table.T, strict=True))


class FlightTally:
    """Collect the facts of one vehicle while its recording is read."""

    def __init__(self, *, with_attitude: bool = False) -> None:
        self.span = TimesSpan()
        self.ground = GroundDistance()
        self.texts: list[tuple[int, int, str]] = []
        """Time in µs, severity and text of the first texts."""
        self.modes: list[tuple[int, str]] = []
        """Times in µs and names of the first flight modes."""
        self.errors = self.frames_lost = self.frames_received = 0
        self.used_mah: dict[int, tuple[int, int]] = {}
        """First and last charge used, by battery."""
        self.vibration_mps2: float | None = None
        self.satellites: int | None = None
        self.attitude = _Columns(("time_us", "q_w", "q_x", "q_y", "q_z"))
        self.battery = _Columns(("time_us", "volts", "percent"))
        self.is_surface = False
        self.home: Position | None = None
        self._with_attitude = with_attitude
        self._points = _Columns(_POINT)
        self._continuity = Continuity()
        self._newest: dict[str, int] = {}
        self._gps_us, self._fixed = array("q"), array("b")
        self._armed = NAN
        self.landed = NAN
        """Whether the newest EXTENDED_SYS_STATE reports a flight, 0 or 1."""
        self._armed_us: int | None = None
        self._armed_total_us = 0

    def add_position(self, time_us: int, at: Position, boot_us: int | None = None) -> None:
        """Add a position; see `Continuity` for `boot_us`."""
        where = (time_us, at.lat_deg, at.lon_deg)
        self.ground.update(*where, boot_us)
        if not self._is_due("position", time_us, POINT_US):
            return
        is_broken = self._continuity.is_broken_at(*where, boot_us)
        self._points.add(
            *(*where, at.alt_amsl_m, at.alt_home_m, at.groundspeed_mps, -at.vel_n_mps[2]),
            *(self._armed, self.landed, is_broken),
        )

    def add_gps(self, time_us: int, *, fixed: bool) -> None:
        """Add a report of the receiver, and whether it has a fix."""
        self._gps_us.append(time_us)
        self._fixed.append(fixed)

    def add_armed(self, time_us: int, *, armed: bool) -> None:
        """Add a report of whether the vehicle is armed."""
        if self._armed == 1.0 and self._armed_us is not None:
            step_us = time_us - self._armed_us
            self._armed_total_us += step_us if 0 < step_us <= INTERRUPTION_US else 0
        self._armed, self._armed_us = float(armed), time_us

    def _is_due(self, kind: str, time_us: int, interval_us: int) -> bool:
        if 0 <= time_us - self._newest.get(kind, -interval_us) < interval_us:
            return False
        self._newest[kind] = time_us
        return True

    def points(self) -> FlightTrackPoints:
        """Return the positions, with heights, speeds and where the vehicle was in the air."""
        columns = self._points.arrays()
        time_us = columns["time_us"].astype(np.int64)
        lat, lon, broken = columns["lat_deg"], columns["lon_deg"], columns["broken"] == 1.0
        speed_mps = _known_speeds(time_us, lat, lon, columns["speed_mps"], broken)
        height_m, height_above = self._heights(columns)
        airborne = self._airborne(columns, height_m, height_above, speed_mps)
        return FlightTrackPoints(
            *(time_us, lat, lon, columns["alt_amsl_m"], height_m, speed_mps),
            *(columns["climb_mps"], airborne, broken),
        )

    def _heights(self, columns: dict[str, FloatArray]) -> tuple[FloatArray, str | None]:
        """Return the heights, and their zero."""
        alt_m, home_m = columns["alt_amsl_m"], columns["alt_home_m"]
        above = alt_m - self.home.alt_amsl_m if self.home else np.full(len(alt_m), NAN)
        # A sender that does not know its home fills the field with zeros.
        if np.any(home_m[np.isfinite(home_m)]):
            above = np.where(np.isfinite(home_m), home_m, above)
        if np.isfinite(above).any() or (self.home and len(alt_m)):
            return above, HOME
        known = alt_m[np.isfinite(alt_m)]
        return alt_m - known[0] if len(known) else alt_m, FIRST if len(alt_m) else None

    def _airborne(
        self,
        columns: dict[str, FloatArray],
        height_m: FloatArray,
        height_above: str | None,
        speed_mps: FloatArray,
    ) -> BoolArray:
        """Return where the vehicle was in the air, by the table above."""
        if self.is_surface:
            return np.zeros(len(speed_mps), np.bool_)
        armed, landed = columns["armed"], columns["landed"]
        was_armed, is_fast = bool((armed == 1.0).any()), speed_mps > AIRBORNE_MPS
        distance_m = np.abs(np.nan_to_num(height_m))
        if was_armed:
            in_air = is_fast | (distance_m > AIRBORNE_M)
        elif height_above == HOME:
            in_air = (is_fast & (distance_m > AIRBORNE_M)) | (distance_m > UNARMED_M)
        else:
            in_air = is_fast | (distance_m > UNARMED_M)
        in_air = np.where(np.isfinite(landed), landed == 1.0, in_air)
        if was_armed:
            in_air &= armed != 0.0
        return held(columns["time_us"] / US_PER_S, in_air)

    def facts(self) -> FlightFacts:
        """Return the facts so far."""
        found = self.points()
        span, home = self.span, self.home
        _, height_above = self._heights(self._points.arrays())
        steps_s = np.diff(found.time_us) / US_PER_S
        counts = (steps_s > 0.0) & (steps_s * US_PER_S <= INTERRUPTION_US) & ~found.broken[1:]
        flown = counts & found.airborne[1:]
        first = int(np.argmax(found.airborne)) if found.airborne.any() else 0
        take_off = (found.lat_deg[first - 1], found.lon_deg[first - 1]) if first else None
        fixed = np.array(self._fixed, np.bool_)
        outages = gps_outages_us(np.array(self._gps_us, np.int64), fixed, span.last_us or 0)
        return FlightFacts(
            first_us=span.first_us,
            duration_s=span.length_us / US_PER_S,
            gaps=tuple(span.gaps),
            distance_m=self.ground.distance_m,
            airborne_s=float(steps_s[flown].sum()) if len(found) else None,
            armed_s=None if math.isnan(self._armed) else self._armed_total_us / US_PER_S,
            height_above=height_above,
            highest_m=_greatest(found.height_m),
            fastest_mps=_greatest(found.speed_mps),
            climb_mps=_greatest(_over_a_second(found.time_us, found.climb_mps)),
            farthest_m=_farthest_m(found, home),
            take_off=take_off and (float(take_off[0]), float(take_off[1])),
            gps_outages_us=None if outages is None else tuple(outages),
            errors=self.errors,
            radio_loss=self.radio_loss,
            frames_lost=self.frames_lost,
            frames_received=self.frames_received,
            used_mah={number: last - first for number, (first, last) in self.used_mah.items()},
            vibration_mps2=self.vibration_mps2,
            satellites=self.satellites,
        )

    @property
    def radio_loss(self) -> float | None:
        """See `FlightFacts`."""
        return None

    def _restart(self) -> None:
        self.ground, self._continuity = GroundDistance(), Continuity()
        self._points = _Columns(_POINT)
        self._newest.clear()


def gps_outages_us(gps_us: IntArray, fixed: BoolArray, end_us: int) -> list[tuple[int, int]] | None:
    """Return start and end of each outage from the first fix on; None if there is no fix at all.

    `gps_us`, shape (n,), are the times of all reports of the receiver; `fixed` marks reports with a
    fix.
    """
    fixes_us = gps_us[fixed]
    if not len(fixes_us):
        return None
    usual_us = float(np.median(np.diff(gps_us))) if len(gps_us) > 1 else 0.0
    ends_us = np.append(fixes_us[1:], max(end_us, int(fixes_us[-1])))
    gaps_us = ends_us - fixes_us
    # A gap of days is a jump of the clock, not an outage.
    is_outage = (gaps_us > max(OUTAGE_US, OUTAGE_STEPS * usual_us)) & (gaps_us <= DAY_US)
    begins, ends = fixes_us[is_outage].tolist(), ends_us[is_outage].tolist()
    return list(zip(begins, ends, strict=True))


def missing_samples(node_time_us: IntArray) -> FloatArray:
    """Count the samples missing before each sample except the first, by the node's own clock."""
    interval_us = np.diff(node_time_us) % NODE_WRAP_US
    usual_us = np.median(interval_us[interval_us > 0]) if interval_us.any() else 1.0
    missing = np.maximum(np.rint(interval_us / usual_us) - 1.0, 0.0)
    return np.where(interval_us > LONGEST_LOSS_US, 0.0, missing)


def lost_share(node_time_us: IntArray) -> float | None:
    """Return the proportion of missing samples; None for fewer than two samples."""
    if len(node_time_us) < 2:
        return None
    lost = float(missing_samples(node_time_us).sum())
    return lost / (lost + len(node_time_us))


def checksum(data: bytes) -> str:
    """Return a short checksum of settings."""
    return sha256(data).hexdigest()[:CHECKSUM_DIGITS]


def held(seconds: FloatArray, state: BoolArray) -> BoolArray:
    """Merge intervals shorter than `HELD_S` with their neighbours, first those on the ground."""
    found = state.copy()
    for wanted in (False, True):
        edges = np.flatnonzero(np.diff(found)) + 1
        for begin, end in zip([0, *edges], [*edges, len(found)], strict=True):
            inner = begin > 0 and end < len(found)
            if inner and found[begin] == wanted and seconds[end - 1] - seconds[begin] < HELD_S:
                found[begin:end] = not wanted
    return found


def _known_speeds(
    time_us: IntArray, lat: FloatArray, lon: FloatArray, speed_mps: FloatArray, broken: BoolArray
) -> FloatArray:
    """Return the ground speeds; unknown ones from the step since the position before."""
    if np.isfinite(speed_mps).all() or len(speed_mps) < 2:
        return speed_mps
    frame = LocalFrame(float(lat[0]), float(lon[0]), 0.0)
    steps_m = np.hypot(*np.diff(frame.local_m(lat, lon), axis=0).T)
    step_s = np.diff(time_us) / US_PER_S
    sound = (step_s > 0.0) & ~broken[1:]
    found = np.full(len(lat), NAN)
    found[1:][sound] = steps_m[sound] / step_s[sound]
    return np.where(np.isfinite(speed_mps), speed_mps, found)


def _greatest(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _over_a_second(time_us: IntArray, values: FloatArray) -> FloatArray:
    """Return the moving average over a second, ignoring unknown values."""
    if len(values) < 2:
        return values
    usual_us = max(float(np.median(np.diff(time_us))), 1.0)
    window, known = np.ones(max(round(US_PER_S / usual_us), 1)), np.isfinite(values)
    total = np.convolve(np.where(known, values, 0.0), window, "same")[: len(values)]
    number = np.convolve(known.astype(float), window, "same")[: len(values)]
    return np.where(number > 0, total / np.maximum(number, 1.0), NAN)


def _farthest_m(found: FlightTrackPoints, home: Position | None) -> float | None:
    """Return the greatest distance from home, or from the first position."""
    if not len(found):
        return None
    zero = (home.lat_deg, home.lon_deg) if home else (found.lat_deg[0], found.lon_deg[0])
    frame = LocalFrame(float(zero[0]), float(zero[1]), 0.0)
    return float(np.hypot(*frame.local_m(found.lat_deg, found.lon_deg).T).max())
