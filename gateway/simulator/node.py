"""The two radio nodes of an aircraft: convert samples to payloads, each with its time."""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain, count
from operator import attrgetter
from typing import Final

import numpy as np

from gateway.records import GpsFixType, ImuFlags, NodeId
from gateway.simulator.flight import GPS_NODE, IMU_NODE, SimulatedAircraft
from gateway.simulator.gps import GPS_RATE_HZ, GpsSamples
from gateway.simulator.sensors import (
    ACCEL_RANGE,
    GYRO_RANGE,
    MAG_GAIN,
    BaroSamples,
    DeviceClock,
    ImuSamples,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import DEGE7_PER_DEG
from gateway.wire.payloads import (
    GPS_ACKNOWLEDGES,
    SENSOR_IMU,
    BaroPayload,
    Chips,
    GpsFixPayload,
    GpsQualityPayload,
    ImuPayload,
    NodeStatusPayload,
    Payload,
)

IMU_READING_S: Final = 0.0011
"""Time to read MPU6050 and HMC5883L over a 400 kHz bus."""
BARO_READING_S: Final = 0.0006
GPS_READING_S: Final = 0.009
"""Time to receive the 100 bytes of UBX-NAV-PVT at 115 200 baud."""
STATUS_S: Final = 1.0
STARTING_US: Final = 600_000
"""Time from reset to the first payload: self-test and settling of the sensors."""

SAMPLES_AT_ONCE: Final = 20
"""Samples per batch: a small batch costs nearly as much as a large one, but a large one would block
an event loop."""
FIXES_AT_ONCE: Final = 10
PHASES: Final = 4

IMU_SENSORS: Final = 0b0111
GPS_SENSORS: Final = 0b1000
IMU_CHIPS: Final = Chips(imu=0x68, magnetometer=0x1E, barometer=0x55)
"""MPU6050, HMC5883L, BMP180."""
GPS_CHIPS: Final = Chips(gps=8 | GPS_ACKNOWLEDGES, gps_baud_hundreds=576)
"""A u-blox M8, configured at 57 600 baud."""
POWER_ON: Final = 1
LOOP_US: Final = 1400
SUPPLY_MV: Final = 3300
UINT16_MAX: Final = 65_535
INT16_MAX: Final = 32_767

UNIX_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Sent:
    """A payload that a node passes to its radio."""

    time_s: float
    """True time at which the payload is passed to the radio."""
    node_time_us: int
    """Timestamp in the payload on the node's clock, not wrapped."""
    payload: Payload


@dataclass(slots=True)
class Node:
    """A source of payloads: samples of its sensors in order, and its own reports between them."""

    node_id: NodeId
    clock: DeviceClock
    sensors: int
    rate_hz: int
    samples: Iterator[Sent]
    restart_s: float = 0.0
    """True time at which the watchdog resets the node; 0 for never."""
    radio_failed: int = 0
    radio_retries: int = 0

    def sent(self) -> Iterator[Sent]:
        """Yield all payloads passed to the radio, in order and without end; call it only once."""
        return filter(None, map(self._after_restart, self._with_reports()))

    def _with_reports(self) -> Iterator[Sent]:
        times = ((k + 0.5) * STATUS_S for k in count())
        report_s = next(times)
        for sent in self.samples:
            while report_s <= sent.time_s:
                yield self._report(report_s)
                report_s = next(times)
            yield sent
        yield self._report(report_s)
        yield from map(self._report, times)

    def _after_restart(self, sent: Sent) -> Sent | None:
        """Drop payloads while a node restarts; its clock then starts from zero."""
        if not 0.0 < self.restart_s <= sent.time_s:
            return sent
        node_time_us = sent.node_time_us - self.clock.at(self.restart_s)
        if node_time_us < STARTING_US:
            return None
        return Sent(sent.time_s, node_time_us, sent.payload)

    def _report(self, time_s: float) -> Sent:
        status = NodeStatusPayload(
            firmware_version=(1, 1),
            reset_cause=POWER_ON,
            sensors_present=self.sensors,
            sensors_failed=0,
            bus_errors=0,
            radio_failed=self.radio_failed & UINT16_MAX,
            radio_retries=self.radio_retries & UINT16_MAX,
            loop_max_us=LOOP_US,
            sample_rate_hz=self.rate_hz,
            supply_mv=SUPPLY_MV,
            chips=IMU_CHIPS if self.sensors & SENSOR_IMU else GPS_CHIPS,
        )
        return Sent(time_s, self.clock.at(time_s), status)


def nodes_of(aircraft: SimulatedAircraft, settings: SimulatorSettings) -> tuple[Node, Node]:
    """Create the nodes of an aircraft: one with MPU6050, HMC5883L and BMP180, one with the M8N.

    Samples are computed in small batches, on demand.
    """
    imu_s, baro_s = (SAMPLES_AT_ONCE / hz for hz in (settings.imu_rate_hz, settings.baro_rate_hz))
    imu = Node(
        NodeId(aircraft.vehicle_id, IMU_NODE),
        aircraft.imu.clock,
        IMU_SENSORS,
        settings.imu_rate_hz,
        heapq.merge(
            _in_batches(aircraft, imu_s, lambda until_s: pack_imu(aircraft.imu.take(until_s))),
            _in_batches(aircraft, baro_s, lambda until_s: pack_baro(aircraft.baro.take(until_s))),
            key=attrgetter("time_s"),
        ),
        settings.imu_restart_s,
    )
    gps = Node(
        NodeId(aircraft.vehicle_id, GPS_NODE),
        aircraft.gps_clock,
        GPS_SENSORS,
        GPS_RATE_HZ,
        _in_batches(
            aircraft,
            FIXES_AT_ONCE / GPS_RATE_HZ,
            lambda until_s: gps_payloads(
                aircraft.gps.take(until_s), aircraft.gps_clock, settings.geoid_separation_m
            ),
        ),
    )
    return imu, gps


def _in_batches(
    aircraft: SimulatedAircraft, length_s: float, take: Callable[[float], Iterator[Sent]]
) -> Iterator[Sent]:
    """Yield the payloads of one batch after the other; batches of other aircraft end at others."""
    first_s = length_s * (1.0 - aircraft.vehicle_id % PHASES / PHASES)
    return chain.from_iterable(take(first_s + k * length_s) for k in count())


def pack_imu(
    samples: ImuSamples, ranges: tuple[int, int, int] = (ACCEL_RANGE, GYRO_RANGE, MAG_GAIN)
) -> Iterator[Sent]:
    """Pack IMU samples.

    Ranges: the codes for the ranges of accelerometer and gyroscope, and for the magnetometer's
    gain.
    """
    for time_s, node_us, accel, gyro, mag, temperature, flags in zip(
        *(column.tolist() for column in samples), strict=True
    ):
        vectors = (tuple(accel), tuple(gyro), tuple(mag))
        payload = ImuPayload(*vectors, temperature, ImuFlags(flags), *ranges)
        yield Sent(time_s + IMU_READING_S, node_us, payload)


def pack_baro(samples: BaroSamples) -> Iterator[Sent]:
    """Pack barometer samples."""
    for time_s, node_us, pressure_pa, degc in zip(*(c.tolist() for c in samples), strict=True):
        payload = BaroPayload(round(pressure_pa * 100.0), round(degc * 10.0))
        yield Sent(time_s + BARO_READING_S, node_us, payload)


def gps_payloads(gps: GpsSamples, clock: DeviceClock, geoid_separation_m: float) -> Iterator[Sent]:
    """Pack GPS messages, each as a quality payload and a fix payload."""
    accuracies = (gps.h_acc_m, gps.v_acc_m, gps.speed_acc_mps, gps.course_acc_deg, gps.pdop)
    hundredths = np.rint(np.column_stack(accuracies) * 100.0).clip(0, UINT16_MAX)
    words = hundredths.astype(np.int64).tolist()
    lat_dege7, lon_dege7 = (np.rint(deg * DEGE7_PER_DEG) for deg in (gps.lat_deg, gps.lon_deg))
    vel_cmps = np.clip(np.rint(gps.vel_n_mps * 100.0), -INT16_MAX, INT16_MAX).astype(np.int64)
    for k, time_s in enumerate(gps.time_s.tolist()):
        itow_ms, node_us = int(gps.itow_ms[k]), clock.at(time_s)
        utc = UNIX_EPOCH + timedelta(microseconds=int(gps.unix_us[k]))
        known_utc = utc if gps.time_valid[k] else None
        values = (*words[k], round(geoid_separation_m * 100.0), known_utc)
        quality = GpsQualityPayload(itow_ms, *values)
        north, east, down = vel_cmps[k].tolist()
        fix = GpsFixPayload(
            itow_ms=itow_ms,
            lat_dege7=int(lat_dege7[k]),
            lon_dege7=int(lon_dege7[k]),
            alt_amsl_mm=round(float(gps.alt_amsl_m[k]) * 1e3),
            vel_n_cmps=(north, east, down),
            fix_type=GpsFixType(int(gps.fix_type[k])),
            fix_ok=bool(gps.has_fix[k]),
            satellites=int(gps.satellites[k]),
        )
        yield Sent(time_s + GPS_READING_S, node_us, quality)
        yield Sent(time_s + GPS_READING_S, node_us, fix)
