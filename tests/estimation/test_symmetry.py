"""What must not change an estimate: where north is, where on Earth, which axis, which hand."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GPS_ALT,
    GPS_DECLINATION,
    GPS_LAT,
    GPS_LON,
    GPS_VEL,
    GYRO,
    MAG,
    NAV_ALT,
    NAV_LAT,
    NAV_LON,
    NAV_VEL,
)
from gateway.estimation.kernel import SampleLog
from gateway.geometry.geodesy import radii_m
from tools.flights import Flight, simulated_flight
from tools.score_estimators import run_complementary, run_eskf, run_smoothed

SECONDS = 100.0
MIRROR = np.array([1.0, -1.0, 1.0])
"""East and right change their sign; an axial vector, as a turn is, keeps only that part."""
QUARTER = Rotation.from_euler("z", 90.0, degrees=True)
UPSIDE_DOWN, ON_ITS_SIDE = (Rotation.from_euler("x", deg, degrees=True) for deg in (180.0, 90.0))

Out = np.ndarray
Change = tuple[Callable[[Flight], SampleLog], Callable[[Flight, Out], Out]]


@pytest.fixture(scope="module")
def flight() -> Flight:
    flown = simulated_flight(601, calibrated=True)
    log, end_us = flown.log, SECONDS * 1e6
    imu, baro, gps = (us < end_us for us in (log.imu_time_us, log.baro_time_us, log.gps_time_us))
    cut = SampleLog(
        log.imu_time_us[imu], log.imu[imu], log.baro_time_us[baro], log.baro_alt_m[baro],
        log.gps_time_us[gps], log.gps[gps],
    )  # fmt: skip
    return replace(flown, log=cut)


def metres(flight: Flight, lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
    lat0, lon0 = flight.origin_deg
    off = np.column_stack([lat - lat0, (lon - lon0 + 180.0) % 360.0 - 180.0])
    return np.radians(off) * radii_m(lat0, 0.0)


def with_places(gps: np.ndarray, origin: tuple[float, float], place: np.ndarray) -> np.ndarray:
    off = np.degrees(place / radii_m(origin[0], 0.0))
    gps = gps.copy()
    gps[:, GPS_LAT] = origin[0] + off[:, 0]
    gps[:, GPS_LON] = (origin[1] + off[:, 1] + 180.0) % 360.0 - 180.0
    return gps


def turned_world() -> Change:
    def change(flight: Flight) -> SampleLog:
        gps = flight.log.gps
        place = QUARTER.as_matrix()[:2, :2] @ metres(flight, *gps[:, GPS_LAT : GPS_LON + 1].T).T
        gps = with_places(gps, flight.origin_deg, place.T)
        gps[:, GPS_VEL : GPS_VEL + 3] = QUARTER.apply(gps[:, GPS_VEL : GPS_VEL + 3])
        gps[:, GPS_DECLINATION] += 0.5 * math.pi
        return replace(flight.log, gps=gps)

    def back(flight: Flight, out: Out) -> Out:
        q = QUARTER.inv() * Rotation.from_quat(out[:, :4], scalar_first=True)
        place = metres(flight, *out[:, NAV_LAT : NAV_LON + 1].T) @ QUARTER.as_matrix()[:2, :2]
        vel = QUARTER.inv().apply(out[:, NAV_VEL : NAV_VEL + 3])
        return np.column_stack([q.as_quat(scalar_first=True), place, out[:, NAV_ALT], vel])

    return change, back


def same(flight: Flight, out: Out) -> Out:
    place = metres(flight, *out[:, NAV_LAT : NAV_LON + 1].T)
    return np.column_stack([out[:, :4], place, out[:, NAV_ALT], out[:, NAV_VEL : NAV_VEL + 3]])


def elsewhere(lat_deg: float, lon_deg: float) -> Change:
    def change(flight: Flight) -> SampleLog:
        place = metres(flight, *flight.log.gps[:, GPS_LAT : GPS_LON + 1].T)
        return replace(flight.log, gps=with_places(flight.log.gps, (lat_deg, lon_deg), place))

    def back(flight: Flight, out: Out) -> Out:
        # The whole output stays on its side of the date line.
        assert (np.abs(out[np.isfinite(out[:, NAV_LON]), NAV_LON]) <= 180.0).all()
        return same(replace(flight, origin_deg=(lat_deg, lon_deg)), out)

    return change, back


def higher(by_m: float) -> Change:
    def change(flight: Flight) -> SampleLog:
        gps = flight.log.gps.copy()
        gps[:, GPS_ALT] += by_m
        return replace(flight.log, gps=gps, baro_alt_m=flight.log.baro_alt_m + by_m)

    def back(flight: Flight, out: Out) -> Out:
        found = same(flight, out)
        found[:, 6] -= by_m
        return found

    return change, back


def remounted(turn: Rotation) -> Change:
    def change(flight: Flight) -> SampleLog:
        imu = flight.log.imu.copy()
        for first in (ACCEL, GYRO, MAG):
            imu[:, first : first + 3] = imu[:, first : first + 3] @ turn.as_matrix()
        return replace(flight.log, imu=imu)

    def back(flight: Flight, out: Out) -> Out:
        q = Rotation.from_quat(out[:, :4], scalar_first=True) * turn.inv()
        return same(flight, np.column_stack([q.as_quat(scalar_first=True), out[:, 4:]]))

    return change, back


def mirrored() -> Change:
    def change(flight: Flight) -> SampleLog:
        imu, gps = flight.log.imu.copy(), flight.log.gps
        for first, sign in ((ACCEL, MIRROR), (GYRO, -MIRROR), (MAG, MIRROR)):
            imu[:, first : first + 3] *= sign
        place = metres(flight, *gps[:, GPS_LAT : GPS_LON + 1].T) * MIRROR[:2]
        gps = with_places(gps, flight.origin_deg, place)
        gps[:, GPS_VEL : GPS_VEL + 3] *= MIRROR
        gps[:, GPS_DECLINATION] *= -1.0
        return replace(flight.log, imu=imu, gps=gps)

    def back(flight: Flight, out: Out) -> Out:
        found = same(flight, out)
        found[:, :4] *= (1.0, -1.0, 1.0, -1.0)
        found[:, 4:6] *= MIRROR[:2]
        found[:, 7:] *= MIRROR
        return found

    return change, back


def later(us: int) -> Change:
    def change(flight: Flight) -> SampleLog:
        log = flight.log
        return replace(
            log,
            imu_time_us=log.imu_time_us + us,
            baro_time_us=log.baro_time_us + us,
            gps_time_us=log.gps_time_us + us,
        )

    return change, same


CHANGES = {
    "north is elsewhere": turned_world(),
    "on the date line": elsewhere(80.0, 180.0),
    "at the origin": elsewhere(0.0, 0.0),
    "4000 m up": higher(4000.0),
    "upside down": remounted(UPSIDE_DOWN),
    "on its side": remounted(ON_ITS_SIDE),
    "the other hand": mirrored(),
    "civil time": later(1_790_000_000_000_000),
}
RUNS = {"complementary": run_complementary, "eskf": run_eskf, "smoothed": run_smoothed}


@pytest.mark.parametrize("name", RUNS)
def test_what_must_not_change_the_estimate_does_not(flight: Flight, name: str) -> None:
    """But for what is gated by axis, and for the roundness of the Earth."""
    plain = same(flight, RUNS[name](flight))
    settled = flight.log.imu_time_us > 20e6
    for what, (change, back) in CHANGES.items():
        found = back(flight, RUNS[name](replace(flight, log=change(flight))))
        off = found[settled] - plain[settled]
        dot = np.abs(np.sum(found[settled, :4] * plain[settled, :4], axis=1)).clip(max=1.0)
        assert np.degrees(2.0 * np.arccos(dot)).max() < 0.3, what
        assert np.abs(off[:, 4:7]).max() < 0.2, what
        assert np.abs(off[:, 7:]).max() < 0.1, what
