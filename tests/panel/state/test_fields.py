import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.fields import LEAST_GAP_US, MAX_KINDS, SPAN_US, FieldHistory, fields_csv
from gateway.units import US_PER_S
from tests.kit.memory import size_of


def attitude(roll: float) -> mavlink.MAVLink_attitude_message:
    return mavlink.MAVLink_attitude_message(0, roll, 0.2, 0.3, 0.0, 0.0, 0.0)


def test_numeric_fields_are_stored_with_time_and_unit() -> None:
    history = FieldHistory()
    for n in range(3):
        history.add(attitude(0.1 * n), n * US_PER_S)
    time_us, values = history.series("ATTITUDE.roll")
    assert time_us.tolist() == [0, US_PER_S, 2 * US_PER_S]
    assert values.tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert history.unit("ATTITUDE.roll") == "rad"
    assert "rollspeed" in history.fields()["ATTITUDE"]
    assert FieldHistory().series("ATTITUDE.roll")[0].tolist() == []
    assert history.series("ATTITUDE.nonsense")[0].tolist() == []


def test_array_elements_and_instances_are_separate_fields() -> None:
    history = FieldHistory()
    for instance, volt in ((0, 4000), (1, 3000)):
        cells = [volt, volt + 5, *[65535] * 8]
        message = mavlink.MAVLink_battery_status_message(
            instance, 0, 0, 0, cells, 100, 0, 0, 50, 0, 0, [0] * 4, 0, 0
        )
        history.add(message, 5)
    assert history.series("BATTERY_STATUS[1].voltages[0]")[1].tolist() == [3000.0]
    assert history.series("BATTERY_STATUS[1].voltages[1]")[1].tolist() == [3005.0]
    assert history.unit("BATTERY_STATUS[0].voltages[0]") == "mV"


def test_number_of_messages_of_an_aircraft_is_bounded() -> None:
    history = FieldHistory()
    for instance in range(MAX_KINDS + 9):
        fields = (instance, *[0] * 3, [0] * 10, *[0] * 4)
        history.add(mavlink.MAVLink_battery_status_message(*fields), 0)
    assert len(history.fields()) == MAX_KINDS


def test_texts_and_file_transfers_are_not_stored() -> None:
    history = FieldHistory()
    history.add(mavlink.MAVLink_statustext_message(6, b"hello"), 0)
    history.add(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [7] * 251), 0)
    assert history.fields()["STATUSTEXT"] == ("chunk_seq", "id", "severity")
    assert not any("payload" in name for name in history.fields()["FILE_TRANSFER_PROTOCOL"])


def test_history_is_bounded_to_the_newest_minutes() -> None:
    """Seven minutes at 100 Hz leave the last five at 50."""
    history = FieldHistory()
    for n in range(42_000):
        history.add(attitude(float(n)), n * 10_000)
    time_us, values = history.series("ATTITUDE.roll")
    assert len(time_us) <= SPAN_US // LEAST_GAP_US
    assert time_us[-1] - time_us[0] == pytest.approx(SPAN_US, rel=0.01)
    assert values[-1] == pytest.approx(41_999, abs=2)
    assert np.all(np.diff(time_us) > 0)


def test_series_is_limited_to_a_requested_span() -> None:
    history = FieldHistory()
    for n in range(1000):
        history.add(attitude(float(n)), n * 20_000)
    time_us, values = history.series("ATTITUDE.roll", 500 * 20_000, 510 * 20_000)
    assert values.tolist() == [float(n) for n in range(501, 511)]
    assert len(time_us) == 10


def test_infrequent_message_is_stored_no_longer_than_the_span() -> None:
    history = FieldHistory()
    for second in range(3600):
        history.add(attitude(float(second)), second * US_PER_S)
    assert size_of(history) < 1000 * 8 * len(("time", *history.fields()["ATTITUDE"]))
    time_us, values = history.series("ATTITUDE.roll")
    assert np.array_equal(time_us, np.arange(3300, 3600) * US_PER_S)
    assert values.tolist() == list(range(3300, 3600))


def test_message_with_a_raised_rate_keeps_the_whole_span() -> None:
    history, now_us = FieldHistory(), 0
    for step in range(9000):
        now_us += US_PER_S if step < 1000 else US_PER_S // 25
        history.add(attitude(float(step)), now_us)
    time_us, values = history.series("ATTITUDE.roll")
    assert len(time_us) == 7500
    assert values.tolist() == list(range(1500, 9000))


def test_csv_of_fields_with_different_times_has_blank_cells() -> None:
    series = {
        "A.x": (np.array([0, 500_000]), np.array([1.0, np.nan])),
        "B.y": (np.array([250_000]), np.array([-0.125])),
    }
    assert fields_csv(series, {"A.x": "m/s"}, 1_700_000_000_000_000).splitlines() == [
        "time_unix_s,A.x (m/s),B.y",
        "1700000000.000000,1,",
        "1700000000.250000,,-0.125",
        "1700000000.500000,,",
    ]


def test_csv_without_fields_has_only_its_header() -> None:
    assert fields_csv({}, {}, 0) == "time_unix_s\n"
