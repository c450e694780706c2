"""Simulated aircraft: exact truth and the sensors' samples, for scoring.

`fly` gives a whole flight as arrays; `SimulatedFlight.records` gives the same samples as the raw
records that the wire stage returns, without clock errors and losses. The samplers of a
`SimulatedAircraft`, called second by second, feed the simulated nodes with the very same numbers.
"""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np

from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw, NodeId
from gateway.simulator.gps import GpsSampler, GpsSamples
from gateway.simulator.sensors import (
    ACCEL_RANGE,
    GYRO_RANGE,
    MAG_GAIN,
    BaroSampler,
    BaroSamples,
    Chance,
    DeviceClock,
    ImuSampler,
    ImuSamples,
    IntArray,
    SensorErrors,
    errors_of,
    generator,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, FloatArray, SensorMotion, Trajectory
from gateway.wire.payloads import ACCEL_RANGES_G, GYRO_RANGES_DPS, MAG_LSB_PER_GAUSS

SampleRecord = ImuRaw | BaroRaw | GpsFix

START_UNIX_US: Final = 1_781_402_400_000_000
"""14 June 2026, 02:00 UTC, where the caller names no other moment."""
IMU_NODE: Final = 0
GPS_NODE: Final = 1
GPS_BOOT_US: Final = 3_141_592
NEIGHBOUR_DEG: Final = 0.0006
"""Each further aircraft's home is this much further south."""


class SimulatedAircraft:
    """One aircraft with its sensors, for an unlimited time.

    Parameters
    ----------
    settings : SimulatorSettings
    index : int
        0 for the first aircraft; the next ones have the next ids, other gusts and another home.
    start_unix_us : int
        UTC at the start of the simulation.
    motion : SensorMotion, optional
        What it does; by default the planned flight.
    """

    def __init__(
        self,
        settings: SimulatorSettings,
        index: int = 0,
        start_unix_us: int = START_UNIX_US,
        motion: SensorMotion | None = None,
    ) -> None:
        home_lat_deg = settings.home_lat_deg - index * NEIGHBOUR_DEG
        settings = msgspec.structs.replace(settings, home_lat_deg=home_lat_deg)
        self.vehicle_id = settings.vehicle_id + index
        self.trajectory = Trajectory(settings, generator(settings, self.vehicle_id, Chance.GUSTS))
        motion = motion or self.trajectory
        self.imu = ImuSampler(settings, motion, self.vehicle_id)
        self.baro = BaroSampler(settings, motion, self.vehicle_id)
        gps_chance = generator(settings, self.vehicle_id, Chance.GPS)
        self.gps = GpsSampler(settings, motion, gps_chance, start_unix_us)
        self.gps_clock = DeviceClock(GPS_BOOT_US, -settings.clock_skew_ppm)

    @property
    def errors(self) -> SensorErrors:
        """The ideal calibration of this aircraft's sensors."""
        return errors_of(self.imu.inertial, self.imu.magnetometer)


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """One flight from rest to rest: samples, and truth at any time."""

    settings: SimulatorSettings
    vehicle_id: int
    trajectory: Trajectory
    """`trajectory.truth_at(times)` is exact anywhere; `imu.truth` and `baro.truth` are it."""
    errors: SensorErrors
    """Its fields are those of a node's calibration."""
    imu: ImuSamples
    baro: BaroSamples
    gps: GpsSamples

    def records(self) -> Iterator[SampleRecord]:
        """Yield the samples as raw records in the order of time.

        The gateway clock is true time here; node clocks are as the nodes have them. A record's time
        is that of sampling, for a fix that of its arrival.
        """
        sources: tuple[Iterator[SampleRecord], ...] = (
            self._imu_records(),
            self._baro_records(),
            self._gps_records(),
        )
        yield from heapq.merge(*sources, key=_time_of)

    def _imu_records(self) -> Iterator[ImuRaw]:
        node, imu = NodeId(self.vehicle_id, IMU_NODE), self.imu
        columns = (
            _to_us(imu.time_s), imu.node_time_us, imu.accel_raw, imu.gyro_raw, imu.mag_raw,
            imu.temperature_raw, imu.flags,
        )  # fmt: skip
        for time_us, node_us, accel, gyro, mag, temperature, flags in _rows(*columns):
            yield ImuRaw(
                time_us=time_us,
                node=node,
                node_time_us=node_us,
                accel_raw=tuple(accel),
                gyro_raw=tuple(gyro),
                mag_raw=tuple(mag),
                temperature_raw=temperature,
                accel_range_g=ACCEL_RANGES_G[ACCEL_RANGE],
                gyro_range_dps=GYRO_RANGES_DPS[GYRO_RANGE],
                mag_lsb_per_gauss=MAG_LSB_PER_GAUSS[MAG_GAIN],
                flags=ImuFlags(flags),
            )

    def _baro_records(self) -> Iterator[BaroRaw]:
        node, baro = NodeId(self.vehicle_id, IMU_NODE), self.baro
        columns = (_to_us(baro.time_s), baro.node_time_us, baro.pressure_pa, baro.temperature_degc)
        for time_us, node_us, pressure_pa, temperature_degc in _rows(*columns):
            yield BaroRaw(time_us, node, node_us, pressure_pa, temperature_degc)

    def _gps_records(self) -> Iterator[GpsFix]:
        node, gps = NodeId(self.vehicle_id, GPS_NODE), self.gps
        clock = DeviceClock(GPS_BOOT_US, -self.settings.clock_skew_ppm)
        for k, time_s in enumerate(gps.time_s.tolist()):
            north, east, down = gps.vel_n_mps[k].tolist()
            yield GpsFix(
                time_us=round(time_s * 1e6),
                node=node,
                node_time_us=clock.at(time_s),
                itow_ms=int(gps.itow_ms[k]),
                fix_type=GpsFixType(int(gps.fix_type[k])),
                fix_ok=bool(gps.has_fix[k]),
                satellites=int(gps.satellites[k]),
                lat_dege7=round(float(gps.lat_deg[k]) * 1e7),
                lon_dege7=round(float(gps.lon_deg[k]) * 1e7),
                alt_amsl_m=float(gps.alt_amsl_m[k]),
                vel_n_mps=(north, east, down),
                alt_ellipsoid_m=float(gps.alt_amsl_m[k]) + self.settings.geoid_separation_m,
                h_acc_m=float(gps.h_acc_m[k]),
                v_acc_m=float(gps.v_acc_m[k]),
                speed_acc_mps=float(gps.speed_acc_mps[k]),
                course_acc_deg=float(gps.course_acc_deg[k]),
                pdop=float(gps.pdop[k]),
                utc_us=int(gps.unix_us[k]) if gps.time_valid[k] else None,
            )


def fly(
    settings: SimulatorSettings, index: int = 0, duration_s: float = FLIGHT_S
) -> SimulatedFlight:
    """Simulate one aircraft's flight.

    Parameters
    ----------
    settings : SimulatorSettings
    index : int
        Which of the aircraft; 0 is the first.
    duration_s : float
        Duration; the flight repeats after `FLIGHT_S`.

    Returns
    -------
    SimulatedFlight
    """
    aircraft = SimulatedAircraft(settings, index)
    return SimulatedFlight(
        settings=settings,
        vehicle_id=aircraft.vehicle_id,
        trajectory=aircraft.trajectory,
        errors=aircraft.errors,
        imu=aircraft.imu.take(duration_s),
        baro=aircraft.baro.take(duration_s),
        gps=aircraft.gps.take(duration_s),
    )


def _time_of(record: SampleRecord) -> int:
    return record.time_us


def _to_us(time_s: FloatArray) -> IntArray:
    return np.rint(time_s * 1e6).astype(np.int64)


def _rows(*columns: FloatArray | IntArray) -> Iterator[tuple[Any, ...]]:
    return zip(*(column.tolist() for column in columns), strict=True)
