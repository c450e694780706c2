"""Whether the sensors are calibrated. Once one is, what was found of its error is out of it."""

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    FORCE,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import (
    begin_state,
    carry_drift,
    force_bias_var,
    forget_iron,
)
from gateway.estimation.filtering.iron_evidence import forget_strength
from gateway.estimation.filtering.uncalibrated import note_flags
from gateway.estimation.kernel_record import FloatArray, fill
from gateway.estimation.rest_bias import forget_shown_bias


@compiled
def note_calibration(s: ComplementaryState, p: ComplementaryGains, row: FloatArray) -> None:
    """Note what a sample's row says of the calibration of its sensors."""
    mag, gyro, accel = note_flags(s, row)
    if mag and s.mag_uncalibrated == 0:
        carry_drift(s, p)
        forget_iron(s)
        forget_strength(s)
    if gyro:
        forget_gyro_bias(s, p)
    if accel:
        forget_accel_bias(s, p)


@compiled
def forget_gyro_bias(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Know nothing of the gyroscope's bias."""
    carry_drift(s, p)
    fill(s.bias_b, 0.0)
    forget_shown_bias(s)
    for k in range(3):
        begin_state(s, k, p.bias_initial_radps**2)


@compiled
def forget_accel_bias(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Know nothing of the accelerometer's bias."""
    carry_drift(s, p)
    fill(s.accel_bias_b, 0.0)
    for k in range(FORCE, FORCE + 3):
        begin_state(s, k, force_bias_var(s))
