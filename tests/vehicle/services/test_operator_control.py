"""Operator control: which station may change things, and how control passes on."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.request_reader import NOT_TRUSTED
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.conversation import Step, converse
from tests.kit.ground_station import GroundStation, command, to_vehicle

CONTROL = 32100
ACCEPTED, DENIED, FAILED, NOT_IN_CONTROL = ({"COMMAND_ACK": {"result": n}} for n in (0, 2, 4, 10))
RELEASE, REQUEST = 0, 1
BEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
RECORD = command(mavlink.MAV_CMD_LOGGING_START)
SET = to_vehicle("PARAM_SET", b"RATE_ATT", 7.0, 9)
CHANGED, UNCHANGED = {"PARAM_VALUE": {"param_value": 7.0}}, {"PARAM_ERROR": {}}
FORMER = (0.0, 1.0, 0.0, 10.0)
"""Request of a definition before 2026-04-15: sender or 0, action, takeover, timeout."""
SYSTEMS = {"A": 255, "B": 254, "C": 10}


def control(who: str, action: int = REQUEST, takeover: int = 0, *, allow: bool = False) -> Any:
    """Return the command as QGroundControl sends it."""
    return command(CONTROL, action, takeover or int(allow), 10, SYSTEMS[who])


def notice(*params: float) -> dict[str, Any]:
    fields = dict(zip(("param1", "param2", "param3", "param4"), params, strict=True))
    return {"COMMAND_LONG": {"command": CONTROL, "target_system": 255} | fields}


def status(flags: int, system: int) -> dict[str, Any]:
    return {"CONTROL_STATUS": {"payload": bytes((flags, system))}}


def lost(who: str) -> dict[str, Any]:
    return {"texts": [f"System {SYSTEMS[who]} lost control: timeout"]}


GRANTED: list[Step] = [("A", control("A"), ACCEPTED), ("A", SET, CHANGED)]
REFUSAL = "of system 254: system 255 is in control"
OTHER_LINK = "of system 255: system 255 is in control by another link; request it again"
CONVERSATIONS: dict[str, list[Step]] = {
    "a station without control is refused": [
        ("A", SET, UNCHANGED), *GRANTED,
        ("B", SET, UNCHANGED | {"texts": [f"Refused PARAM_SET {REFUSAL}"]}),
        ("B", RECORD, NOT_IN_CONTROL | {"texts": [f"Refused LOGGING_START {REFUSAL}"]}),
        # Reading stays free.
        ("B", command(512, 148), ACCEPTED | {"AUTOPILOT_VERSION": {}}),
    ],
    "a takeover needs the consent of the station in control": [
        *GRANTED, ("B", command(CONTROL, REQUEST, 1, 10, 254), FAILED),
        ("A", None, notice(1, 1, 10, 254)),
        ("A", control("A", allow=True), ACCEPTED | status(3, 255)),
        ("B", control("B"), ACCEPTED | status(1, 254)),
        ("B", SET, CHANGED), ("A", SET, UNCHANGED),
    ],
    "only the station in control may release it": [
        *GRANTED, ("B", control("B", RELEASE), DENIED), ("A", control("A", RELEASE), ACCEPTED),
        ("B", control("B"), ACCEPTED),
    ],
    "control ends with the link of the station": [
        *GRANTED, ("A", "leave", {}), ("B", control("B"), ACCEPTED),
    ],
    "control ends after a timeout": [
        *GRANTED, ("B", 33.0, lost("A")), ("B", control("B"), ACCEPTED),
    ],
    "heartbeats keep control": [
        *GRANTED, *[("A", BEAT, {}), ("A", 1.0, {})] * 60, ("B", control("B"), FAILED),
    ],
    "status is sent regularly and at every change": [
        ("A", 5.0, status(3, 0)), ("A", control("A"), status(1, 255)),
        ("A", control("A", allow=True), status(3, 255)),
        ("A", 20.0, {"CONTROL_STATUS": pytest.approx(20, abs=1)}),
    ],
    "an untrusted client cannot take control": [
        ("B untrusted", control("B"), DENIED | {"texts": [
            f"Refused control to system 254: {NOT_TRUSTED}",
        ]}),
    ],
    "a station cannot act for another": [("B", command(CONTROL, REQUEST, 0, 10, 255), DENIED)],
    # System 10 releases control; formerly this was a request with a timeout of 10 s.
    "an ambiguous request is read by the present definition": [
        ("C", control("C"), ACCEPTED), ("C", command(CONTROL, 0, 1, 0, 10), ACCEPTED),
        ("C", SET, UNCHANGED),
    ],
    **{
        f"the station in control is notified in its own order, {name}": [
            ("A", command(CONTROL, *asked), ACCEPTED),
            ("B", command(CONTROL, REQUEST, 1, 20, 254), FAILED), ("A", None, notice(*noted)),
            ("A", mavlink.MAVLink_command_ack_message(CONTROL, 0, 0, 0, 1, 1), {}),
        ]
        for name, asked, noted in (
            ("former", FORMER, (254, 1, 1, 20)), ("present", (1, 0, 10, 255), (1, 1, 20, 254)),
        )
    },
    **{
        f"heartbeats of another client{trust} with the same id do not keep control": [
            *GRANTED, *[(f"A2{trust}", BEAT, {}), (f"A2{trust}", 1.0, {})] * 30,
            ("B", 3.0, lost("A")),
        ]
        for trust in ("", " untrusted")
    },
    "a station uses control by the link that requested it last": [
        *GRANTED,
        ("A2", RECORD, NOT_IN_CONTROL | {"texts": [f"Refused LOGGING_START {OTHER_LINK}"]}),
        ("A2", control("A"), ACCEPTED), ("A2", SET, CHANGED), ("A", SET, UNCHANGED),
    ],
    **{
        f"request {params} is understood": [
            ("A", command(CONTROL, *params), ACCEPTED | status(flags, 255) if flags else DENIED),
            ("A", SET, CHANGED if flags else UNCHANGED),
        ]
        for params, flags in {
            (1, 0, 10, 255): 1, (1, 1, 10, 255): 3, (1, 1, 10, 0): 3, (1, 0, 10, 250, 255): 1,
            (1, 0, 10, 1, 250): 0, (1, 0, 10, 254): 0, FORMER: 1, (0, 1, 1, 60): 3,
            (255, 1, 1, 3): 3, (254, 1, 1, 3): 0,
        }.items()
    },
    **{
        f"release {params} is understood": [
            *GRANTED, ("A", command(CONTROL, *params), ACCEPTED), ("A", SET, UNCHANGED),
        ]
        for params in ((0, 0, 0, 255), (0, 0, 0, 0), (0, 1, 0, 255), (0, 1, 30, 255), (0, 0, 0, 10))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", CONVERSATIONS)
def test_control_is_exclusive(clock: ManualClock, name: str) -> None:
    vehicle = Vehicle(VehicleSettings(operator_control="exclusive"), 1)
    converse(vehicle, clock, CONVERSATIONS[name], SYSTEMS)
    assert "no answer" not in [entry.outcome for entry in vehicle.requests.entries]


def test_control_status_is_not_sent_while_control_is_open(station: GroundStation) -> None:
    station.wait(10.0)
    for action in (REQUEST, RELEASE):
        assert station.send(control("A", action))[0].result == 0
    assert 512 not in [frame.message_id for frame in station.frames]
