"""A whole log through the chain's filters gives the bits that its samples give."""

import math

import numpy as np

from gateway.records import ImuFlags
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensingSettings, SensorChain


def test_same_bits_over_a_gap_another_rate_and_nonsense() -> None:
    rng = np.random.default_rng(3)
    time_us = np.cumsum(np.r_[np.full(900, 10_000), 3_000_000, np.full(1200, 4_000)])
    accel, gyro = rng.normal(0.0, 1.0, (2, len(time_us), 3))
    accel[400, 1] = gyro[401, 2] = math.nan
    settings = SensingSettings(gyro_highpass_hz=0.05)
    chain = SensorChain(settings, NodeCalibration())
    samples = [
        chain.imu_si(t, tuple(a), tuple(g), None, math.nan, ImuFlags(0))
        for t, a, g in zip(time_us.tolist(), accel.tolist(), gyro.tolist(), strict=True)
    ]
    whole = SensorChain(settings, NodeCalibration())
    found_accel, found_gyro = whole.filter_log(time_us, accel, gyro)
    np.testing.assert_array_equal(found_accel, [s.accel_lowpass_b_mps2 for s in samples])
    np.testing.assert_array_equal(found_gyro, [s.gyro_highpass_b_radps for s in samples])
    assert whole.snapshot() == chain.snapshot()
