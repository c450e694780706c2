"""Random records of every kind, seeded."""

from collections.abc import Iterable

import numpy as np

from gateway.recordings.rows import RowBuilder, TableRow
from gateway.records import (
    NAN,
    BaroRaw,
    FusedSample,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    ImuRaw,
    ImuSample,
    NavFlags,
    NavState,
    NodeId,
    Vec3,
)

Recorded = BaroRaw | GpsFix | FusedSample


def number(rng: np.random.Generator) -> float:
    """Any float: the awkward ones too."""
    return float(
        rng.choice([rng.normal(), rng.normal() * 1e-300, rng.normal() * 1e9, 0.1, 0.0, NAN])
    )


def vector(rng: np.random.Generator) -> Vec3:
    return (float(rng.normal()), number(rng), number(rng))


def counts(rng: np.random.Generator) -> tuple[int, int, int]:
    x, y, z = rng.integers(-32768, 32768, 3).tolist()
    return (x, y, z)


def make_baro(rng: np.random.Generator, time_us: int) -> BaroRaw:
    return BaroRaw(time_us, NodeId(3, 0), time_us + 5, number(rng), number(rng))


def make_fix(rng: np.random.Generator, time_us: int) -> GpsFix:
    return GpsFix(
        time_us=time_us,
        node=NodeId(3, 1),
        node_time_us=time_us + 7,
        itow_ms=int(rng.integers(1 << 30)),
        fix_type=GpsFixType(int(rng.integers(6))),
        fix_ok=bool(rng.integers(2)),
        satellites=int(rng.integers(30)),
        lat_dege7=int(rng.integers(-900_000_000, 900_000_000)),
        lon_dege7=int(rng.integers(-1_800_000_000, 1_800_000_000)),
        alt_amsl_m=number(rng),
        vel_n_mps=vector(rng),
        alt_ellipsoid_m=number(rng),
        h_acc_m=number(rng),
        v_acc_m=number(rng),
        speed_acc_mps=number(rng),
        course_acc_deg=number(rng),
        pdop=number(rng),
        utc_us=None if rng.integers(2) else int(rng.integers(1 << 50)),
    )


def make_fused(rng: np.random.Generator, time_us: int) -> FusedSample:
    flags = ImuFlags(int(rng.integers(256)))
    raw = ImuRaw(
        time_us=time_us,
        node=NodeId(3, 0),
        node_time_us=time_us + 11,
        accel_raw=counts(rng),
        gyro_raw=counts(rng),
        mag_raw=counts(rng),
        temperature_raw=int(rng.integers(-32768, 32768)),
        accel_range_g=8,
        gyro_range_dps=500,
        mag_lsb_per_gauss=1090,
        flags=flags,
    )
    accel, gyro = vector(rng), vector(rng)
    mag = vector(rng) if rng.integers(2) else None
    sample = ImuSample(time_us, accel, gyro, mag, number(rng), flags)
    state = NavState(
        time_us=time_us - 1,
        q_nb=(*vector(rng), number(rng)),
        rate_b_radps=vector(rng),
        lat_deg=number(rng),
        lon_deg=number(rng),
        alt_amsl_m=number(rng),
        vel_n_mps=vector(rng),
        attitude_std_rad=vector(rng),
        vel_std_mps=vector(rng),
        pos_std_m=vector(rng),
        flags=NavFlags(int(rng.integers(1 << 14))),
    )
    return FusedSample(3, raw, sample, state)


def make_flight(rng: np.random.Generator, count: int) -> list[Recorded]:
    """Make records of all kinds in a random order."""
    makers = (make_fused, make_fused, make_baro, make_fix)
    return [makers[int(rng.integers(4))](rng, 10_000 * i) for i in range(count)]


def rows_of(records: Iterable[Recorded | ImuCalibrated]) -> list[TableRow]:
    builder = RowBuilder()
    rows = [row for record in records for row in builder.add(record)]
    return rows + builder.flush()


def make_rows(seed: int, count: int = 20) -> list[TableRow]:
    return rows_of(make_flight(np.random.default_rng(seed), count))
