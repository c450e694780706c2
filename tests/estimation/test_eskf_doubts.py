"""What the eskf doubts: the heading it began with, the field it was read in, a rest that ended."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.eskf.eskf_settings import EskfSettings, make_gains
from gateway.estimation.eskf.eskf_state import TILT, EskfState
from gateway.estimation.eskf.measure import update_by_compass
from gateway.estimation.eskf.start import start_heading_by_compass
from gateway.estimation.flagbits import HEADING_VALID_RAD
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import ImuSample, NavFlags, NavState
from tests.estimation.samples import G, imu, times

REFERENCE = ReferenceSettings(declination="fixed", declination_deg=0.0)
GAINS = make_gains(EskfSettings(), REFERENCE, RestSettings(), CompassSettings())


def states(samples: Iterable[ImuSample], name: str = "eskf") -> list[NavState]:
    estimator = make_estimator(EstimationSettings(estimator=name, reference=REFERENCE))
    return [estimator.update_imu(sample) for sample in samples]


def field(dip_deg: float) -> tuple[float, float, float]:
    dip = math.radians(dip_deg)
    return (45.0 * math.cos(dip), 0.0, 45.0 * math.sin(dip))


def carried_off(bent_deg: float) -> Iterable[ImuSample]:
    """Stand for 8 s and be carried about then; only over iron is the field another then."""
    for t in times(14.0):
        moves = t >= 8_000_000
        swing = 2.0 * math.sin(6.0e-6 * t) if moves else 0.0
        mag = field(30.0 if moves else 30.0 - bent_deg) if t % 50_000 == 0 else None
        yield imu(t, (swing, 0.0, -G), mag=mag)


@pytest.mark.parametrize("tilt_rad", [(0.03, 0.0), (0.0, -0.03)])
def test_a_first_heading_knows_of_the_tilt_it_was_read_with(tilt_rad: tuple[float, float]) -> None:
    """A level that is found later turns the heading back by what the field's dip has turned it."""
    s, field_n = new_record(EskfState), np.array([20.0, 6.0, 40.0])
    for k in range(2):
        s.P[TILT + k, TILT + k] = 0.05**2
    s.P[TILT + 2, TILT + 2] = 3.0
    # Upright in the estimate, tilted in truth: the field is seen in the tilted body.
    true = Rotation.from_rotvec([*tilt_rad, 0.0])
    seen = tuple(true.inv().apply(field_n).tolist())
    s.q_nb[0] = 1.0
    declination = math.atan2(field_n[1], field_n[0])
    noise_var = 0.01**2
    start_heading_by_compass(s, GAINS, seen, declination - math.atan2(seen[1], seen[0]), noise_var)
    found = Rotation.from_quat(s.q_nb, scalar_first=True)
    error = (true * found.inv()).as_rotvec()
    explained = sum(s.P[TILT + 2, k] / s.P[k, k] * error[k] for k in range(2))
    assert error[2] == pytest.approx(explained, abs=0.006)
    assert abs(error[2]) > 0.01
    level = (s.P[TILT + 2, 0] ** 2 + s.P[TILT + 2, 1] ** 2) / 0.05**2
    assert s.P[TILT + 2, TILT + 2] == pytest.approx(noise_var + level, rel=0.05)


@pytest.mark.parametrize(("bent_deg", "low_deg", "high_deg"), [(0.0, 0.5, 3.0), (14.0, 7.0, 20.0)])
def test_a_heading_read_over_iron_is_as_unsure_as_the_field_has_proved_bent(
    bent_deg: float, low_deg: float, high_deg: float
) -> None:
    state = states(carried_off(bent_deg))[-1]
    assert low_deg < math.degrees(state.attitude_std_rad[2]) < high_deg


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_heading_is_valid_exactly_where_it_is_reported_as_sure(name: str) -> None:
    found = states(carried_off(30.0), name)
    sure = [state.attitude_std_rad[2] < HEADING_VALID_RAD for state in found]
    assert set(sure) == {False, True}
    assert [NavFlags.HEADING_VALID in state.flags for state in found] == sure


@pytest.mark.parametrize(
    ("accel", "known"),
    [((0.0, 0.0, -G), True), ((0.0, -G, 0.0), False)],
    ids=["rests", "picked up"],
)
def test_a_rest_that_ended_in_a_silence_is_noticed_at_the_first_sample(
    accel: tuple[float, float, float], known: bool
) -> None:
    before = [imu(t) for t in times(10.0)]
    after = imu(before[-1].time_us + 4_000_000 + 10_000, accel)
    state = states([*before, imu(after.time_us - 10_000, accel), after])[-1]
    assert (NavFlags.ATTITUDE_VALID in state.flags) is known


def test_a_compass_is_weighed_by_the_iron_that_its_strength_shows_and_nothing_explains() -> None:
    def gained(misfit_ut2: float) -> float:
        """Return how much surer of the heading a second of compass makes the filter."""
        s, told = new_record(EskfState), 0.1**2
        s.q_nb[0], s.P[TILT + 2, TILT + 2] = 1.0, told
        s.iron_norm, s.iron_misfit = 45.0, misfit_ut2
        for _ in range(20):
            update_by_compass(s, GAINS, field(60.0), 0.0, 1.0, 0.05)
        return 1.0 / s.P[TILT + 2, TILT + 2] - 1.0 / told

    assert gained(1.0) == gained(0.0)
    # 9 uT of iron against 22 level: 22 degrees, for some 20 s.
    assert gained(81.0) < 0.05 * gained(0.0)
    assert gained(81.0) == pytest.approx((1.0 / 20.0) / (81.0 / 22.5**2), rel=0.1)
