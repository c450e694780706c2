"""The GPS receiver, a u-blox M8N: five fixes per second, with latency, drift and dropouts."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.geometry.geodesy import radii_m
from gateway.gps_time import WEEK_US, gps_us_of_unix
from gateway.records import GpsFixType
from gateway.simulator.sensors import BoolArray, IntArray, Noise, wander
from gateway.simulator.simulator_settings import GpsOutages, SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, FloatArray, SensorMotion

GPS_RATE_HZ: Final = 5
EPOCH_US: Final = 1_000_000 // GPS_RATE_HZ
MIN_LATENCY_S: Final = 0.01
TIME_KNOWN_EARLIER_S: Final = 2.0
"""Time between known GPS time and the first fix: time requires fewer satellites."""

POSITION_WANDER_M: Final[FloatArray] = np.array([0.8, 0.8, 1.5])
POSITION_NOISE_M: Final[FloatArray] = np.array([0.10, 0.10, 0.20])
VELOCITY_WANDER_MPS: Final[FloatArray] = np.array([0.04, 0.04, 0.08])
VELOCITY_NOISE_MPS: Final[FloatArray] = np.array([0.05, 0.05, 0.10])
WANDER_S: Final = 45.0
VELOCITY_WANDER_S: Final = 4.0

SATELLITES: Final = 14.0
SATELLITES_SPREAD: Final = 1.2
H_ACC_M: Final = 1.2
V_ACC_M: Final = 1.8
SPEED_ACC_MPS: Final = 0.12
PDOP: Final = 1.4
BLIND: Final = 99.99
"""DOP that the receiver reports without a fix."""
SETTLING_S: Final = 3.0
"""Time constant with which accuracies return to their usual values after an outage."""
SETTLING_FACTOR: Final = 4.0

EARLIEST_UNIX_US: Final = 946_684_800_000_000
LATEST_UNIX_US: Final = EARLIEST_UNIX_US + 255 * 365 * 86_400_000_000
"""Latest time: the node encodes the year since 2000 in one byte."""


def gps_start(unix_us: int) -> int:
    """Return the GPS time at the start in UTC, limited to the valid range."""
    return min(max(unix_us, EARLIEST_UNIX_US), LATEST_UNIX_US)


def itow_ms_of(unix_us: IntArray) -> IntArray:
    """Return the time of week, ms, for UTC times, with the leap seconds of the first time."""
    first_us = int(unix_us[0]) if len(unix_us) else 0
    return (unix_us + (gps_us_of_unix(first_us) - first_us)) % WEEK_US // 1000


@dataclass(frozen=True, slots=True)
class GpsSamples:
    """N messages of the GPS receiver, as arrays of shape (N,) or (N, 3)."""

    time_s: FloatArray
    """Time of arrival at the node: true time since the start."""
    itow_ms: IntArray
    unix_us: IntArray
    """UTC of the fix, µs since 1970."""
    time_valid: BoolArray
    has_fix: BoolArray
    satellites: IntArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    vel_n_mps: FloatArray
    h_acc_m: FloatArray
    v_acc_m: FloatArray
    speed_acc_mps: FloatArray
    course_acc_deg: FloatArray
    pdop: FloatArray

    @property
    def fix_type(self) -> IntArray:
        """The `GpsFixType` of each message."""
        return np.where(self.has_fix, GpsFixType.FIX_3D, GpsFixType.NONE)


class GpsSampler:
    """Simulate the receiver along a trajectory."""

    def __init__(
        self,
        settings: SimulatorSettings,
        trajectory: SensorMotion,
        rng: np.random.Generator,
        start_unix_us: int,
    ) -> None:
        self._settings = settings
        self._trajectory = trajectory
        self._start_unix_us = gps_start(start_unix_us)
        self._epoch = -(-self._start_unix_us // EPOCH_US)
        position, noise, speed, speed_noise, sky, self._latency = rng.spawn(6)
        interval_s = 1.0 / GPS_RATE_HZ
        self._position_wander = wander(position, 1.0, WANDER_S, interval_s)
        self._position_noise = Noise(noise, 1.0)
        self._velocity_wander = wander(speed, 1.0, VELOCITY_WANDER_S, interval_s)
        self._velocity_noise = Noise(speed_noise, 1.0)
        self._sky = wander(sky, 1.0, WANDER_S, interval_s)

    def take(self, until_s: float) -> GpsSamples:
        """Return all fixes that are valid before a true time; some arrive later than that."""
        end_epoch = math.ceil((self._start_unix_us + until_s * 1e6) / EPOCH_US)
        unix_us = np.arange(self._epoch, max(end_epoch, self._epoch)) * EPOCH_US
        self._epoch = max(end_epoch, self._epoch)
        valid_s = (unix_us - self._start_unix_us).astype(np.float64) * 1e-6
        size, s = len(unix_us), self._settings
        jitter_s = s.gps_latency_jitter_s * self._latency.uniform(-1.0, 1.0, size)
        has_fix = _sees_sky(valid_s, s.gps_first_fix_s, s.gps_outages_s)
        satellites = np.rint(SATELLITES + SATELLITES_SPREAD * self._sky.draw(size)[:, 0])
        satellites = np.where(has_fix, np.maximum(satellites, 6.0), 2.0)
        lat_deg, lon_deg, alt_amsl_m, vel_n_mps = self._measure(valid_s)
        worse = SATELLITES / satellites * _settling(valid_s, s.gps_first_fix_s, s.gps_outages_s)
        speed_acc_mps = SPEED_ACC_MPS * worse
        ground_mps = np.maximum(np.hypot(vel_n_mps[:, 0], vel_n_mps[:, 1]), 1e-3)
        return GpsSamples(
            time_s=valid_s + np.maximum(s.gps_latency_s + jitter_s, MIN_LATENCY_S),
            itow_ms=itow_ms_of(unix_us),
            unix_us=unix_us,
            time_valid=valid_s >= s.gps_first_fix_s - TIME_KNOWN_EARLIER_S,
            has_fix=has_fix,
            satellites=satellites.astype(np.int64),
            lat_deg=np.where(has_fix, lat_deg, 0.0),
            lon_deg=np.where(has_fix, lon_deg, 0.0),
            alt_amsl_m=np.where(has_fix, alt_amsl_m, 0.0),
            vel_n_mps=np.where(has_fix[:, np.newaxis], vel_n_mps, 0.0),
            h_acc_m=np.where(has_fix, H_ACC_M * worse, BLIND),
            v_acc_m=np.where(has_fix, V_ACC_M * worse, BLIND),
            speed_acc_mps=np.where(has_fix, speed_acc_mps, BLIND),
            course_acc_deg=np.where(
                has_fix, np.minimum(np.degrees(speed_acc_mps / ground_mps), 180.0), 180.0
            ),
            pdop=np.where(has_fix, PDOP * SATELLITES / satellites, BLIND),
        )

    def _measure(
        self, valid_s: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        size = len(valid_s)
        truth = self._trajectory.truth_at(valid_s)
        off_m = POSITION_WANDER_M * self._position_wander.draw(size)
        off_m += POSITION_NOISE_M * self._position_noise.draw(size)
        vel = truth.vel_n_mps + VELOCITY_WANDER_MPS * self._velocity_wander.draw(size)
        vel += VELOCITY_NOISE_MPS * self._velocity_noise.draw(size)
        meridian_m, parallel_m = radii_m(self._settings.home_lat_deg, self._settings.home_alt_m)
        return (
            truth.lat_deg + np.degrees(off_m[:, 0] / meridian_m),
            truth.lon_deg + np.degrees(off_m[:, 1] / parallel_m),
            truth.alt_amsl_m - off_m[:, 2],
            vel,
        )


def _sees_sky(valid_s: FloatArray, first_fix_s: float, outages_s: GpsOutages) -> BoolArray:
    seen = valid_s >= first_fix_s
    phase_s = valid_s % FLIGHT_S
    for start_s, length_s in outages_s:
        seen &= (phase_s < start_s) | (phase_s >= start_s + length_s)
    return seen


def _settling(valid_s: FloatArray, first_fix_s: float, outages_s: GpsOutages) -> FloatArray:
    """Return the factor by which accuracies are degraded since the return of the fix."""
    factor = 1.0 + SETTLING_FACTOR * _decay(valid_s - first_fix_s)
    for start_s, length_s in outages_s:
        factor += SETTLING_FACTOR * _decay(valid_s % FLIGHT_S - start_s - length_s)
    return factor


def _decay(since_s: FloatArray) -> FloatArray:
    return np.where(since_s >= 0.0, np.exp(-np.maximum(since_s, 0.0) / SETTLING_S), 0.0)
