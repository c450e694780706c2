"""How a sample reaches the compiled equations of the paper's estimator."""

from typing import Final

from gateway.compiled import array_at, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.kernel_record import as_quat, as_vec, write_quat, write_vec
from gateway.estimation.paper.paper_kernels import FLOAT, MEMORY_LAYOUT, REST_LAYOUT, step

MOTION_COLUMNS: Final = 19


@EntryPoint
def step_live(
    memory: int,
    gains: int,
    alpha_gyro: float,
    motion: int,
    fix_age_us: int,
    now_us: int,
    dt_s: float,
) -> None:
    """Do one `step`; records and an array by their addresses.

    `motion` has shape (MOTION_COLUMNS,): attitude, rate, place and velocity, which are written
    anew; then specific force, and the velocity of the last fix.
    """
    s, p = record_at(memory, MEMORY_LAYOUT), record_at(gains, REST_LAYOUT)
    m = array_at(motion, (MOTION_COLUMNS,), FLOAT)
    q_nb, gyro, place, vel = as_quat(m[:4]), as_vec(m[4:7]), as_vec(m[7:10]), as_vec(m[10:13])
    gyro, q_nb, place, vel = step(
        s, p, alpha_gyro, q_nb, as_vec(m[13:16]), gyro, place, vel, as_vec(m[16:19]), fix_age_us,
        now_us, dt_s,
    )  # fmt: skip
    write_quat(m[:4], q_nb)
    write_vec(m[4:7], gyro)
    write_vec(m[7:10], place)
    write_vec(m[10:13], vel)
