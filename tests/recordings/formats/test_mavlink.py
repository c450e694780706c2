"""An autopilot's messages become records in SI, on one clock."""

import math
import random
from typing import Any, TypeVar

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.geometry.quaternion import to_euler
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.rows import Imported, TableRow, row_of_cells
from gateway.recordings.tlog import TlogScanner
from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuCalibrated, ImuFlags, NavFlags, NavState
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import packed
from tests.kit.recordings import START_US, make_tlog, records_sent, senders_of

G = 9.80665
Message = Any
Kind = TypeVar("Kind", bound=Imported)


def highres(time_us: int, updated: int = 0b111111111) -> Message:
    return mavlink.MAVLink_highres_imu_message(
        time_us, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.2, 0.05, -0.4, 950, 0, 400, 21.5, updated
    )


def raw(time_us: int) -> Message:
    return mavlink.MAVLink_raw_imu_message(time_us, 10, 20, -1000, 10, 20, 30, 200, 50, -400)


def gps(time_us: int, alt_mm: int = 430_000, fix: int = 3) -> Message:
    return mavlink.MAVLink_gps_raw_int_message(
        time_us, fix, 471_000_000, 85_000_000, alt_mm, 120, 65535, 1500, 9000, 11
    )


def position(time_ms: int, vz_cmps: int) -> Message:
    return mavlink.MAVLink_global_position_int_message(
        time_ms, 471_000_000, 85_000_000, 430_000, 0, 0, 1500, vz_cmps, 9000
    )


def rows_of(
    reader: AutopilotReader, records: list[RecordedFrame], chunk: int = 1 << 20
) -> list[TableRow]:
    """Read a recording in chunks of so many bytes."""
    scanner, data = TlogScanner(strict=True), make_tlog(records)
    cells = [
        reader.feed(scanner.feed(data[begin : begin + chunk], final=begin >= len(data)))
        for begin in range(0, len(data) + chunk, chunk)
    ]
    cells.append(reader.flush())
    vehicle_id = reader.system_id or 1
    return [row_of_cells(row, vehicle_id) for rows in cells for row in rows.tolist()]


def read(messages: list[tuple[int, Message]], component_id: int = 1) -> list[Imported]:
    """Return what is read, in the order of the rows."""
    records = [RecordedFrame(START_US + at_us, packed(m, 1, component_id)) for at_us, m in messages]
    rows = rows_of(AutopilotReader(), records)
    held = [record for row in rows for record in (row.baro, row.gps, row.state, row.imu)]
    return [record for record in held if record is not None]


def of_kind(kind: type[Kind], messages: list[tuple[int, Message]]) -> list[Kind]:
    return [record for record in read(messages) if isinstance(record, kind)]


def fixes_of(messages: list[tuple[int, Message]]) -> list[GpsFix]:
    return of_kind(GpsFix, [(0, raw(0)), *messages])


def test_highres_imu_is_read_in_si_units() -> None:
    (imu,) = of_kind(ImuCalibrated, [(0, highres(5_000_000))])
    assert imu.time_us == 0
    assert imu.accel_b_mps2 == pytest.approx((0.1, 0.2, -9.8))
    assert imu.gyro_b_radps == pytest.approx((0.01, 0.02, 0.03))
    assert imu.mag_b_ut == pytest.approx((20.0, 5.0, -40.0))
    assert imu.temperature_degc == pytest.approx(21.5)
    assert imu.flags is ImuFlags.MAG_NEW
    (imu,) = of_kind(ImuCalibrated, [(0, highres(0, updated=0b111111))])
    assert imu.mag_b_ut is None, "no new sample"


def test_raw_and_scaled_imu_are_read_in_thousandths() -> None:
    scaled = mavlink.MAVLink_scaled_imu_message(20, 10, 20, -1000, 10, 20, 30, 200, 50, -400)
    for message in (raw(20_000), scaled):
        (imu,) = of_kind(ImuCalibrated, [(0, message)])
        assert imu.accel_b_mps2 == pytest.approx((0.01 * G, 0.02 * G, -G))
        assert imu.gyro_b_radps == pytest.approx((0.01, 0.02, 0.03))
        assert imu.mag_b_ut == pytest.approx((20.0, 5.0, -40.0))
        assert math.isnan(imu.temperature_degc)


def test_imu_message_of_highest_resolution_is_used() -> None:
    records = read([(0, raw(1000)), (10_000, highres(11_000)), (20_000, raw(21_000))])
    assert [r.time_us for r in records] == [0, 10_000]


def test_pressure_is_converted_to_pascal() -> None:
    pressure = mavlink.MAVLink_scaled_pressure_message(15, 950.25, 0, 2150)
    (baro,) = of_kind(BaroRaw, [(0, raw(10_000)), (5_000, pressure)])
    assert (baro.time_us, baro.pressure_pa, baro.temperature_degc) == (5_000, 95_025.0, 21.5)


def test_velocity_of_a_fix_is_from_its_course_and_the_climb_of_the_position() -> None:
    climb = (100_000, position(100, vz_cmps=-500))
    first, second = fixes_of([(0, gps(1_000)), climb, (200_000, gps(201_000, 431_000))])
    assert (first.lat_dege7, first.lon_dege7) == (471_000_000, 85_000_000)
    assert first.fix_type is GpsFixType.FIX_3D
    assert first.pdop == pytest.approx(1.2)
    assert math.isnan(first.vel_n_mps[2])
    assert second.vel_n_mps == pytest.approx((0.0, 15.0, -5.0))
    assert math.isnan(second.h_acc_m)
    assert second.utc_us is None


def test_other_systems_and_components_are_ignored() -> None:
    assert read([(0, raw(0))], component_id=191) == []
    assert rows_of(AutopilotReader(system_id=2), records_sent([((1, 1), raw(0))])) == []


def test_clock_never_decreases_for_any_message_times() -> None:
    times = [5_000_000, 5_010_000, 4_000_000, 100, 5_030_000, 9_000_000_000]
    records = read([(i * 10_000, raw(t)) for i, t in enumerate(times)])
    stamps = [r.time_us for r in records]
    assert stamps == sorted(stamps)
    assert stamps[-1] <= 60_000


@pytest.mark.parametrize("lead_us", [300_000, 900_000, 1_500_000, -300_000])
def test_fixes_of_another_clock_do_not_change_imu_intervals(lead_us: int) -> None:
    messages: list[tuple[int, Message]] = []
    for at_us in range(0, 4_000_000, 20_000):
        messages.append((at_us, raw(2_000_000 + at_us)))
        if at_us % 200_000 == 100_000:
            messages.append((at_us + 5_000, gps(2_000_000 + at_us + lead_us)))
            messages.append((at_us + 6_000, attitude((2_000_000 + at_us) // 1000 + 8)))
    records = read(messages)
    samples = [r.time_us for r in records if isinstance(r, ImuCalibrated)]
    assert samples == [*range(0, 4_000_000, 20_000)]
    # A fix whose stamp cannot be of the IMU's clock came when it was recorded.
    late_us = lead_us if 0 <= lead_us <= 1_000_000 else 5_000
    fixes = [r.time_us for r in records if isinstance(r, GpsFix)]
    assert fixes == [*range(100_000 + late_us, 4_000_000 + late_us, 200_000)]
    states = [r.time_us for r in records if isinstance(r, NavState)]
    assert states == [*range(108_000, 4_000_000, 200_000)]


def test_fix_without_a_time_follows_the_imu_despite_clock_drift() -> None:
    """The recording's clock is slower by a percent; a fix comes 4 ms after each tenth sample."""
    messages: list[tuple[int, Message]] = []
    for at_us in range(0, 4_000_000, 20_000):
        messages.append((at_us * 99 // 100, raw(2_000_000 + at_us)))
        if at_us % 200_000 == 0:
            messages.append((at_us * 99 // 100 + 4_000, gps(0)))
    fixes = [fix.time_us for fix in of_kind(GpsFix, messages)]
    assert fixes == [*range(4_000, 4_000_000, 200_000)]


@pytest.mark.parametrize(
    ("age_us", "fix_type", "is_known"), [(500_000, 3, True), (500_001, 3, False), (1, 2, False)]
)
def test_climb_rate_is_known_while_it_is_new_and_the_fix_has_a_height(
    age_us: int, fix_type: int, is_known: bool
) -> None:
    (fix,) = fixes_of([(0, position(0, -150)), (age_us, gps(age_us, fix=fix_type))])
    assert math.isfinite(fix.vel_n_mps[2]) == is_known


def test_climb_rate_is_unknown_after_a_lost_fix() -> None:
    """Without a fix the height may be zero: found again, 484 m would be a climb of 968 m/s."""
    heights = [(484_000, 3), (0, 1), (484_000, 3), (484_500, 3)]
    flight = [(n * 500_000, gps(n * 500_000 + 1, *height)) for n, height in enumerate(heights)]
    assert [math.isfinite(fix.vel_n_mps[2]) for fix in fixes_of(flight)] == [False] * 4
    lost = fixes_of(flight)[1]
    assert not lost.fix_ok
    assert not any(map(math.isfinite, lost.vel_n_mps))
    positions = [(at_us, position(at_us // 1000, 20)) for at_us, _ in flight]
    both = [message for pair in zip(positions, flight, strict=True) for message in pair]
    downs = [fix.vel_n_mps[2] for fix in fixes_of(both)]
    assert downs == pytest.approx([0.2, math.nan, 0.2, 0.2], nan_ok=True)


def attitude(time_ms: int) -> Message:
    return mavlink.MAVLink_attitude_message(time_ms, 0.1, -0.2, 1.5, 0.01, 0.02, 0.03)


def test_states_of_the_autopilot_are_read() -> None:
    own = [(0, raw(0)), (0, position(0, -150)), (10_000, attitude(10)), (20_000, raw(20_000))]
    later = [(590_000, attitude(590)), (600_000, attitude(600)), (600_000, raw(600_000))]
    records = read([*own, *later])
    fresh, stale = (record for record in records if isinstance(record, NavState))
    assert to_euler(fresh.q_nb) == pytest.approx((0.1, -0.2, 1.5))
    assert fresh.rate_b_radps == pytest.approx((0.01, 0.02, 0.03))
    assert (fresh.lat_deg, fresh.alt_amsl_m) == pytest.approx((47.1, 430.0))
    assert fresh.vel_n_mps == pytest.approx((0.0, 15.0, -1.5))
    assert NavFlags.POSITION_VALID in fresh.flags
    assert math.isnan(stale.lat_deg)
    assert NavFlags.POSITION_VALID not in stale.flags
    kinds = [type(record) for record in records]
    assert kinds == [ImuCalibrated, NavState, ImuCalibrated, NavState, ImuCalibrated]
    assert stale.time_us == 600_000, "of two the newer"


def recorded(seed: int) -> list[RecordedFrame]:
    """Make messages of two autopilots and a station in any order, with decreasing times too."""
    chance, records, at_us = random.Random(seed), [], 0
    senders = ((1, 1), (1, 1), (1, 1), (2, 1), (1, 5))
    for _ in range(600):
        at_us += chance.choice((0, 4, 1000, 20_000, -30_000, 700_000))
        own_ms = max(0, at_us) // 1000
        message = chance.choice(
            (
                highres(own_ms * 1000, chance.choice((0, 0x1FF))),
                highres(own_ms * 1000),
                raw(own_ms * 1000),
                gps(own_ms * 1000, fix=chance.randint(0, 4)),
                position(own_ms, chance.randint(-500, 500)),
                mavlink.MAVLink_attitude_message(own_ms, chance.random(), 0.1, 0.2, 0.3, 0.4, 0.5),
                mavlink.MAVLink_scaled_pressure_message(own_ms, 950.0, 0.5, 2100),
                mavlink.MAVLink_heartbeat_message(1, 12, 0, 0, 4, 3),
            )
        )
        version = chance.choice((1, 2, 2, 2, 2))
        frame = packed(message, *chance.choice(senders), version=version)
        records.append(RecordedFrame(START_US + at_us, frame))
    return records


@pytest.mark.parametrize("seed", range(8))
def test_rows_do_not_depend_on_the_size_of_the_batches(seed: int) -> None:
    records = recorded(seed)
    whole = AutopilotReader()
    expected = [repr(row) for row in rows_of(whole, records)]
    assert len(expected) > 20
    for size in (60, 300, 5000):
        reader = AutopilotReader()
        assert [repr(row) for row in rows_of(reader, records, size)] == expected
        assert reader.system_id == whole.system_id
        assert reader.unix_us_at_zero == whole.unix_us_at_zero


def test_samples_are_those_of_the_autopilots_component() -> None:
    sent = [
        ((1, 3), mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)),
        ((1, 3), mavlink.MAVLink_scaled_imu_message(100, 0, 0, -1000, 0, 0, 0, 0, 0, 0)),
        ((1, 1), mavlink.MAVLink_scaled_imu_message(200, 0, 0, -500, 0, 0, 0, 0, 0, 0)),
    ]
    records = records_sent(sent, 100_000)
    (row,) = rows_of(AutopilotReader(1, senders_of(make_tlog(records))), records)
    assert row.imu is not None
    assert row.imu.accel_b_mps2[2] == pytest.approx(-9.80665)


def test_position_before_the_fix_is_no_state_of_the_autopilot() -> None:
    sent = [
        mavlink.MAVLink_scaled_imu_message(100, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(150, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_message(160, 0.1, 0.2, 0.3, 0, 0, 0),
        mavlink.MAVLink_scaled_imu_message(200, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
    ]
    records = records_sent([((1, 1), message) for message in sent], 10_000)
    *_, row = rows_of(AutopilotReader(), records)
    assert row.state is not None
    assert NavFlags.POSITION_VALID not in row.state.flags
