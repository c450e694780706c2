"""A whole simulated flight as arrays and as records, with exact truth, for scoring and tests.

`fly` returns the numbers that the simulated nodes send; `SimulatedFlight.records` yields them as
the raw records that the wire stage returns, without clock errors and losses.
"""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw, NodeId
from gateway.simulator.flight import GPS_BOOT_US, GPS_NODE, IMU_NODE, SimulatedAircraft
from gateway.simulator.gps import GpsSamples
from gateway.simulator.sensors import (
    ACCEL_RANGE,
    GYRO_RANGE,
    MAG_GAIN,
    BaroSamples,
    DeviceClock,
    ImuSamples,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, Trajectory
from gateway.units import DEGE7_PER_DEG
from gateway.wire.payloads import ACCEL_RANGES_G, GYRO_RANGES_DPS, MAG_LSB_PER_GAUSS

SampleRecord = ImuRaw | BaroRaw | GpsFix


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """One flight from rest to rest: samples, and truth at any time."""

    settings: SimulatorSettings
    vehicle_id: int
    trajectory: Trajectory
    """`trajectory.truth_at(times)` is exact at any time."""
    errors: dict[str, Any]
    """Sensor errors, with the fields of a node's calibration."""
    imu: ImuSamples
    baro: BaroSamples
    gps: GpsSamples

    def records(self) -> Iterator[SampleRecord]:
        """Yield the samples as raw records in the order of time.

        The gateway clock is true time here; node times are those of the nodes' clocks. The time of
        a record is that of sampling, for a fix that of its arrival.
        """
        sources: tuple[Iterator[SampleRecord], ...] = (
            self._imu_records(),
            self._baro_records(),
            self._gps_records(),
        )
        yield from heapq.merge(*sources, key=_time_of)

    def _imu_records(self) -> Iterator[ImuRaw]:
        node, imu = NodeId(self.vehicle_id, IMU_NODE), self.imu
        for time_us, node_us, accel, gyro, mag, temperature, flags in _rows(imu):
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
        for time_us, node_us, pressure_pa, temperature_degc in _rows(baro):
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
                lat_dege7=round(float(gps.lat_deg[k]) * DEGE7_PER_DEG),
                lon_dege7=round(float(gps.lon_deg[k]) * DEGE7_PER_DEG),
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
    """Simulate the flight of one aircraft, by its index from 0; it repeats after `FLIGHT_S`."""
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


def _rows(samples: ImuSamples | BaroSamples) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of samples, with the time in µs."""
    columns = (np.rint(samples.time_s * 1e6).astype(np.int64), *samples[1:])
    return zip(*(column.tolist() for column in columns), strict=True)
