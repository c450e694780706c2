"""What a calibration leaves in a compass: iron that turns along, found by turning."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_DECLINATION,
    GPS_DIP,
    IMU_COLUMNS,
    MAG,
    MAG_UNCALIBRATED,
    NAV_ATTITUDE_STD,
)
from tests.estimation.test_receiver_noise import FIELD_N_UT
from tests.estimation.test_without_compass import (
    RATE_HZ,
    SEEDS,
    STANDS_S,
    estimator_of,
    flight,
    heading_off,
)
from tools.flights import simulated_flight
from tools.score_estimators import OWN, attitude_scores
from tools.score_honesty import share, two_sigma

IRON_UT = 4.0
LEFT_UT = 2.0
SETTLED_S = 20.0
ARCTIC_UT, ARCTIC_DIP_RAD = 58.0, math.radians(88.0)
ARCTIC_IRON_UT = np.array([0.3, -0.25, 0.31])


def field_of(seed: int, heading: np.ndarray, iron_ut: float) -> np.ndarray:
    """Make what a compass beside iron and of skewed axes tells, 25 times a second, in uT."""
    rng = np.random.default_rng(3000 + seed)
    north, _, down = FIELD_N_UT
    field = np.column_stack([north * np.cos(heading), -north * np.sin(heading)])
    field = np.column_stack([field, np.full(len(heading), down)])
    field = field @ (np.eye(3) + 0.02 * rng.standard_normal((3, 3))) + rng.normal(0.0, iron_ut, 3)
    field += rng.normal(0.0, 0.5, field.shape)
    field[np.arange(len(field)) % 4 != 0] = math.nan
    return np.asarray(field)


def errors_beside_iron(
    name: str,
    iron_ut: float,
    *,
    fixes: bool = True,
    added: Callable[[np.ndarray], np.ndarray] | None = None,
    calibrated: bool = True,
    since_s: float = STANDS_S + SETTLED_S,
) -> tuple[np.ndarray, np.ndarray]:
    """Tell how far headings are off beside iron, and what they are told to be, rad.

    `added` tells more iron, by the time.
    """
    off, told = [], []
    settled = round(since_s * RATE_HZ)
    for seed in SEEDS:
        log, heading = flight(seed, "good")
        imu = np.empty((len(log.imu), IMU_COLUMNS))
        imu[:] = log.imu
        imu[:, MAG : MAG + 3] = field_of(seed, heading, iron_ut)
        if added is not None:
            imu[:, MAG : MAG + 3] += added(log.imu_time_us * 1e-6)
        imu[:, MAG_UNCALIBRATED] = not calibrated
        count = len(log.gps) if fixes else 0
        log = replace(log, imu=imu, gps_time_us=log.gps_time_us[:count], gps=log.gps[:count])
        out = estimator_of(name).run(log)
        off.append(heading_off(out, heading)[settled:])
        told.append(out[settled:, NAV_ATTITUDE_STD + 2])
    return np.concatenate(off), np.concatenate(told)


@pytest.mark.parametrize(
    ("name", "most_deg", "least_share"), [("complementary", 5.0, 0.82), ("eskf", 4.0, 0.88)]
)
def test_a_heading_beside_iron_comes_from_motion_and_is_told_as_unsure(
    name: str, most_deg: float, least_share: float
) -> None:
    errors, std = errors_beside_iron(name, IRON_UT)
    assert np.degrees(np.sqrt(np.mean(errors**2))) < most_deg
    assert np.mean(errors < 2.0 * std) > least_share


@pytest.mark.parametrize("iron_ut", [(15.0, 15.0, 15.0), (-10.0, 12.0, 18.0)])
def test_iron_as_strong_as_the_level_field_is_told_as_unsure(
    iron_ut: tuple[float, float, float],
) -> None:
    """It turns the heading by no straight line of its strength."""
    errors, std = errors_beside_iron(
        "eskf", 0.0, added=lambda _: np.array(iron_ut), calibrated=False
    )
    assert np.degrees(np.sqrt(np.mean(errors**2))) < 5.0
    assert np.mean(errors < 2.0 * std) > 0.82


def flown_with(
    change: Callable[[np.ndarray, np.ndarray], np.ndarray], name: str = "complementary"
) -> tuple[float, float]:
    """Fly on a compass that tells otherwise than the field.

    Returns how far the heading is off, rms in deg, and for which share it is within two sigma.
    """
    flown = simulated_flight(11, calibrated=True)
    imu, time_s = flown.log.imu.copy(), flown.log.imu_time_us * 1e-6
    imu[:, MAG : MAG + 3] = change(imu[:, MAG : MAG + 3], time_s)
    changed = replace(flown, log=replace(flown.log, imu=imu))
    out = OWN[name](changed)
    within = share(two_sigma(changed, out)["heading"])
    return attitude_scores(changed, out[:, :4])["heading"], within


def test_a_reversed_compass_is_not_believed_where_the_dip_of_the_earths_field_is_known() -> None:
    off_deg, within = flown_with(lambda field, _: -field)
    assert off_deg < 2.0
    assert within > 0.9


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_odd_numbers_of_the_bus_show_no_iron(name: str, rng: np.random.Generator) -> None:
    def odd(field: np.ndarray, _: np.ndarray) -> np.ndarray:
        spoilt = rng.random(len(field)) < 0.01
        return field + spoilt[:, None] * rng.normal(0.0, 300.0, field.shape)

    off_deg, within = flown_with(odd, name)
    assert off_deg < 1.5
    assert within > 0.9


def test_iron_that_comes_and_goes_is_not_learned_as_if_it_stayed() -> None:
    iron = np.array([12.0, -9.0, 13.0])
    off_deg, within = flown_with(
        lambda field, time_s: field + iron * ((time_s // 7.0) % 2.0)[:, None]
    )
    assert off_deg < 2.0
    assert within > 0.9


def test_iron_is_found_by_turning_without_gps() -> None:
    errors, std = errors_beside_iron("eskf", LEFT_UT, fixes=False)
    assert np.degrees(np.sqrt(np.mean(errors**2))) < 4.0
    assert np.mean(errors < 2.0 * std) > 0.95
    assert np.degrees(np.sqrt(np.mean(std**2))) < 5.5


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_steep_field_tells_little_of_the_heading_and_nothing_of_the_level(name: str) -> None:
    """What bends the field a little turns its level part far."""
    flight = simulated_flight(603, calibrated=True)
    imu, gps = flight.log.imu.copy(), flight.log.gps.copy()
    dip_rad, declination_rad = np.nanmedian(gps[:, [GPS_DIP, GPS_DECLINATION]], axis=0)
    q = Rotation.from_quat(flight.q_nb, scalar_first=True)
    north = np.array([math.cos(declination_rad), math.sin(declination_rad), 0.0])
    usual_ut = np.nanmedian(np.linalg.norm(imu[:, MAG : MAG + 3], axis=1))
    usual, steep = (
        ut * (math.cos(dip) * north + (0.0, 0.0, math.sin(dip)))
        for ut, dip in ((usual_ut, dip_rad), (ARCTIC_UT, ARCTIC_DIP_RAD))
    )
    imu[:, MAG : MAG + 3] += q.inv().apply(steep - usual) + ARCTIC_IRON_UT
    gps[:, GPS_DIP] = ARCTIC_DIP_RAD
    flight = replace(flight, log=replace(flight.log, imu=imu, gps=gps))
    out = OWN[name](flight)
    found, within = attitude_scores(flight, out[:, :4]), two_sigma(flight, out)
    assert found["heading"] < 1.0
    assert found["inclination"] < 1.0
    assert min(share(within["tilt"]), share(within["heading"])) > 0.95
