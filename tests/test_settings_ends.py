"""Every number that may be set, at both ends of its range, next to them, and near zero."""

import math
import sys
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from gateway.aircraft import Aircraft, AircraftSettings, Outputs
from gateway.config import GatewaySettings
from gateway.estimation.select import EstimationSettings
from gateway.records import BaroRaw, ImuFlags, RawRecord
from gateway.sensing.calibrating import IN_BODY_AXES
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Field, Settings, fields_of
from gateway.vehicle.service import CalibrationMeasured, SettingsChange
from tests.kit.ground_station import decode
from tests.kit.records import IMU_NODE, fix_at, raw_at

ESTIMATORS = ("paper", "eskf")
ATTITUDE = 30
DENORMAL = sys.float_info.min / 4.0
SMALL = (0.0, 5e-324, DENORMAL, sys.float_info.min, 1e-300, 1e-15, 1e-9, 1e-6)


def numbers(kind: type[Settings], path: tuple[str, ...] = ()) -> Iterator[tuple[str, Field]]:
    """List every setting that is a number or made of numbers."""
    for field in fields_of(kind):
        inner = (*path, field.name)
        if field.section is not None:
            yield from numbers(field.section, inner)
        elif not field.choices and is_number(field.default):
            yield ".".join(inner), field


def is_number(value: Any) -> bool:
    while isinstance(value, tuple) and value:
        value = value[0]
    return isinstance(value, int | float) and not isinstance(value, bool)


def ends(field: Field) -> list[float]:
    """Both ends of a range, their neighbours inside it, and what is next to nothing."""
    low, high = (float(bound) for bound in field.bounds if bound is not None)
    if isinstance(field.default, int):
        return [int(low), int(low) + 1, int(high) - 1, int(high)]
    found = [low, math.nextafter(low, high), math.nextafter(high, low), high]
    found += [sign * x for x in SMALL for sign in (1.0, -1.0) if low <= sign * x <= high]
    return list(dict.fromkeys(found))


def is_matrix(field: Field) -> bool:
    return isinstance(field.default, tuple) and isinstance(field.default[0], tuple)


EVERY_NUMBER = [*numbers(GatewaySettings), *numbers(AircraftSettings)]
FUSION = [
    (path, field)
    for path, field in numbers(AircraftSettings)
    if not path.startswith("vehicle.") and not is_matrix(field)
]


def concerns(path: str, estimator: str) -> bool:
    """Return whether an estimator reads a setting."""
    owner = path.split(".")[1]
    return owner not in ESTIMATORS or owner == estimator


def replaced(tree: Any, path: str, value: Any) -> Any:
    key, _, rest = path.partition(".")
    inner = replaced(getattr(tree, key), rest, value) if rest else value
    return msgspec.structs.replace(tree, **{key: inner})


def with_value(tree: AircraftSettings, path: str, field: Field, value: float) -> AircraftSettings:
    whole = (value, -value, value) if isinstance(field.default, tuple) else value
    return replaced(tree, path, msgspec.convert(whole, field.type))


def with_estimator(name: str) -> AircraftSettings:
    return replaced(AircraftSettings(), "estimation.estimator", name)


def readings(begin_us: int, count: int = 60) -> Iterator[RawRecord]:
    """Some time at rest, then turns and bumps, with a pause and fixes of the GPS."""
    for n in range(count):
        moving = 3 * n > count
        time_us = begin_us + 33_333 * n + 700_000 * (4 * n > 3 * count)
        yield raw_at(
            time_us,
            accel_raw=(700 * moving * (n % 3), -300 * moving, 4096 + 90 * (n % 5)),
            gyro_raw=(3000 * moving, -2000 * moving * (n % 2), 90 * moving),
            mag_raw=(218 + 20 * (n % 3), -4096 if n % 30 == 7 else 15, -436),
            temperature_raw=0,
            accel_range_g=8,
            gyro_range_dps=1000,
            mag_lsb_per_gauss=1090,
            flags=ImuFlags.MAG_NEW if n % 2 else ImuFlags(0),
        )
        if n % 4 == 0:
            yield BaroRaw(time_us, IMU_NODE, time_us, 100_000.0 - 30.0 * n, 20.0)
        if n % 7 == 5:
            flown = {"lat_dege7": 470_000_000 + 900 * n, "vel_n_mps": (0.3 * n, 1.0, -0.5)}
            yield fix_at(time_us, lon_dege7=80_000_000, alt_amsl_m=500.0 + n, **flown)


def fly(aircraft: Aircraft, begin_us: int = 1_000_000, count: int = 60) -> list[Any]:
    """Take in readings; give the ATTITUDEs that come of them."""
    out = Outputs()
    for record in readings(begin_us, count):
        aircraft.feed(record, record.time_us, out)
        aircraft.perform(aircraft.vehicle.poll(record.time_us), record.time_us, out)
    return decode(sent for sent in out.frames if sent.message_id == ATTITUDE)


def all_known(found: list[Any]) -> bool:
    return bool(found) and all(math.isfinite(m.roll + m.pitch) for m in found)


def test_every_number_has_lower_and_upper_bound() -> None:
    assert [path for path, field in EVERY_NUMBER if None in field.bounds] == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_settings_reject_nan_and_infinity(value: float) -> None:
    for path, field in EVERY_NUMBER:
        plain = msgspec.to_builtins(field.default)
        wrong: Any = value
        if isinstance(plain, list | tuple):
            wrong = [value if isinstance(item, float) else [value] * 3 for item in plain]
        with pytest.raises(msgspec.ValidationError):
            pytest.fail(f"{path} takes {msgspec.convert(wrong, field.type)}")


@pytest.mark.parametrize("name", ESTIMATORS)
def test_each_bound_of_each_number_gives_finite_attitudes(name: str) -> None:
    plain = with_estimator(name)
    for path, field in FUSION:
        if not concerns(path, name):
            continue
        aircraft = Aircraft(1, plain)
        fly(aircraft)
        for n, value in enumerate(ends(field), 1):
            section = path.partition(".")[0]
            wanted = getattr(with_value(plain, path, field, value), section)
            aircraft.perform([SettingsChange(section, wanted)], 0, Outputs())
            assert all_known(fly(aircraft, 1_000_000 + 5_000_000 * n, 14)), (path, value)


# Without shrinking, which takes minutes; the failing draws are reported all the same.
@settings(deadline=None, derandomize=True, max_examples=40, phases=[Phase.generate])
@given(st.data())
def test_combined_bounds_give_attitudes(data: st.DataObject) -> None:
    wanted = with_estimator(data.draw(st.sampled_from(ESTIMATORS)))
    for path, field in FUSION:
        if data.draw(st.booleans()):
            wanted = with_value(wanted, path, field, data.draw(st.sampled_from(ends(field))))
    assert fly(Aircraft(1, wanted))


@pytest.mark.parametrize("before", ESTIMATORS)
@pytest.mark.parametrize("after", ESTIMATORS)
def test_estimator_can_be_changed_in_flight(before: str, after: str) -> None:
    aircraft = Aircraft(1, with_estimator(before))
    fly(aircraft)
    wanted = with_estimator(after).estimation
    aircraft.perform([SettingsChange("estimation", wanted)], 0, Outputs())
    assert aircraft.settings.estimation == wanted
    assert all_known(fly(aircraft, 6_000_000)[5:])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_changed_gps_latency_keeps_attitude_and_a_failed_change_keeps_settings(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    aircraft = Aircraft(1, with_estimator(name))
    before = fly(aircraft)[-1]
    wanted = replaced(with_estimator(name), "estimation.reference.gps_latency_s", 0.3).estimation
    aircraft.perform([SettingsChange("estimation", wanted)], 0, Outputs())
    after = fly(aircraft, 3_700_000, 2)[0]
    assert (after.roll, after.pitch) == pytest.approx((before.roll, before.pitch), abs=0.2)
    monkeypatch.setattr("gateway.aircraft.make_estimator", Mock(side_effect=ArithmeticError))
    with pytest.raises(ArithmeticError):
        aircraft.perform([SettingsChange("estimation", EstimationSettings())], 0, Outputs())
    assert aircraft.settings.estimation == wanted


def test_invalid_calibration_is_rejected() -> None:
    for key, value, words in (
        ("mounting", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)), "must be a rotation"),
        ("mag_mounting", ((0.0,) * 3,) * 3, "must be a rotation"),
        ("accel_matrix", ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "an inverse"),
        ("mag_soft_iron", ((1.0, 0.0, 0.0),) * 3, "an inverse"),
        ("accel_bias_mps2", (0.0, 51.0, 0.0), "<= 50"),
        ("gyro_bias_radps", (0.0, 0.0, -1e300), ">= -10"),
    ):
        with pytest.raises(msgspec.ValidationError, match=words):
            msgspec.convert({key: value}, NodeCalibration)


def test_calibration_beyond_bounds_is_refused_and_not_used() -> None:
    aircraft = Aircraft(1, AircraftSettings())
    fly(aircraft)
    correction = msgspec.structs.replace(IN_BODY_AXES, mag_hard_iron_ut=(5000.0, 0.0, 0.0))
    out = Outputs()
    aircraft.perform([CalibrationMeasured(correction)], 0, out)
    assert b"Calibration refused" in out.frames[0].frame
    assert not out.records
    assert aircraft.settings.calibration == NodeCalibration()
