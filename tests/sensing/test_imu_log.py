"""Many payloads at once are calibrated and filtered to the bits that they have one by one."""

import numpy as np
import pytest

from gateway.records import ImuFlags, ImuRaw
from gateway.sensing.calibration import MAG_OVERFLOW, NodeCalibration, imu_counts
from gateway.sensing.chain import ImuLog, SensorChain
from tests.kit.records import raw_at

CALIBRATION = NodeCalibration(
    accel_bias_mps2=(0.1, -0.2, 0.3),
    accel_matrix=((1.01, 0.02, 0.0), (0.0, 0.99, 0.01), (0.03, 0.0, 1.02)),
    gyro_bias_radps=(0.01, 0.02, -0.03),
    mag_hard_iron_ut=(3.0, -4.0, 5.0),
)


def payloads(seed: int) -> list[ImuRaw]:
    """Make payloads of all ranges and flags, with gaps, overflows, blanks, and clocks set back."""
    rng = np.random.default_rng(seed)
    found, time_us = [], 0
    for _ in range(400):
        time_us += int(rng.choice([10_000, 10_000, 10_000, 20_000, 0, -5_000, 700_000]))
        blank = rng.random() < 0.03
        mag = tuple(rng.choice([-300, 200, 5, MAG_OVERFLOW], 3, p=[0.4, 0.3, 0.25, 0.05]).tolist())
        inertial = rng.integers(-32768, 32768, (2, 3)).tolist()
        found.append(
            raw_at(
                time_us,
                accel_raw=(0, 0, 0) if blank else tuple(inertial[0]),
                gyro_raw=tuple(inertial[1]),
                mag_raw=(0, 0, 0) if blank else mag,
                temperature_raw=int(rng.integers(-4000, 4000)),
                accel_range_g=int(rng.choice([2, 4, 8, 16])),
                gyro_range_dps=int(rng.choice([250, 500, 1000, 2000, 125, 0])),
                mag_lsb_per_gauss=int(rng.choice([1090, 820, 0])),
                flags=ImuFlags(int(rng.integers(0, 256))),
            )
        )
    return found


@pytest.mark.parametrize("seed", range(3))
def test_calibrated_log_equals_its_single_samples_to_the_bit(seed: int) -> None:
    raws = payloads(seed)
    chain = SensorChain(CALIBRATION)
    expected = [chain.imu(raw) for raw in raws]
    counts = imu_counts(raws)
    flags = np.array([int(raw.flags) for raw in raws])
    found = []
    for part in (slice(0, 7), slice(7, 8), slice(8, 8), slice(8, None)):
        time_us = np.array([raw.time_us for raw in raws[part]], np.int64)
        found += ImuLog(time_us, *chain.calibrated(counts[part], flags[part])).samples()
    assert repr(found) == repr(expected)
