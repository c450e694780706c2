"""Flights spoilt as in the field: an estimator is back with its unspoilt run 20 s afterwards."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.columns import (
    GYRO,
    MAG,
    NAV_ATTITUDE_STD,
    NAV_FLAGS,
    NAV_LAT,
    NAV_POS_STD,
)
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import NavFlags
from tools.flights import Flight, read_flight, simulated_flight
from tools.score_estimators import (
    attitude_scores,
    outages,
    position_errors_m,
    run_complementary,
    run_eskf,
)
from tools.score_honesty import share, two_sigma
from tools.spoil_flight import RECOVERY_S, SPOILS, applies, cut, departure, mid_air, no_mag

pytestmark = pytest.mark.slow

RUNS = {"eskf": run_eskf, "complementary": run_complementary}
SEEDS = (21, 22)
PLACE_M = 10.0

LIMIT_DEG = 3.0
"""For tilt and heading alike."""


@pytest.fixture(scope="module", params=SEEDS)
def flight(request: pytest.FixtureRequest) -> Flight:
    return simulated_flight(request.param, calibrated=request.param % 2 == 1)


def off(flight: Flight, name: str, how: str) -> tuple[float, float, float]:
    spoilt = SPOILS[how](flight)
    run = RUNS[name]
    found = departure(flight, run(flight), spoilt.flight, run(spoilt.flight))
    return found.after(spoilt.ends_s + RECOVERY_S)


def check_back(flight: Flight, name: str, how: str) -> None:
    tilt_deg, heading_deg, place_m = off(flight, name, how)
    assert tilt_deg < LIMIT_DEG
    assert heading_deg < LIMIT_DEG
    assert place_m < PLACE_M


@pytest.mark.parametrize("how", SPOILS)
@pytest.mark.parametrize("name", RUNS)
def test_simulated(flight: Flight, name: str, how: str) -> None:
    check_back(flight, name, how)


@pytest.mark.parametrize("seed", [12, 32])
def test_a_large_bias_is_learned_by_a_start_in_flight(seed: int) -> None:
    """These gyroscopes read up to 2.5 deg/s too much, and no rest has shown it."""
    check_back(simulated_flight(seed, calibrated=False), "complementary", "mid_air")


@pytest.mark.parametrize("how", SPOILS)
@pytest.mark.parametrize("name", RUNS)
def test_real_fixed_wing(data_dir: Path, name: str, how: str) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    check_back(flight, name, how)


@pytest.mark.parametrize(
    "how", ["zero_rows", "no_height", "silence", "gyro_off", "uncalibrated", "half_rate"]
)
@pytest.mark.parametrize("name", RUNS)
def test_real_car(data_dir: Path, name: str, how: str) -> None:
    """Without a compass; its engine idles before it goes, and shows the gyroscope's bias."""
    flight = read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz")
    check_back(flight, name, how)


@pytest.mark.parametrize(
    ("how", "limit_deg"),
    [
        *((how, LIMIT_DEG) for how in ("zero_rows", "no_height", "no_baro", "silence", "gyro_off")),
        ("mid_air", 4.0),
        ("no_mag", 4.5),
        ("mag_hangs", 5.5),
    ],
)
def test_real_quadrotor(data_dir: Path, how: str, limit_deg: float) -> None:
    """Its compass carries iron, which the field's dip tells, and its strength in the first turns.

    Its GPS velocities are noisier than is expected of any: what they tell of a heading that was
    lost comes later.
    """
    flight = read_flight(data_dir / "px4_f450_glitch.csv.gz")
    tilt_deg, heading_deg, place_m = off(flight, "eskf", how)
    assert tilt_deg < LIMIT_DEG
    assert heading_deg < limit_deg
    assert place_m < PLACE_M


def test_a_hovering_quadrotor_with_iron_at_its_compass_is_unsure_of_its_heading(
    data_dir: Path,
) -> None:
    """The field is 22 deg less steep than the Earth's there, and the heading some 25 deg off.

    From 110 s on its GPS runs off.
    """
    flight = read_flight(data_dir / "px4_f450_glitch.csv.gz")
    time_s = (flight.log.imu_time_us - flight.log.imu_time_us[0]) * 1e-6
    heading_std = run_eskf(flight)[:, NAV_ATTITUDE_STD + 2]
    assert (heading_std[(time_s > 5.0) & (time_s < 15.0)] > math.radians(10.0)).all()
    assert (heading_std[(time_s > 60.0) & (time_s < 110.0)] < math.radians(6.5)).all()


@pytest.mark.parametrize(("name", "state"), [("complementary", "iron_b"), ("eskf", "mag_bias_b")])
def test_iron_that_the_compass_carries_is_found_by_the_strength_of_the_field(
    flight: Flight, name: str, state: str
) -> None:
    imu, iron = flight.log.imu.copy(), (8.0, -6.0, 3.0)
    imu[:, MAG : MAG + 3] += iron
    carried = replace(flight, log=replace(flight.log, imu=imu))
    settings = EstimationSettings(estimator=name, reference=flight.reference)
    estimator = make_estimator(settings)
    out = estimator.run(carried.log)
    np.testing.assert_allclose(getattr(estimator.state, state), iron, atol=0.5)
    late = carried.log.imu_time_us * 1e-6 > 120.0
    assert attitude_scores(replace(carried, counts=late), out[:, :4])["heading"] < 1.5


def test_a_heading_that_nothing_tells_is_not_vouched_for(data_dir: Path) -> None:
    """Begun on a straight road: the pull of a speed of about zero is no heading."""
    spoilt = mid_air(read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz"))
    out, time_s = run_eskf(spoilt.flight), spoilt.flight.log.imu_time_us * 1e-6
    straight = time_s < spoilt.ends_s + 30.0
    flags = out[straight, NAV_FLAGS].astype(int)
    assert not (flags & int(NavFlags.HEADING_VALID)).any()
    assert (out[straight, NAV_ATTITUDE_STD + 2] > math.radians(50.0)).all()


@pytest.mark.parametrize("how", ["late_gps", "no_velocity", "mid_air"])
def test_a_real_car_tells_its_heading_while_it_is_known(data_dir: Path, how: str) -> None:
    """It has no compass: on a straight road its heading is not known, and not told."""
    flight = read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz")
    spoilt = SPOILS[how](flight)
    found = departure(
        flight, run_complementary(flight), spoilt.flight, run_complementary(spoilt.flight)
    )
    since_s = spoilt.ends_s + RECOVERY_S
    tilt_deg, heading_deg, place_m = found.as_told().after(since_s)
    assert max(tilt_deg, heading_deg) < LIMIT_DEG
    assert place_m < PLACE_M
    assert found.told_share(since_s) > 0.8


@pytest.mark.parametrize("how", SPOILS)
def test_real_quadrotor_with_iron_at_its_compass(data_dir: Path, how: str) -> None:
    """Its compass is up to 40 deg off: what depends on it is told as unsure.

    Its GPS runs off by 9 m/s. Of a velocity that is made of places, it depends on which two places
    they are what that tilts: 2.4 to 3.2 deg, without the first fixes.
    """
    flight = read_flight(data_dir / "px4_f450_glitch.csv.gz")
    spoilt = SPOILS[how](flight)
    out, spoilt_out = run_complementary(flight), run_complementary(spoilt.flight)
    found = departure(flight, out, spoilt.flight, spoilt_out)
    tilt_deg, heading_deg, place_m = found.after(spoilt.ends_s + RECOVERY_S)
    assert tilt_deg < (3.5 if how in ("no_velocity", "uncalibrated") else LIMIT_DEG)
    _, left, right = np.intersect1d(
        flight.log.imu_time_us, spoilt.flight.log.imu_time_us, return_indices=True
    )
    down = NAV_ATTITUDE_STD + 2
    told_deg = np.degrees(np.hypot(out[left, down], spoilt_out[right, down]))
    late = found.told & (found.time_s > spoilt.ends_s + RECOVERY_S)
    assert np.mean((found.heading_deg < 2.0 * told_deg)[late]) > 0.9
    if how != "no_velocity":
        unsure = {"no_mag": 4.5, "late_gps": 4.0, "mid_air": 4.0, "uncalibrated": 5.5}
        assert heading_deg < unsure.get(how, LIMIT_DEG)
        assert place_m < PLACE_M


def test_iron_that_bends_the_dip_is_seen_while_the_aircraft_stands(flight: Flight) -> None:
    """Turned by 20 deg, the compass is not vouched for; GPS finds the heading in flight."""
    imu = flight.log.imu.copy()
    imu[:, MAG : MAG + 3] += (12.0, 2.0, -14.0)
    carried = replace(flight, log=replace(flight.log, imu=imu))
    out, time_s = run_complementary(carried), carried.log.imu_time_us * 1e-6
    standing = (time_s > 8.0) & (time_s < 12.0)
    assert not (out[standing, NAV_FLAGS].astype(int) & int(NavFlags.HEADING_VALID)).any()
    late = replace(carried, counts=time_s > 60.0)
    assert attitude_scores(late, out[:, :4])["heading"] < 4.0
    assert share(two_sigma(late, out)["heading"]) > 0.9


@pytest.mark.parametrize("name", RUNS)
def test_nothing_is_told_that_is_not_known(flight: Flight, name: str) -> None:
    """Begun in flight: whatever the flags vouch for holds, and they do so in the end."""
    spoilt = mid_air(flight)
    out = RUNS[name](spoilt.flight)
    flags = out[:, NAV_FLAGS].astype(int)
    said = replace(spoilt.flight, counts=(flags & int(NavFlags.HEADING_VALID)) != 0)
    assert attitude_scores(said, out[:, :4])["total"] < 12.0
    late = spoilt.flight.log.imu_time_us * 1e-6 > spoilt.ends_s + RECOVERY_S
    assert (flags[late] & int(NavFlags.HEADING_VALID | NavFlags.ATTITUDE_VALID)).all()


def test_errors_are_within_what_complementary_tells(flight: Flight) -> None:
    """With fixes, and in outages of 10 s, where the place runs away."""
    within = two_sigma(flight, run_complementary(flight))
    assert min(map(share, within.values())) > 0.9
    out, inside, _ = next(outages(flight, run_complementary, 10.0))
    assert np.nanmedian(out[inside, NAV_POS_STD]) > 2.0
    for values in two_sigma(flight, out).values():
        assert share(values[inside]) > 0.9


def test_real_errors_are_within_what_complementary_tells(data_dir: Path) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    out = run_complementary(flight)
    assert min(map(share, two_sigma(flight, out).values())) > 0.88
    told_deg = np.degrees(np.nanmedian(out[flight.counts, NAV_ATTITUDE_STD + 2]))
    assert told_deg < 2.0


@pytest.mark.parametrize("name", RUNS)
def test_a_bias_that_changes_at_take_off_is_unlearned(flight: Flight, name: str) -> None:
    """What the gyroscope shows at rest is not what it shows in flight."""
    imu, time_s = flight.log.imu.copy(), flight.log.imu_time_us * 1e-6
    imu[time_s < 14.0, GYRO + 2] -= math.radians(0.9)
    changed = replace(flight, log=replace(flight.log, imu=imu))
    yaw_deg = attitude_scores(changed, RUNS[name](changed)[:, :4])["yaw"]
    assert yaw_deg < {"complementary": 2.5, "eskf": 2.0}[name]


@pytest.mark.parametrize("name", RUNS)
def test_the_place_moves_on_while_no_heading_is_known(flight: Flight, name: str) -> None:
    """Started in flight without a compass: between two fixes lie 3 m, not a held place."""
    spoilt = no_mag(mid_air(flight).flight).flight
    out = RUNS[name](spoilt)
    first_s = spoilt.log.gps_time_us[0] * 1e-6
    time_s = spoilt.log.imu_time_us * 1e-6
    early = (time_s > first_s + 0.5) & (time_s < first_s + 4.0)
    assert np.nanmax(position_errors_m(spoilt, out)[early]) < 6.0


@pytest.mark.parametrize("name", RUNS)
def test_a_fix_without_height_leaves_the_rest_of_it(flight: Flight, name: str) -> None:
    out = RUNS[name](SPOILS["no_height"](flight).flight)
    assert np.isfinite(out[:, :4]).all()
    settled = flight.log.imu_time_us > 20e6
    assert np.isfinite(out[settled][:, NAV_LAT : NAV_LAT + 2]).all()


@pytest.mark.parametrize("name", RUNS)
def test_turns_without_gps_are_not_taken_for_level(flight: Flight, name: str) -> None:
    """What pulls without the gyroscope turning is flown, and doubts the levelling."""
    alone = flight.with_gps(np.zeros(len(flight.log.gps), bool))
    out = RUNS[name](alone)
    found = attitude_scores(alone, out[:, :4])
    assert found["heading"] < 3.0
    assert found["inclination"] < 4.0
    within = two_sigma(alone, out)
    assert share(within["tilt"]) > 0.9
    assert share(within["heading"]) > 0.9


@pytest.mark.parametrize("begin_s", [70.0, 90.0])
def test_a_level_begun_in_turns_without_gps_teaches_no_bias_and_no_heading(
    flight: Flight, begin_s: float
) -> None:
    """It turns the compass, and comes back at a rate of its own."""
    alone = flight.with_gps(np.zeros(len(flight.log.gps), bool))
    spoilt = cut(alone, flight.log.imu_time_us * 1e-6 > begin_s)
    out = run_complementary(spoilt)
    valid = out[:, NAV_FLAGS].astype(int) & int(NavFlags.ATTITUDE_VALID) != 0
    told = replace(spoilt, counts=valid)
    assert valid.mean() > 0.8
    assert attitude_scores(told, out[:, :4])["inclination"] < 16.0
    assert share(two_sigma(told, out)["heading"][valid]) > 0.9


@pytest.mark.parametrize("name", RUNS)
def test_a_take_off_run_without_gps_is_neither_tilt_nor_rest(flight: Flight, name: str) -> None:
    """It pulls as steadily as gravity, with the gyroscope as quiet as at rest."""
    log, down = flight.log, flight.truth["down"]
    run = (np.linalg.norm(flight.truth["vel"], axis=1) > 8.0) & (down > down[0] - 20.0)
    first = int(np.argmax(run))
    use = np.zeros(len(run), bool)
    use[first : first + 300] = True
    alone = replace(flight.with_gps(np.zeros(len(log.gps), bool)), counts=use)
    out = RUNS[name](alone)
    assert attitude_scores(alone, out[:, :4])["inclination"] < 2.5
    assert not (out[use, NAV_FLAGS].astype(int) & int(NavFlags.AT_REST)).any()


@pytest.mark.parametrize("name", RUNS)
def test_real_turns_without_gps_are_reported_as_unsure(data_dir: Path, name: str) -> None:
    """The declination of the log's header counts before any fix."""
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    alone = flight.with_gps(np.zeros(len(flight.log.gps), bool))
    out = RUNS[name](alone)
    assert attitude_scores(alone, out[:, :4])["heading"] < 3.5
    within = two_sigma(alone, out)
    assert share(within["tilt"]) > 0.89
    assert share(within["heading"]) > 0.9
    assert (out[-1000:, NAV_FLAGS].astype(int) & int(NavFlags.HEADING_VALID)).all()


def test_a_long_outage_does_not_level_by_turns(flight: Flight) -> None:
    """What GPS has shown of the flight tells how it pulls afterwards."""
    out, inside, _ = next(outages(flight, run_complementary, 60.0))
    found = attitude_scores(replace(flight, counts=inside), out[:, :4])
    assert found["inclination"] < 4.5
    assert share(two_sigma(flight, out)["tilt"][inside]) > 0.85


def test_a_level_that_was_found_in_motion_is_kept(data_dir: Path) -> None:
    """Begun while carried: the first seconds level better than all that the alignment gathers."""
    flight = read_flight(data_dir / "broad_15_undisturbed_fast_translation_A.csv.gz")
    check_back(flight, "complementary", "mid_air")


@pytest.mark.parametrize(
    ("name", "how", "most_deg"),
    [
        ("broad_15_undisturbed_fast_translation_A", "silence", LIMIT_DEG),
        ("broad_15_undisturbed_fast_translation_A", "mid_air", 3.5),
        ("broad_30_disturbed_stationary_magnet_C", "silence", LIMIT_DEG),
    ],
)
def test_an_attitude_lost_in_a_motion_that_never_ends_is_found(
    data_dir: Path, name: str, how: str, most_deg: float
) -> None:
    tilt_deg, heading_deg, _ = off(read_flight(data_dir / f"{name}.csv.gz"), "eskf", how)
    assert tilt_deg < LIMIT_DEG
    assert heading_deg < most_deg


def test_fast_motion_is_no_noise_at_a_low_rate(data_dir: Path) -> None:
    """Beside a magnet the heading is the gyroscope's for most of the time."""
    flight = read_flight(data_dir / "broad_30_disturbed_stationary_magnet_C.csv.gz")
    check_back(flight, "eskf", "half_rate")


@pytest.mark.parametrize("begin_s", [65.0, 97.0])
@pytest.mark.parametrize(
    "name", ["broad_15_undisturbed_fast_translation_A", "broad_30_disturbed_stationary_magnet_C"]
)
def test_the_level_is_found_while_a_hand_shakes_it(
    data_dir: Path, name: str, begin_s: float
) -> None:
    """Its velocity only swings: within seconds, the mean of the force is gravity."""
    flight = read_flight(data_dir / f"{name}.csv.gz")
    time_s = flight.log.imu_time_us * 1e-6
    shaken = cut(flight, (time_s > begin_s) & (time_s < begin_s + 12.0))
    shaken = replace(shaken, counts=shaken.log.imu_time_us * 1e-6 > begin_s + 7.0)
    out = run_eskf(shaken)
    assert attitude_scores(shaken, out[:, :4])["inclination"] < LIMIT_DEG
    assert share(two_sigma(shaken, out)["tilt"]) > 0.9


@pytest.mark.parametrize(("begin_s", "length_s"), [(71.2, 8.0), (112.2, 4.0)])
def test_what_is_picked_up_in_a_silence_is_found_again(
    data_dir: Path, begin_s: float, length_s: float
) -> None:
    """Before, it rests or hardly moves; after, nothing is as it was."""
    flight = read_flight(data_dir / "broad_30_disturbed_stationary_magnet_C.csv.gz")
    time_s = flight.log.imu_time_us * 1e-6
    ends_s = begin_s + length_s
    spoilt = cut(flight, ((time_s < begin_s) | (time_s > ends_s)) & (time_s < ends_s + 20.0))
    late = spoilt.log.imu_time_us * 1e-6 > ends_s + 10.0
    out = run_eskf(spoilt)
    assert attitude_scores(replace(spoilt, counts=late), out[:, :4])["inclination"] < LIMIT_DEG


@pytest.mark.parametrize(
    "name", ["broad_02_undisturbed_slow_rotation_B", "broad_15_undisturbed_fast_translation_A"]
)
def test_a_heading_by_compass_alone_is_as_unsure_as_the_iron_left(
    data_dir: Path, name: str
) -> None:
    flight = read_flight(data_dir / f"{name}.csv.gz")
    assert share(two_sigma(flight, run_eskf(flight))["heading"]) > 0.95


@pytest.mark.parametrize(("name", "most_deg"), [("complementary", 1.5), ("eskf", 1.6)])
def test_a_real_compass_is_not_followed_into_its_slow_errors(
    data_dir: Path, name: str, most_deg: float
) -> None:
    flight = read_flight(data_dir / "broad_15_undisturbed_fast_translation_A.csv.gz")
    assert attitude_scores(flight, RUNS[name](flight)[:, :4])["total"] < most_deg


def test_the_level_needs_no_heading(data_dir: Path) -> None:
    """Turned for minutes without compass and GPS."""
    flight = read_flight(data_dir / "broad_30_disturbed_stationary_magnet_C.csv.gz")
    assert off(flight, "eskf", "no_mag")[0] < 1.0


def test_every_way_of_spoiling_applies_to_a_whole_flight(flight: Flight) -> None:
    assert all(applies(how, flight) for how in SPOILS)
