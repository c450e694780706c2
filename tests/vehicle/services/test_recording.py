"""LOGGING_START and LOGGING_STOP: no acknowledgement says more than is true."""

from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.requests import RecordingRequest
from gateway.vehicle.services.commands import MAX_WAITING, RECORDER_TIMEOUT_US
from tests.vehicle.ground_station import GroundStation

ACCEPTED, NOT_NOW, FAILED, IN_PROGRESS = 0, 1, 4, 5
START, STOP = mavlink.MAV_CMD_LOGGING_START, mavlink.MAV_CMD_LOGGING_STOP


def results(messages: list[Any]) -> list[tuple[int, int]]:
    return [(m.command, m.result) for m in messages if m.get_type() == "COMMAND_ACK"]


def texts(messages: list[Any]) -> list[str]:
    return [m.text for m in messages if m.get_type() == "STATUSTEXT"]


def recorder(station: GroundStation, trouble: str = "", *, recording: bool = False) -> list[Any]:
    now_us = station.clock.now_us
    return station.receive(station.vehicle.on_recorder(trouble, now_us, recording=recording))


def test_a_start_is_accepted_once_the_files_are_open(station: GroundStation) -> None:
    assert results(station.command(START)) == [(START, IN_PROGRESS)]
    assert station.of(RecordingRequest) == [RecordingRequest(start=True)]
    assert recorder(station) == []
    assert results(recorder(station, recording=True)) == [(START, ACCEPTED)]
    assert recorder(station, recording=True) == []
    assert results(station.wait(20.0)) == []


def test_a_start_that_fails_is_reported_and_why(station: GroundStation) -> None:
    station.command(START)
    found = recorder(station, "Read-only file system")
    assert results(found) == [(START, FAILED)]
    assert texts(found) == ["Cannot record: Read-only file system"]
    assert recorder(station, "Read-only file system") == []


def test_recorder_trouble_without_a_request_is_not_answered(station: GroundStation) -> None:
    assert recorder(station, "Read-only file system") == []


def test_a_disk_that_never_answers(station: GroundStation) -> None:
    station.command(START)
    assert results(station.wait(RECORDER_TIMEOUT_US / 1e6 - 0.001)) == []
    found = station.wait(0.002)
    assert results(found) == [(START, FAILED)]
    assert texts(found) == ["Cannot record: no answer from the disk"]


def test_a_start_while_it_records_is_accepted_and_holds(station: GroundStation) -> None:
    recorder(station, recording=True)
    assert results(station.command(START)) == [(START, ACCEPTED)]
    assert station.of(RecordingRequest) == [RecordingRequest(start=True)]


def test_a_start_asked_again_is_answered_once(station: GroundStation) -> None:
    for _ in range(3):
        assert results(station.command(START)) == [(START, IN_PROGRESS)]
    assert results(recorder(station, recording=True)) == [(START, ACCEPTED)]


def test_a_stop_is_accepted_and_ends_a_start(station: GroundStation) -> None:
    assert results(station.command(STOP)) == [(STOP, ACCEPTED)]
    station.command(START)
    assert results(station.command(STOP)) == [(STOP, ACCEPTED), (START, FAILED)]
    assert station.of(RecordingRequest)[-1] == RecordingRequest(start=False)
    assert recorder(station, recording=True) == []


def test_each_station_gets_its_own_answer(station: GroundStation) -> None:
    stations = [
        GroundStation(station.vehicle, station.clock, client_id=100 + n)
        for n in range(MAX_WAITING + 1)
    ]
    found = [results(each.command(START)) for each in stations]
    assert found == [[(START, IN_PROGRESS)]] * MAX_WAITING + [[(START, NOT_NOW)]]
    station.vehicle.remove_client(100)
    actions = station.vehicle.on_recorder("", station.clock.now_us, recording=True)
    assert [results(each.receive(actions)) for each in stations[:3]] == [
        [],
        [(START, ACCEPTED)],
        [(START, ACCEPTED)],
    ]
