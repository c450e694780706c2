"""One flight for the analysis: calibrated samples as arrays, and the truth if known.

Flights of all sources have the same form: arrays on the gateway clock, one row per IMU sample, and
the GPS fixes as the records that an estimator takes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.estimation.reference import ReferenceSettings, is_usable
from gateway.estimation.select import EstimationSettings
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m
from gateway.records import (
    UNKNOWN_VEC3,
    BaroRaw,
    BaroSample,
    GpsFix,
    ImuCalibrated,
    ImuRaw,
    ImuSample,
    NavFlags,
    NavState,
    RawRecord,
    Vec3,
)
from gateway.sensing.calibration import (
    IDENTITY3,
    Correction,
    NodeCalibration,
    mag_from_counts,
)
from gateway.sensing.chain import SensorChain
from gateway.settings import Settings
from gateway.units import DEG_PER_DEGE7, US_PER_S

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SETTLING_US: Final = 5_000_000
"""After the first fix; earlier samples are not scored."""


class FusionSettings(Settings, frozen=True):
    """All settings that affect the fusion of a flight."""

    estimation: EstimationSettings = EstimationSettings()


@dataclass(frozen=True, slots=True)
class FlightTrack:
    """Attitude, position and velocity at N times."""

    time_us: IntArray
    q_nb: FloatArray
    """Shape (N, 4), scalar first; NaN where not known."""
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    vel_n_mps: FloatArray
    """Shape (N, 3), NED."""

    def where_valid(self, flags: IntArray) -> "FlightTrack":
        """Set values to NaN that the estimator does not flag as valid.

        An attitude counts as known without a heading only if there never is one.
        """

        def masked(values: FloatArray, flag: NavFlags) -> FloatArray:
            valid = (flags & int(flag)) != 0
            return np.where(valid if values.ndim == 1 else valid[:, np.newaxis], values, np.nan)

        q_nb = masked(self.q_nb, NavFlags.ATTITUDE_VALID)
        headed = (flags & int(NavFlags.HEADING_VALID)) != 0
        if headed.any():
            q_nb[: int(np.argmax(headed))] = np.nan
        return FlightTrack(
            time_us=self.time_us,
            q_nb=q_nb,
            lat_deg=masked(self.lat_deg, NavFlags.POSITION_VALID),
            lon_deg=masked(self.lon_deg, NavFlags.POSITION_VALID),
            alt_amsl_m=masked(self.alt_amsl_m, NavFlags.ALTITUDE_VALID),
            vel_n_mps=masked(self.vel_n_mps, NavFlags.VELOCITY_VALID),
        )


@dataclass(frozen=True, slots=True)
class Reference:
    """The reference of an estimate, at the times of the IMU samples."""

    track: FlightTrack
    is_exact: bool
    """Whether it is the exact truth and not another estimate."""
    story: str
    """One sentence: where it comes from."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight's samples."""

    name: str
    story: str
    """One sentence: where it comes from."""
    fusion: FusionSettings
    """The settings that belong to it, such as its GPS latency."""
    time_us: IntArray
    """Shape (N,), of the IMU samples."""
    accel_b_mps2: FloatArray
    """Shape (N, 3), specific force, calibrated."""
    gyro_b_radps: FloatArray
    mag_b_ut: FloatArray
    """Shape (N, 3), calibrated, NaN unless newly sampled."""
    flags: IntArray
    """`ImuFlags`."""
    baro_time_us: IntArray
    baro_alt_m: FloatArray
    """Height in the standard atmosphere."""
    fixes: tuple[GpsFix, ...]
    scored: BoolArray
    """Shape (N,), which samples count for errors."""
    mag_uncalibrated_b_ut: FloatArray | None = None
    node_time_us: IntArray | None = None
    """When the node sampled, on its own clock."""
    reference: Reference | None = None
    recorded: FlightTrack | None = None
    """The states fused in flight."""

    @property
    def time_s(self) -> FloatArray:
        """Seconds since the first sample."""
        return self.seconds(self.time_us)

    @property
    def duration_s(self) -> float:
        """From the first to the last sample."""
        return float(self.time_s[-1])

    @property
    def rate_hz(self) -> float:
        """IMU samples a second, by the median interval; by the mean one where most are zero."""
        intervals_us = np.diff(self.time_us)
        typical_us = float(np.median(intervals_us)) or max(float(np.mean(intervals_us)), 1.0)
        return US_PER_S / typical_us

    @property
    def latency_s(self) -> float:
        """How old a fix is at its arrival."""
        return self.fusion.estimation.reference.gps_latency_s

    def seconds(self, time_us: IntArray) -> FloatArray:
        """Convert gateway times to seconds since the first sample."""
        return np.asarray((time_us - self.time_us[0]) / US_PER_S, np.float64)

    def with_fixes(self, fixes: Iterable[GpsFix]) -> "Flight":
        """Return the same flight with other fixes."""
        return replace(self, fixes=tuple(fixes))


@dataclass(frozen=True, slots=True)
class Fixes:
    """The usable fixes of a flight as arrays."""

    arrival_us: IntArray
    valid_us: IntArray
    """When each fix was true."""
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    vel_n_mps: FloatArray
    """Shape (M, 3)."""

    def __len__(self) -> int:
        return len(self.arrival_us)


def fixes_of(flight: Flight) -> Fixes:
    """Return the fixes that an estimator would use."""
    reference = flight.fusion.estimation.reference
    used = [fix for fix in flight.fixes if is_usable(fix, reference)]
    arrival = np.array([fix.time_us for fix in used], np.int64)
    return Fixes(
        arrival_us=arrival,
        valid_us=arrival - round(reference.gps_latency_s * US_PER_S),
        lat_deg=np.array([fix.lat_dege7 for fix in used]) * DEG_PER_DEGE7,
        lon_deg=np.array([fix.lon_dege7 for fix in used]) * DEG_PER_DEGE7,
        alt_amsl_m=np.array([fix.alt_amsl_m for fix in used], np.float64),
        vel_n_mps=np.array([fix.vel_n_mps for fix in used], np.float64).reshape(-1, 3),
    )


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """Metres north and east of one position."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def north_m(self, lat_deg: FloatArray) -> FloatArray:
        """Convert latitudes to metres north."""
        meridian, _ = radii_m(self.lat_deg, self.alt_m)
        return np.asarray(np.radians(lat_deg - self.lat_deg) * meridian)

    def east_m(self, lon_deg: FloatArray) -> FloatArray:
        """Convert longitudes to metres east, the shortest way round."""
        _, parallel = radii_m(self.lat_deg, self.alt_m)
        return np.asarray(np.radians(wrap_180(lon_deg - self.lon_deg)) * parallel)

    def place(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """Convert positions to metres, shape (N, 2): north and east."""
        return np.column_stack([self.north_m(lat_deg), self.east_m(lon_deg)])


def local_frame(flight: Flight) -> LocalFrame | None:
    """Return a frame with its origin at the first usable fix; None without one."""
    fixes = fixes_of(flight)
    if not len(fixes):
        return None
    return LocalFrame(float(fixes.lat_deg[0]), float(fixes.lon_deg[0]), float(fixes.alt_amsl_m[0]))


def flight_of_records(
    records: Iterable[RawRecord | ImuCalibrated],
    calibration: NodeCalibration,
    *,
    name: str,
    story: str,
    fusion: FusionSettings,
) -> Flight:
    """Calibrate raw records into a flight."""
    chain = SensorChain(calibration)
    turned = Correction(calibration.mag_mounting, IDENTITY3, (0.0, 0.0, 0.0))
    samples: list[ImuSample] = []
    bare_mag: list[Vec3] = []
    node_times: list[int] = []
    baros: list[BaroSample] = []
    fixes: list[GpsFix] = []
    for record in records:
        match record:
            case ImuRaw():
                samples.append(chain.imu(record))
                counts = mag_from_counts(record.mag_raw, record.mag_lsb_per_gauss)
                is_new = counts is not None and samples[-1].mag_b_ut is not None
                bare_mag.append(turned.apply(counts) if counts and is_new else UNKNOWN_VEC3)
                node_times.append(record.node_time_us)
            case ImuCalibrated():
                samples.append(chain.imu_calibrated(record))
            case BaroRaw():
                baros.append(chain.baro(record))
            case GpsFix():
                fixes.append(record)
    flight = flight_of_samples(samples, baros, fixes, name=name, story=story, fusion=fusion)
    if len(bare_mag) < len(samples):
        return flight
    return replace(
        flight,
        node_time_us=np.array(node_times, np.int64),
        mag_uncalibrated_b_ut=np.array(bare_mag),
    )


def flight_of_samples(
    samples: list[ImuSample],
    baros: list[BaroSample],
    fixes: list[GpsFix],
    *,
    name: str,
    story: str,
    fusion: FusionSettings,
) -> Flight:
    """Convert calibrated samples to a flight."""
    if len(samples) < 2:
        raise ValueError(f"{name}: {len(samples)} IMU samples are no flight")
    return Flight(
        name=name,
        story=story,
        fusion=fusion,
        time_us=np.array([s.time_us for s in samples], np.int64),
        accel_b_mps2=np.array([s.accel_b_mps2 for s in samples]),
        gyro_b_radps=np.array([s.gyro_b_radps for s in samples]),
        mag_b_ut=_mag_of(samples),
        flags=np.array([int(s.flags) for s in samples], np.int64),
        baro_time_us=np.array([b.time_us for b in baros], np.int64),
        baro_alt_m=np.array([b.alt_pressure_m for b in baros], np.float64),
        fixes=tuple(fixes),
        scored=settled(
            np.array([s.time_us for s in samples], np.int64), fixes, fusion.estimation.reference
        ),
    )


def settled(time_us: IntArray, fixes: Iterable[GpsFix], reference: ReferenceSettings) -> BoolArray:
    """Score from the time on at which any estimator can have settled."""
    first_us = next((fix.time_us for fix in fixes if is_usable(fix, reference)), None)
    start_us = int(time_us[0]) if first_us is None else first_us
    return np.asarray(time_us >= start_us + SETTLING_US)


def track_of_states(states: list[NavState]) -> FlightTrack:
    """Convert navigation states to arrays, only their valid values."""
    flags = np.array([int(s.flags) for s in states], np.int64)
    track = FlightTrack(
        time_us=np.array([s.time_us for s in states], np.int64),
        q_nb=np.array([s.q_nb for s in states], np.float64).reshape(-1, 4),
        lat_deg=np.array([s.lat_deg for s in states], np.float64),
        lon_deg=np.array([s.lon_deg for s in states], np.float64),
        alt_amsl_m=np.array([s.alt_amsl_m for s in states], np.float64),
        vel_n_mps=np.array([s.vel_n_mps for s in states], np.float64).reshape(-1, 3),
    )
    return track.where_valid(flags)


def _mag_of(samples: list[ImuSample]) -> FloatArray:
    return np.array([s.mag_b_ut or UNKNOWN_VEC3 for s in samples], np.float64)
