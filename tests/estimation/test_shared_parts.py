"""The parts that both compiled estimators are made of."""

import math
from typing import Annotated

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import GPS_COLUMNS, GPS_SPEED_ACC
from gateway.estimation.complementary.complementary_state import (
    ComplementarySettings,
    ComplementaryState,
    make_gains,
)
from gateway.estimation.complementary.errors.compass_error import compass_variance, note_field
from gateway.estimation.complementary.intake import reported_noise
from gateway.estimation.filtering.height_intake import is_height_told
from gateway.estimation.filtering.steady_turn import turns_steadily
from gateway.estimation.kernel_record import FloatArray, copy_record, filled_record, new_record
from gateway.estimation.local_position import PlaceState, is_relocked, move_origin
from gateway.estimation.magfield import (
    LIKE_DIP_RAD,
    NEW_FIELD_S,
    STUCK_TURN_RAD,
    CompassSettings,
    compare_field,
    field_unlikeness,
    is_field_told,
)
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings, watch_rest
from gateway.estimation.sensor_faults import (
    HOLD_S,
    UNKNOWN_HOLD_S,
    HealthState,
    check_sensors,
    is_hanging,
)

GAINS = make_gains(ComplementarySettings(), ReferenceSettings(), RestSettings(), CompassSettings())
LEVEL = (0.0, 0.0, -9.81)


class TestRecord:
    class Declared:
        count: int
        matrix: Annotated[FloatArray, (2, 2)]

    def test_copies_do_not_share_memory(self) -> None:
        record = new_record(self.Declared)
        copy = copy_record(record)
        record.matrix[0, 1] = 5.0
        assert (copy.matrix[0, 1], record.matrix[0, 1]) == (0.0, 5.0)

    def test_a_field_without_a_value_is_an_error(self) -> None:
        with pytest.raises(KeyError, match="matrix"):
            filled_record(self.Declared, {"count": 1})


class TestRest:
    def watch(self, gyro, accel=lambda t: LEVEL, moving: bool = False, seconds: float = 4.0) -> int:
        state = new_record(ComplementaryState)
        state.accel_lp[2] = LEVEL[2]
        for k in range(round(seconds * 100)):
            watch_rest(state, GAINS, gyro(k / 100), accel(k / 100), moving, math.inf, 0.01)
        return int(state.at_rest)

    def test_still(self) -> None:
        assert self.watch(lambda t: (0.01, 0.0, 0.0)) == 1

    def test_too_short(self) -> None:
        assert self.watch(lambda t: (0.0, 0.0, 0.0), seconds=1.0) == 0

    def test_trembling(self) -> None:
        assert self.watch(lambda t: (0.2 * math.sin(30 * t), 0.0, 0.0)) == 0

    @pytest.mark.parametrize(("wander_radps", "rests"), [(0.0, 1), (0.03, 0)])
    def test_an_idling_engine_shakes_but_leaves_the_average(
        self, wander_radps: float, rests: int
    ) -> None:
        """A hover is as shaken, and its average wanders."""

        def gyro(t: float) -> tuple[float, float, float]:
            return (0.06 * math.sin(190 * t), wander_radps * math.sin(3 * t), 0.0)

        assert self.watch(gyro) == rests

    def test_shaking(self) -> None:
        def shaken(t: float) -> tuple[float, float, float]:
            return (3.0 * math.sin(30 * t), 0.0, -9.81)

        assert self.watch(lambda t: (0.0, 0.0, 0.0), shaken) == 0

    def test_a_smooth_turn_is_no_rest(self) -> None:
        assert self.watch(lambda t: (0.0, 0.0, 0.2)) == 0

    def test_never_in_flight(self) -> None:
        assert self.watch(lambda t: (0.0, 0.0, 0.0), moving=True) == 0

    @pytest.mark.parametrize(
        ("rate_radps", "shown", "turns"),
        [
            ((0.0, 0.0, 0.05), 1, True),
            ((0.0, 0.0, 0.05), 0, False),
            ((0.0, 0.0, 0.01), 1, False),
            ((0.05, 0.0, 0.0), 1, False),
            ((0.04, 0.0, 0.05), 1, False),
        ],
        ids=["about down", "bias not known", "within the bias", "about level", "leaning"],
    )
    def test_a_steady_rate_is_a_turn_where_gravity_and_a_known_bias_allow_it(
        self, rate_radps: tuple[float, float, float], shown: int, turns: bool
    ) -> None:
        state = new_record(ComplementaryState)
        state.bias_shown, state.accel_lp[:], state.gyro_lp[:] = shown, LEVEL, rate_radps
        assert turns_steadily(state, (0.0, 0.0, 0.0), 0.001, 0.01) == turns

    @pytest.mark.parametrize("field_turns", [True, False])
    def test_what_turns_for_long_is_a_bias_unless_the_compass_turns_too(
        self, field_turns: bool
    ) -> None:
        state, still = new_record(ComplementaryState), (0.0, 0.0, 0.0)
        state.bias_shown, state.accel_lp[:], state.gyro_lp[2] = 1, LEVEL, 0.05
        state.rate_b[2] = 0.05
        told = []
        for k in range(6000):
            angle = -0.05 * 0.01 * k * field_turns
            field = (20.0 * math.cos(angle), 20.0 * math.sin(angle), 40.0 + 0.01 * (k % 2))
            is_field_told(state, field, 0.01)
            told.append(turns_steadily(state, still, 0.001, 0.01))
        assert told[0]
        assert told[-1] == field_turns


@pytest.mark.parametrize(
    ("told_mps", "noise_mps"), [(math.nan, 0.3), (0.1, 0.3), (3.0, math.sqrt(3.0))]
)
def test_a_receiver_that_calls_its_velocity_bad_is_believed(
    told_mps: float, noise_mps: float
) -> None:
    row = np.full(GPS_COLUMNS, math.nan)
    row[GPS_SPEED_ACC] = told_mps
    assert reported_noise(GAINS, row) == pytest.approx(noise_mps)


class TestField:
    def feed(
        self, state: ComplementaryState, norm: float, seconds: float, rate: float = 1.0
    ) -> float:
        state.rate_b[2] = rate
        for _ in range(round(seconds * 20)):
            weight = compare_field(state, GAINS, norm, 1.1, 0.05)
        return weight

    def test_a_strange_field_is_not_believed_and_a_lasting_one_is(self) -> None:
        state = new_record(ComplementaryState)
        assert self.feed(state, 45.0, 10.0) == 1.0
        assert state.mag_norm_ref == pytest.approx(45.0)
        assert self.feed(state, 70.0, 2.0) == 0.0
        assert state.mag_disturbed == 1
        assert self.feed(state, 45.0, 2.0) == 1.0
        assert self.feed(state, 70.0, NEW_FIELD_S + 2.0) == 1.0
        assert state.mag_norm_ref == pytest.approx(70.0, rel=0.05)

    def test_a_strange_field_at_a_standstill_stays_strange(self) -> None:
        state = new_record(ComplementaryState)
        self.feed(state, 45.0, 10.0)
        self.feed(state, 70.0, NEW_FIELD_S + 5.0, rate=0.0)
        assert state.mag_disturbed == 1

    def test_turns_that_leave_the_strength_the_same_show_a_compass_without_iron(self) -> None:
        state = new_record(ComplementaryState)
        for k in range(1200):
            angle = 0.3 * 0.05 * k
            field = (30.0 * math.cos(angle), -30.0 * math.sin(angle), 5.0)
            note_field(state, field, math.hypot(*field), 0.05)
        assert math.sqrt(compass_variance(state, GAINS)) < 0.7 * GAINS.heading_noise_rad
        state.level_by_gps = 1
        assert math.sqrt(compass_variance(state, GAINS)) == pytest.approx(GAINS.heading_noise_rad)

    def test_a_compass_that_has_not_turned_is_as_good_as_expected(self) -> None:
        state = new_record(ComplementaryState)
        for _ in range(1200):
            note_field(state, (20.0, 0.0, 40.0), math.hypot(20.0, 40.0), 0.05)
        std = math.sqrt(compass_variance(state, GAINS))
        assert std == pytest.approx(GAINS.heading_noise_rad, rel=1e-6)

    def test_a_field_counts_by_its_unlikeness_to_the_usual_one(self) -> None:
        state = new_record(ComplementaryState)
        assert field_unlikeness(state, 45.0, 1.1) == 1.0
        self.feed(state, 45.0, 10.0)
        assert field_unlikeness(state, 45.0, 1.1) == pytest.approx(1.0)
        assert field_unlikeness(state, 45.0, 1.1 + LIKE_DIP_RAD) == pytest.approx(2.0)
        assert field_unlikeness(state, 52.0, 1.1) > 10.0


def test_stuck_sensors() -> None:
    state = new_record(HealthState)
    rng = np.random.default_rng(1)
    for _ in range(150):
        verdict = check_sensors(state, (0.3, 0.0, 0.0), tuple(rng.normal(size=3)), 0.0, 0.01)
    assert tuple(verdict) == (False, True)
    for _ in range(150):
        verdict = check_sensors(state, (0.3, 0.0, 0.0), LEVEL, 0.0, 0.01)
    assert tuple(verdict) == (True, True)


class TestHang:
    """Both sensors repeat a sample of 10 ms, as behind a bus that hangs."""

    @pytest.fixture
    def state(self) -> HealthState:
        state = new_record(HealthState)
        state.usual_hold_s = UNKNOWN_HOLD_S
        return state

    def feed(self, state: HealthState, seconds: float, hold: int, may_rest: bool = False) -> bool:
        """Feed noise, each sample so many times; return whether any was taken for a hang."""
        rng, found = np.random.default_rng(1), False
        for _ in range(round(seconds * 100 / hold)):
            gyro, accel = tuple(rng.normal(size=3)), tuple(rng.normal(size=3))
            for _ in range(hold):
                hangs = is_hanging(state, gyro, accel, may_rest, 0.01)
                found = found or hangs
                if not hangs:
                    check_sensors(state, gyro, accel, 0.0, 0.01)
        return found

    def test_is_found_after_the_time_that_a_sample_may_be_held(self, state: HealthState) -> None:
        assert not self.feed(state, 60.0, 1)
        last = tuple(state.gyro_last), tuple(state.accel_last)
        hangs = [is_hanging(state, *last, False, 0.01) for _ in range(150)]
        assert hangs.index(True) == pytest.approx(100 * HOLD_S, abs=1)
        assert all(hangs[hangs.index(True) :])
        assert not self.feed(state, 1.0, 1)
        assert self.feed(state, 1.0, 50)

    @pytest.mark.parametrize("hold", [2, 10])
    def test_a_log_may_hold_its_samples(self, state: HealthState, hold: int) -> None:
        assert not self.feed(state, 60.0, hold)

    def test_an_input_that_always_was_so_is_none(self, state: HealthState) -> None:
        assert not self.feed(state, 60.0, 500)

    def test_a_rest_without_noise_is_none(self, state: HealthState) -> None:
        assert not self.feed(state, 60.0, 1)
        assert not self.feed(state, 60.0, 3000, may_rest=True)


class TestOddSamples:
    """One sample in 10 ms that is far from the others, as after noise on the sensors' bus."""

    STILL = (0.01, 0.0, 0.0)

    @pytest.fixture
    def state(self) -> HealthState:
        state = new_record(HealthState)
        self.settle(state)
        return state

    def settle(self, state: HealthState, gyro=STILL, accel=LEVEL, samples: int = 100) -> None:
        for _ in range(samples):
            check_sensors(state, gyro, accel, 0.0, 0.01)

    def verdict(self, state: HealthState, gyro=STILL, accel=LEVEL) -> tuple[bool, bool]:
        return tuple(check_sensors(state, gyro, accel, 0.0, 0.01))

    @pytest.mark.parametrize(
        "odd", [{"gyro": (30.0, 0.0, 0.0)}, {"accel": (0.0, 150.0, 0.0)}], ids=["rate", "force"]
    )
    def test_is_left_out_and_no_fault(self, state: HealthState, odd) -> None:
        assert self.verdict(state, **odd) == (False, False)
        assert state.fault == 0
        assert tuple(state.gyro_held) == self.STILL
        assert tuple(state.accel_held) == LEVEL
        assert self.verdict(state) == (True, True)

    def test_is_believed_if_the_next_one_agrees(self, state: HealthState) -> None:
        turning = (0.0, 12.0, 0.0)
        assert self.verdict(state, turning) == (False, False)
        assert self.verdict(state, turning) == (True, True)
        assert self.verdict(state) == (False, False)
        assert self.verdict(state) == (True, True)

    def test_two_that_differ_are_both_left_out(self, state: HealthState) -> None:
        assert self.verdict(state, (30.0, 0.0, 0.0)) == (False, False)
        assert self.verdict(state, (0.0, -30.0, 0.0)) == (False, False)
        assert self.verdict(state) == (True, True)

    def test_what_an_agile_multirotor_does_is_not_odd(self, state: HealthState) -> None:
        for k in range(20):
            assert self.verdict(state, (0.01 + 1.5 * k, 0.0, 0.0)) == (True, True)

    def test_a_vibration_is_believed_within_half_a_second(self, state: HealthState) -> None:
        rng = np.random.default_rng(2)
        shaken = rng.normal(LEVEL, 60.0, (200, 3))
        believed = [self.verdict(state, accel=tuple(force))[1] for force in shaken]
        assert not believed[0]
        assert all(believed[50:])

    def test_all_zeros_are_no_sample(self, state: HealthState) -> None:
        assert self.verdict(state, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) == (False, False)
        assert self.verdict(state, (0.0, 0.0, 0.0)) == (True, True)


class TestOddHeights:
    @pytest.fixture
    def state(self) -> ComplementaryState:
        state = new_record(ComplementaryState)
        state.started = 1
        assert not self.odd(state, 150.0)
        state.baro_known = 1
        return state

    def odd(self, state: ComplementaryState, alt_m: float) -> bool:
        state.time_s += 0.04
        found = not is_height_told(state, alt_m)
        state.baro_s = state.time_s
        return found

    def test_one_far_from_the_others_is_left_out(self, state: ComplementaryState) -> None:
        assert [self.odd(state, alt_m) for alt_m in (9000.0, -500.0, 151.0)] == [True, True, False]
        assert state.baro_known == 1

    def test_one_that_the_next_agrees_with_begins_anew(self, state: ComplementaryState) -> None:
        assert [self.odd(state, alt_m) for alt_m in (210.0, 211.0)] == [True, False]
        assert state.baro_known == 0

    def test_a_dive_is_followed(self, state: ComplementaryState) -> None:
        assert not any(self.odd(state, 150.0 - 4.0 * k) for k in range(30))
        assert state.baro_known == 1


class TestFieldThatIsTold:
    FIELD = (20.0, -3.0, 41.0)

    def test_not_without_a_value(self) -> None:
        state = new_record(ComplementaryState)
        for field in ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)):
            assert not is_field_told(state, field, 0.01)

    @pytest.mark.parametrize(
        ("mounting", "told"),
        [
            (np.eye(3), True),
            (np.diag([-1.0, 1.0, 1.0]), False),
            (np.diag([1.0, 1.0, -1.0]), False),
            (np.eye(3)[[1, 0, 2]], False),
            (np.eye(3)[[1, 2, 0]], False),
        ],
        ids=["right", "x reversed", "z reversed", "x and y swapped", "turned"],
    )
    @pytest.mark.parametrize("iron_ut", [0.0, 15.0])
    def test_one_that_turns_otherwise_than_the_aircraft_is_not_believed(
        self, mounting: np.ndarray, told: bool, iron_ut: float
    ) -> None:
        state, rng = new_record(ComplementaryState), np.random.default_rng(1)
        field, found = np.array(self.FIELD), []
        for k in range(6000):
            if k % 100 == 0:
                rate = rng.normal(0.0, 0.7, 3)
                state.rate_b[:] = rate
            field = Rotation.from_rotvec(-0.01 * rate).apply(field)
            measured = mounting @ field + rng.normal(0.0, 0.5, 3) + (iron_ut, 0.0, 0.0)
            # Each field comes twice.
            found += [is_field_told(state, tuple(measured), dt) for dt in (0.01, 0.0)]
        assert found[0]
        assert set(found[6000:]) == {told}

    def test_one_that_stands_still_while_the_aircraft_turns_is_not_believed(self) -> None:
        state = new_record(ComplementaryState)
        state.rate_b[2] = 0.5
        told = [is_field_told(state, self.FIELD, 0.01) for _ in range(100)]
        assert told.index(False) == pytest.approx(STUCK_TURN_RAD / 0.5 / 0.01, abs=2)
        assert is_field_told(state, (20.1, -3.0, 41.0), 0.01)

    def test_one_that_stands_still_over_a_turn_to_and_fro_is_not_believed_again(self) -> None:
        state, told = new_record(ComplementaryState), []
        for rate in (0.5, -0.5):
            state.rate_b[2] = rate
            told += [is_field_told(state, self.FIELD, 0.01) for _ in range(100)]
        assert told[0]
        assert not any(told[100:])

    def test_what_the_bias_turns_at_rest_shows_no_hanging_compass(self) -> None:
        state = new_record(ComplementaryState)
        state.at_rest, state.rate_b[2] = 1, 0.01
        assert all(is_field_told(state, self.FIELD, 0.01) for _ in range(1000))

    def test_one_that_stands_still_at_rest_or_between_its_own_samples_is(self) -> None:
        state = new_record(ComplementaryState)
        assert all(is_field_told(state, self.FIELD, 0.01) for _ in range(1000))
        state.rate_b[2] = 0.9
        for k in range(20):
            field = (20.0, -3.0 - k, 41.0)
            assert all(is_field_told(state, field, 0.01) for _ in range(5))


def test_rejected_fixes_are_believed_when_they_agree() -> None:
    state = new_record(PlaceState)
    state.reject_last[0] = -1e9
    believed = []
    for k in range(60):
        state.time_s = 0.2 * k
        believed.append(is_relocked(state, 8.0, (300.0 + k, 0.0, 0.0), (5.0, 0.0, 0.0)))
    assert believed.index(True) == pytest.approx(8.0 / 0.2, abs=2)
    wild = new_record(PlaceState)
    wild.reject_last[0] = -1e9
    for k in range(200):
        wild.time_s = 0.2 * k
        assert not is_relocked(wild, 8.0, (300.0 * (k % 2), 0.0, 0.0), (0.0, 0.0, 0.0))


def test_the_origin_moves_along_and_the_place_stays() -> None:
    state = new_record(PlaceState)
    move_origin(state, 47.0, 8.0)
    assert (state.origin_lat, state.origin_lon) == (47.0, 8.0)
    state.pos_n[0] = 6_000.0
    move_origin(state, 47.0, 8.0)
    assert state.origin_lat > 47.05
    assert abs(state.pos_n[0]) < 1e-6
