"""What the catalogue says of one flight, computed from its positions and fixes in one pass."""

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.analysis.pilot_figures import AIRBORNE_M, AIRBORNE_MPS, OUTAGE_S
from gateway.geometry.angle import wrap_180
from gateway.recordings.moment import civil_time
from gateway.recordings.summary import GroundDistance
from gateway.recordings.tlog import DAY_US
from gateway.season.statistics.track_shape import Place, simplified
from gateway.units import US_PER_S

POINT_US: Final = US_PER_S // 10
"""Positions nearer in time than this add nothing new of a flight."""
SILENCE_STEPS: Final = 2.5
"""So many usual intervals without a fix are an outage, where fixes come seldom."""
EARLIEST_US: Final = 315_532_800 * US_PER_S
"""1980, when GPS began: what is earlier counts from the start of a clock."""
LOST_STEP: Final = 1.5
"""So many usual intervals between two samples are a loss."""


class FlightFacts(msgspec.Struct, frozen=True, kw_only=True):
    """One flight in the catalogue; None is what is not known.

    The names are those of the columns that a query may use.
    """

    vehicle: int | None = None
    """MAVLink system id."""
    began: str | None = None
    """Begin, UTC: YYYY-MM-DD HH:MM:SS."""
    duration: float | None = None
    """From the first record to the last, s."""
    distance: float | None = None
    """Over ground, m."""
    highest: float | None = None
    """Above the first position, m."""
    fastest: float | None = None
    """Over ground, m/s."""
    lat_min: float | None = None
    """South end, deg."""
    lat_max: float | None = None
    """North end, deg."""
    lon_min: float | None = None
    """West end, deg."""
    lon_max: float | None = None
    """East end; below lon_min across 180 degrees, deg."""
    takeoff_lat: float | None = None
    """Where it left the ground, deg."""
    takeoff_lon: float | None = None
    """Where it left the ground, deg."""
    gps_outages: int | None = None
    """Silences of the GPS."""
    gps_lost: float | None = None
    """All of them together, s."""
    faults: int | None = None
    """Bus errors and failed sensors of the nodes; texts of severity ERROR."""
    loss: float | None = None
    """Share of the samples lost on the radio, 0 to 1."""
    damaged: int | None = None
    """Damaged bytes of the file."""
    version: str | None = None
    """Of mavgate, or of the autopilot's firmware."""
    settings: str | None = None
    """Checksum of settings and calibration."""


UNITS: Final = {
    "duration": "s", "distance": "m", "highest": "m", "fastest": "m/s", "gps_lost": "s",
    **dict.fromkeys(("lat_min", "lat_max", "lon_min", "lon_max"), "deg"),
    "takeoff_lat": "deg", "takeoff_lon": "deg", "damaged": "bytes", "size": "bytes",
}  # fmt: skip
"""Of the columns that have one; `size` is that of the file."""


class FlightTally:
    """Gathers what is known of one vehicle while its recording goes by."""

    def __init__(self) -> None:
        self.way = GroundDistance()
        self.points: list[tuple[int, float, float, float, float]] = []
        self._gps_us: list[int] = []
        self._fixed: list[bool] = []
        self.faults = 0

    def add_position(self, time_us: int, place: Place, speed_mps: float) -> None:
        """Take a position in: latitude and longitude in deg, height in m, ground speed in m/s."""
        self.way.add(time_us, place[0], place[1])
        if self.points and 0 <= time_us - self.points[-1][0] < POINT_US:
            return
        self.points.append((time_us, *place, speed_mps))

    def prefer_positions_of(self, other: "FlightTally") -> None:
        """Use the positions of another tally, if it has any."""
        if other.points:
            self.points, self.way = other.points, other.way

    def add_gps(self, time_us: int, *, fixed: bool) -> None:
        """Note that the receiver sent something, and whether it had a fix."""
        self._gps_us.append(time_us)
        self._fixed.append(fixed)

    def facts(self, end_us: int | None) -> FlightFacts:
        """Sum up, with all that depends on positions and fixes alone."""
        outages, lost_s = self._outages(end_us)
        known = FlightFacts(gps_outages=outages, gps_lost=lost_s, faults=self.faults)
        if not self.points:
            return known
        points = np.array(self.points, np.float64)
        lat, lon, alt, speed = points[:, 1:].T
        height = alt - alt[0]
        west, east = _longitudes(lon)
        flying = np.flatnonzero((speed > AIRBORNE_MPS) & (height > AIRBORNE_M))
        takeoff = max(int(flying[0]) - 1, 0) if len(flying) else None
        return msgspec.structs.replace(
            known,
            distance=self.way.distance_m,
            highest=_greatest(height),
            fastest=_greatest(speed),
            lat_min=float(lat.min()),
            lat_max=float(lat.max()),
            lon_min=west,
            lon_max=east,
            takeoff_lat=None if takeoff is None else float(lat[takeoff]),
            takeoff_lon=None if takeoff is None else float(lon[takeoff]),
        )

    def track(self) -> list[Place]:
        """Return the way as few places as show it."""
        return simplified([(lat, lon, alt) for _, lat, lon, alt, _ in self.points])

    def _outages(self, end_us: int | None) -> tuple[int | None, float | None]:
        times = np.array(self._gps_us, np.int64)
        fixed = times[np.array(self._fixed, np.bool_)]
        if not len(fixed):
            return None, None
        usual_s = float(np.median(np.diff(times))) / US_PER_S if len(times) > 1 else 0.0
        longest_s = max(OUTAGE_S, SILENCE_STEPS * usual_s)
        last_us = max(end_us or 0, int(fixed[-1]))
        silences_s = np.diff(np.append(fixed, last_us)) / US_PER_S
        # A clock that leaps by days is no silence.
        outages = silences_s[(silences_s > longest_s) & (silences_s <= DAY_US / US_PER_S)]
        return len(outages), float(outages.sum())


def began_text(unix_us: int | None) -> str | None:
    """Write a civil time as the catalogue does; None if it can be none."""
    moment = None if unix_us is None or unix_us < EARLIEST_US else civil_time(unix_us)
    return None if moment is None else f"{moment:%Y-%m-%d %H:%M:%S}"


def lost_share(times_us: NDArray[np.int64]) -> float | None:
    """Estimate which share of samples is missing between those that came at a steady rate.

    Parameters
    ----------
    times_us : ndarray, shape (N,)
        Of the samples, on the clock of who sampled them; a restart sets it back.
    """
    steps = np.diff(times_us)
    steps = steps[steps > 0]
    if not len(steps):
        return None
    counts = steps / np.median(steps)
    lost = float((np.rint(counts[counts > LOST_STEP]) - 1.0).sum())
    return lost / (lost + len(times_us))


def _greatest(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _longitudes(lon_deg: NDArray[np.float64]) -> tuple[float, float]:
    """Return the west and the east end, the short way round."""
    turned = lon_deg[0] + wrap_180(lon_deg - lon_deg[0])
    west, east = float(turned.min()), float(turned.max())
    return (wrap_180(west), wrap_180(east))
