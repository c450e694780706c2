"""Send a recorded flight through the simulated receiver: SI columns in, the nodes' payloads out.

The recorded times of sampling and of arrival are kept, including the GPS latency. Vectors are
converted to counts in sensor axes, in the finest ranges that can represent them; the board is level
and face up. Barometer heights are converted to pressures of the standard atmosphere.
"""

import dataclasses
import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, count
from operator import attrgetter
from typing import Final

import numpy as np

from gateway.geometry.atmosphere import SEA_LEVEL_PA
from gateway.records import ImuFlags, NodeId
from gateway.simulator.flight import GPS_BOOT_US, GPS_NODE, IMU_NODE, START_UNIX_US
from gateway.simulator.gps import GpsSamples, gps_start, itow_ms_of
from gateway.simulator.node import (
    GPS_SENSORS,
    IMU_SENSORS,
    UINT16_MAX,
    Node,
    Sent,
    gps_payloads,
    pack_baro,
    pack_imu,
)
from gateway.simulator.receiver import SimulatedReceiver
from gateway.simulator.sensors import (
    FACE_UP,
    GYRO_LSB_PER_DPS,
    IMU_BOOT_US,
    INT16_MAX,
    MAG_LIMIT,
    BaroSamples,
    BoolArray,
    DeviceClock,
    ImuSamples,
    IntArray,
    inertial_counts,
    mag_counts,
    pressure_at,
    temperature_counts,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.simulator.trajectory import FloatArray
from gateway.units import STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.wire.payloads import ACCEL_RANGES_G, HMC5883L_LSB_PER_GAUSS

ROWS: Final = 2048
"""Rows converted to payloads at a time, which bounds the memory for long recordings."""
TEMPERATURE_DEGC: Final = 25.0
SATELLITES: Final = 10
H_ACC_M: Final = 2.0
V_ACC_M: Final = 3.0
SPEED_ACC_MPS: Final = 0.3
PDOP: Final = 1.8
"""PDOP of fixes if the recording has none."""
UNKNOWN: Final = UINT16_MAX / 100.0
TAIL_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """A tracker's log: N rows of the IMU, M fixes; NaN means no new sample."""

    time_s: FloatArray
    """Shape (N,), time since the first row."""
    accel_b_mps2: FloatArray
    """Shape (N, 3), specific force in body FRD."""
    gyro_b_radps: FloatArray
    mag_b_ut: FloatArray
    """Shape (N, 3), hard iron removed."""
    baro_alt_m: FloatArray
    """Shape (N,), height from the barometer."""
    gps_time_s: FloatArray
    """Shape (M,), time of arrival since the first row; not negative."""
    gps_lat_deg: FloatArray
    gps_lon_deg: FloatArray
    gps_alt_m: FloatArray
    gps_vel_n_mps: FloatArray
    """Shape (M, 3); NaN if the recording has no velocity."""
    gps_latency_s: float
    """Time from validity to arrival of a fix; used only for its time of week and UTC."""

    @property
    def duration_s(self) -> float:
        """Duration of the recording, plus time for the last payloads to be sent."""
        return float(self.time_s[-1]) + TAIL_S

    @property
    def rate_hz(self) -> float:
        """Usual sample rate of the IMU."""
        return 1.0 / float(np.median(np.diff(self.time_s)))


def in_rounds(
    frames: Iterator[TimedFrame], duration_s: float, on_round: Callable[[int], None]
) -> Iterator[TimedFrame]:
    """Yield the frames of an endless replay; report each round, from 2, before its first frame."""
    number, end_s = 1, duration_s
    for frame in frames:
        if frame.time_s >= end_s:
            number, end_s = number + 1, end_s + duration_s
            on_round(number)
        yield frame


def replay(
    settings: SimulatorSettings, flight: RecordedFlight, start_unix_us: int = START_UNIX_US
) -> SimulatedReceiver:
    """Create the receiver and one aircraft that replays a recording without a UTC start time.

    The recording is repeated while the nodes' clocks and sequence numbers continue.
    """
    imu_clock = DeviceClock(IMU_BOOT_US, settings.clock_skew_ppm)
    inertial = _imu_payloads(flight, imu_clock)
    pressures: Iterator[Sent] = iter(())
    if np.isfinite(flight.baro_alt_m).any():
        pressures = chain.from_iterable(_baro_payloads(f, imu_clock) for f in _rounds(flight))
    samples = heapq.merge(inertial, pressures, key=attrgetter("time_s"))
    node_id = NodeId(settings.vehicle_id, IMU_NODE)
    nodes = [Node(node_id, imu_clock, _imu_sensors(flight), round(flight.rate_hz), samples)]
    if len(flight.gps_time_s):
        gps_clock = DeviceClock(GPS_BOOT_US, -settings.clock_skew_ppm)
        gaps_s = np.diff(flight.gps_time_s)
        spacing_s = float(np.median(gaps_s)) if len(gaps_s) else 1.0
        fixes = chain.from_iterable(
            gps_payloads(_gps_samples(f, start_unix_us), gps_clock, settings.geoid_separation_m)
            for f in _rounds(flight)
        )
        node_id = NodeId(settings.vehicle_id, GPS_NODE)
        nodes.append(Node(node_id, gps_clock, GPS_SENSORS, round(1.0 / spacing_s), fixes))
    return SimulatedReceiver(settings, nodes)


def _rounds(flight: RecordedFlight) -> Iterator[RecordedFlight]:
    """Yield the flight endlessly, each time shifted after the one before."""
    for number in count():
        begin_s = number * flight.duration_s
        yield dataclasses.replace(
            flight, time_s=flight.time_s + begin_s, gps_time_s=flight.gps_time_s + begin_s
        )


def _imu_sensors(flight: RecordedFlight) -> int:
    absent = (not np.isfinite(flight.mag_b_ut).any()) << 1
    absent |= (not np.isfinite(flight.baro_alt_m).any()) << 2
    return IMU_SENSORS & ~absent


def _imu_payloads(flight: RecordedFlight, clock: DeviceClock) -> Iterator[Sent]:
    accel_range, gyro_range, mag_gain = ranges = _ranges(flight)
    mag_new = _complete(flight.mag_b_ut)
    absent = 0 if mag_new.any() else int(ImuFlags.MAG_ABSENT)
    if not np.isfinite(flight.baro_alt_m).any():
        absent |= ImuFlags.BARO_ABSENT
    mag_raw = _mag_words(flight.mag_b_ut, mag_new, mag_gain)
    temperature = temperature_counts(np.full(ROWS, TEMPERATURE_DEGC))
    for flown in _rounds(flight):
        for start in range(0, len(flown.time_s), ROWS):
            rows = slice(start, start + ROWS)
            time_s = flown.time_s[rows]
            vectors = (flown.accel_b_mps2[rows] * FACE_UP, flown.gyro_b_radps[rows] * FACE_UP)
            accel, gyro, clipped = inertial_counts(*vectors, accel_range, gyro_range)
            flags = absent | clipped | mag_new[rows] * int(ImuFlags.MAG_NEW)
            columns = (time_s, _on_clock(clock, time_s), accel, gyro, mag_raw[rows])
            yield from pack_imu(ImuSamples(*columns, temperature[: len(time_s)], flags), ranges)


def _ranges(flight: RecordedFlight) -> tuple[int, int, int]:
    """Return the codes of the finest ranges that can represent the whole recording."""
    accel_limits = [g * STANDARD_GRAVITY_MPS2 * INT16_MAX / (INT16_MAX + 1) for g in ACCEL_RANGES_G]
    gyro_limits = [math.radians(INT16_MAX / lsb) for lsb in GYRO_LSB_PER_DPS]
    mag_limits = [MAG_LIMIT * UT_PER_GAUSS / lsb for lsb in HMC5883L_LSB_PER_GAUSS]
    return (
        _finest(accel_limits, flight.accel_b_mps2),
        _finest(gyro_limits, flight.gyro_b_radps),
        _finest(mag_limits, flight.mag_b_ut),
    )


def _finest(limits: list[float], values: FloatArray) -> int:
    """Return the index of the first limit that no value exceeds, otherwise the last index."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return next((code for code, limit in enumerate(limits) if largest < limit), len(limits) - 1)


def _mag_words(field_b_ut: FloatArray, new: BoolArray, gain: int) -> IntArray:
    """Convert to counts, and hold each sample until the next one, as the registers do."""
    words = np.zeros((np.count_nonzero(new) + 1, 3), dtype=np.int64)
    words[1:] = mag_counts(field_b_ut[new] * FACE_UP, gain)
    return words[np.cumsum(new)]


def _baro_payloads(flight: RecordedFlight, clock: DeviceClock) -> Iterator[Sent]:
    new = np.isfinite(flight.baro_alt_m)
    time_s = flight.time_s[new]
    pressure_pa = pressure_at(flight.baro_alt_m[new], SEA_LEVEL_PA)
    degc = np.full(len(time_s), TEMPERATURE_DEGC)
    return pack_baro(BaroSamples(time_s, _on_clock(clock, time_s), pressure_pa, degc))


def _gps_samples(flight: RecordedFlight, start_unix_us: int) -> GpsSamples:
    size = len(flight.gps_time_s)
    valid_s = flight.gps_time_s - flight.gps_latency_s
    unix_us = gps_start(start_unix_us) + np.rint(valid_s * 1e6).astype(np.int64)
    has_height = np.isfinite(flight.gps_alt_m)
    has_velocity = _complete(flight.gps_vel_n_mps)
    vel = np.where(has_velocity[:, np.newaxis], flight.gps_vel_n_mps, 0.0)
    ground_mps = np.maximum(np.hypot(vel[:, 0], vel[:, 1]), 1e-3)
    speed_acc_mps = np.where(has_velocity, SPEED_ACC_MPS, UNKNOWN)
    return GpsSamples(
        time_s=flight.gps_time_s,
        itow_ms=itow_ms_of(unix_us),
        unix_us=unix_us,
        time_valid=np.ones(size, dtype=np.bool_),
        has_fix=np.ones(size, dtype=np.bool_),
        satellites=np.full(size, SATELLITES),
        lat_deg=flight.gps_lat_deg,
        lon_deg=flight.gps_lon_deg,
        alt_amsl_m=np.where(has_height, flight.gps_alt_m, 0.0),
        vel_n_mps=vel,
        h_acc_m=np.full(size, H_ACC_M),
        v_acc_m=np.where(has_height, V_ACC_M, UNKNOWN),
        speed_acc_mps=speed_acc_mps,
        course_acc_deg=np.minimum(np.degrees(speed_acc_mps / ground_mps), 180.0),
        pdop=np.full(size, PDOP),
    )


def _complete(vectors: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(vectors).all(axis=1))


def _on_clock(clock: DeviceClock, time_s: FloatArray) -> IntArray:
    return np.array([clock.at(t) for t in time_s.tolist()], dtype=np.int64)
