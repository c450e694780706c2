"""The complementary estimator as the live pipeline calls it: records by their addresses."""

from typing import Final

from gateway.compiled import compiled, record_at
from gateway.estimation.complementary.complementary_kernels import run, start, take_imu
from gateway.estimation.complementary.complementary_output import write_output
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.intake import take_gps
from gateway.estimation.complementary.navigation import take_baro
from gateway.estimation.kernel import Kernels
from gateway.estimation.kernel_record import FloatArray, layout

STATE_LAYOUT: Final = layout(ComplementaryState)
GAINS_LAYOUT: Final = layout(ComplementaryGains)


@compiled
def imu_step(state: int, gains: int, time_us: int, row: FloatArray, output: FloatArray) -> None:
    """Take one IMU sample live, and write the output row; records by their addresses."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    take_imu(
        s, p, time_us,
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9],
    )  # fmt: skip
    write_output(s, output)


@compiled
def baro_step(state: int, gains: int, alt_m: float) -> None:
    """Take one barometer sample live."""
    take_baro(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), alt_m)


@compiled
def gps_step(state: int, gains: int, arrival_us: int, row: FloatArray) -> None:
    """Take one fix live."""
    take_gps(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), arrival_us, row)


KERNELS: Final[Kernels[ComplementaryState, ComplementaryGains]] = Kernels(
    declaration=ComplementaryState,
    start=start,
    imu=imu_step,
    baro=baro_step,
    gps=gps_step,
    run=run,
)
