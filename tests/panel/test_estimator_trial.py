from collections.abc import Iterable
from itertools import chain
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.estimation.select import ESTIMATORS
from gateway.panel.estimator_trial import LEAST_HZ, LEAST_S, ComparisonError, compare, settings_of
from gateway.panel.state.fields import FUSED_SPAN_US, SampleMemory
from gateway.units import US_PER_S
from tests.kit.recordings import START_US
from tests.panel.messages import decoded


def imu(time_us: int) -> Any:
    """A message of a level aircraft that faces east, as it comes off the line: with its frame."""
    values = (0, 0, -9.8, 0, 0, 0, 0, -0.2, 0.4, 0, 0, 0, 20, 0xFFFF)
    return decoded(mavlink.MAVLink_highres_imu_message(time_us, *values))


def collected(received_us: Iterable[int], *, quantum_us: int = 1) -> SampleMemory:
    """Return samples of aircraft 1, whose own times are multiples of a quantum."""
    memory = SampleMemory()
    for time_us in received_us:
        memory.add(imu(time_us // quantum_us * quantum_us), time_us)
    return memory


def test_parameters_are_converted_to_settings() -> None:
    found = settings_of({"PAPER_ALPHA_GYRO": 0.75, "EST_ESTIMATOR": 1.0, "CAL_ACC_BIAS_X": 3.0})
    assert found.estimation.paper.alpha_gyro == 0.75


@pytest.mark.parametrize("value", [7.0, float("nan")])
def test_value_out_of_range_leaves_the_default(value: float) -> None:
    assert settings_of({"PAPER_ALPHA_GYRO": value}) == settings_of({})


def test_too_few_samples_are_refused_with_the_reason() -> None:
    with pytest.raises(ComparisonError, match="no sensor samples"):
        compare([], {})
    with pytest.raises(ComparisonError, match="2 s of samples at 50 Hz"):
        compare([*collected(range(0, 2 * US_PER_S, 20_000)).frames], {})


SHARES = [(50, 10, 0.5), (10, 40, 0.5), (25, 21, 1.0), (50, 60, 1.0)]


@pytest.mark.parametrize(("rate_hz", "seconds", "share"), SHARES)
def test_share_of_the_needed_samples_is_reported(rate_hz: int, seconds: int, share: float) -> None:
    assert SampleMemory().collected(LEAST_S, LEAST_HZ) == 0.0
    times_us = (7 * US_PER_S + n * US_PER_S // rate_hz for n in range(rate_hz * seconds + 1))
    memory = collected(times_us)
    assert memory.collected(LEAST_S, LEAST_HZ) == pytest.approx(share, abs=0.03)


def test_newest_samples_suffice_if_the_earlier_ones_came_too_slowly() -> None:
    slow = range(0, 150 * US_PER_S, US_PER_S)
    memory = collected(chain(slow, range(150 * US_PER_S, 172 * US_PER_S, 20_000)))
    found = compare([*memory.frames], {})
    assert np.ptp(found[0].time_us) / US_PER_S == pytest.approx(LEAST_S + 1.0, abs=1.0)


def test_samples_with_repeated_times_are_fused() -> None:
    memory = collected(range(0, 24 * US_PER_S, 20_000), quantum_us=100_000)
    found = compare([*memory.frames], {})
    assert [each.name for each in found] == list(ESTIMATORS)
    assert {len(each.time_us) for each in found} == {120}
    # NaN until they have started.
    assert all(np.isfinite(each.roll_deg[10:]).all() for each in found)


def test_estimates_have_the_civil_times_and_angles_of_the_samples() -> None:
    memory = SampleMemory()
    for time_us in range(0, 24 * US_PER_S, 20_000):
        memory.add(imu(time_us), START_US + time_us)
    for found in compare([*memory.frames], {}):
        ages_s = (found.time_us - START_US) / US_PER_S
        assert (ages_s[0], ages_s[-1]) == pytest.approx((0.0, 24.0), abs=0.3)
        angles = found.roll_deg[-1], found.pitch_deg[-1], found.yaw_deg[-1]
        assert angles == pytest.approx((0.0, 0.0, 90.0), abs=2.0), found.name


def test_only_the_newest_minutes_of_sensor_frames_are_stored() -> None:
    memory = SampleMemory()
    memory.add(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3), 0)
    assert not memory.frames
    memory = collected(range(0, 400 * US_PER_S, US_PER_S))
    times = [time_us for time_us, _ in memory.frames]
    assert times[-1] - times[0] == FUSED_SPAN_US
