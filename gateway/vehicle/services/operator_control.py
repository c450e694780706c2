"""Operator control: with "exclusive" one ground station at a time changes things.

| request | while                                  | answer                    |
| ------- | -------------------------------------- | ------------------------- |
| control | open                                   | accepted, nothing changes |
| control | no other station is in control         | accepted                  |
| control | another is, and allows a takeover      | accepted                  |
| control | another is, and does not               | failed; it is notified    |
| release | the sender is in control, or open      | accepted                  |
| release | another is, or no station              | denied                    |
| any     | the sender is not trusted              | denied                    |

The station in control is identified by its client and its MAVLink system id, so that frames of
others with the same id neither keep control nor use it; the same station may request it again by
another link. It loses control when its link closes, or after `TIMEOUT_US` without a frame from it.
CONTROL_STATUS reports the station in control; it is sent with "exclusive" only, since a ground
station that has received one expects to need control. This is the protocol's single-owner mode:
there are no secondary stations.

The command has two orders of parameters. Definitions before 2026-04-15 begin with a system id, 0
from a ground station; those since then with the action:

| order   | 1           | 2        | 3          | 4                        | 5          |
| ------- | ----------- | -------- | ---------- | ------------------------ | ---------- |
| present | action      | takeover | timeout, s | sender, or first of some | their last |
| former  | sender or 0 | action   | takeover   | timeout, s               |            |

QGroundControl sends the former order from 2025 to May 2026 and the present one since then, as does
the module of MAVProxy. CONTROL_STATUS changed with the command, its checksum seed included: a
program of the former definition discards the present message.

References
----------
.. [1] MAV_CMD_REQUEST_OPERATOR_CONTROL and CONTROL_STATUS in MAVLink's development.xml
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle.encoding import MessagePacker
from gateway.vehicle.requested_messages import whole
from gateway.vehicle.service import Answer, Reply, Request, Service
from gateway.vehicle.services.commands import ACCEPTED, DENIED, FAILED, Command, Explain, Outcome
from gateway.wire import mavlink_messages
from gateway.wire.system_ids import RELEASE_CONTROL, REQUEST_OPERATOR_CONTROL, is_former_control

CONTROL_STATUS: Final = MessagePacker(mavlink_messages.CONTROL_STATUS)
SYSTEM_MANAGER: Final = 1
TAKEOVER_ALLOWED: Final = 2
"""Values of GCS_CONTROL_STATUS_FLAGS."""
INTERVAL_US: Final = US_PER_S
TIMEOUT_US: Final = 30 * US_PER_S


class _Wanted(NamedTuple):
    """A request for control, or its release, of either order of parameters."""

    action: int
    takeover: int
    timeout_s: float
    systems: range
    """System ids that may send it; empty for any."""
    is_former: bool


def read_wanted(params: tuple[float, ...], sender: int) -> _Wanted:
    """Read the command; if both orders are possible, the present one is assumed."""
    first, second, third, fourth, fifth = map(whole, params[:5])
    if is_former_control(params, sender):
        systems = range(first, first + 1) if first else range(0)
        return _Wanted(second, third, params[3], systems, is_former=True)
    systems = range(fourth, max(fourth, fifth) + 1) if fourth else range(0)
    return _Wanted(first, second, params[2], systems, is_former=False)


@dataclass(slots=True)
class _Operator:
    request: Request
    """Its newest request for control."""
    received_us: int
    """When its newest message was received."""
    wanted: _Wanted


class OperatorControl(Service):
    """The ground station in control of one vehicle; if exclusive, only it may change things."""

    def __init__(self, explain: Explain, *, exclusive: bool) -> None:
        self.exclusive = exclusive
        self._explain = explain
        self._operator: _Operator | None = None
        self._due_us = 0

    def permits(self, request: Request) -> bool:
        """Return whether the sender may change things now."""
        return not self.exclusive or self._is_operator(request)

    def denial(self, request: Request) -> str:
        """Return the reason why another station may not change things."""
        if self._operator is None:
            return "no station is in control; request it first"
        system_id = self._operator.request.system_id
        if system_id == request.system_id:
            return f"system {system_id} is in control by another link; request it again"
        return f"system {system_id} is in control"

    def on_request(self, request: Request, now_us: int) -> None:
        """Note that a station is alive."""
        if self._operator is not None and self._is_operator(request) and request.may_change:
            self._operator.received_us = now_us

    def command(self, command: Command, now_us: int) -> Outcome:
        """Carry out MAV_CMD_REQUEST_OPERATOR_CONTROL."""
        request, sender = command.request, command.request.system_id
        wanted, reason = read_wanted(command.params, sender), request.reason
        is_release = wanted.action == RELEASE_CONTROL
        if wanted.systems and sender not in wanted.systems and not is_release:
            reason = reason or "requested for another system"
        if reason:
            text = f"Refused control to system {sender}: {reason}"
            return DENIED, self._explain(text, now_us)
        if not self.exclusive:
            return ACCEPTED, []
        if is_release:
            if not self._is_operator(request):
                return DENIED, []
            return ACCEPTED, self._change(None, f"System {sender} released control", now_us)
        operator = self._operator
        is_own = operator is not None and operator.request.system_id == sender
        if operator is None or is_own or operator.wanted.takeover == 1:
            text = "" if is_own else f"System {sender} is in control"
            return ACCEPTED, self._change(_Operator(request, now_us, wanted), text, now_us)
        text = f"System {sender} requests control; {self.denial(request)}"
        return FAILED, [*self._explain(text, now_us), _notice(operator, wanted, sender)]

    def poll(self, now_us: int) -> list[Answer]:
        """Send CONTROL_STATUS, and release the control of a station that timed out."""
        if not self.exclusive or now_us < self._due_us:
            return []
        operator, text = self._operator, ""
        if operator is not None and now_us - operator.received_us > TIMEOUT_US:
            text = f"System {operator.request.system_id} lost control: timeout"
            operator = None
        return self._change(operator, text, now_us)

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self.exclusive else None

    def remove_client(self, client_id: int) -> None:
        """Release the control of a station whose link has closed."""
        if self._operator is not None and self._operator.request.client_id == client_id:
            self._operator = None
            self._due_us = 0

    def _is_operator(self, request: Request) -> bool:
        if self._operator is None:
            return False
        operator = self._operator.request
        return (operator.client_id, operator.system_id) == (request.client_id, request.system_id)

    def _change(self, operator: _Operator | None, text: str, now_us: int) -> list[Answer]:
        """Set the station in control, and send CONTROL_STATUS."""
        self._operator = operator
        self._due_us = now_us + INTERVAL_US
        is_free = operator is None or operator.wanted.takeover == 1
        flags = SYSTEM_MANAGER | (TAKEOVER_ALLOWED if is_free else 0)
        in_control = 0 if operator is None else operator.request.system_id
        explained = self._explain(text, now_us) if text else []
        return [Reply(CONTROL_STATUS(flags, in_control, *[0] * 10)), *explained]


def _notice(operator: _Operator, wanted: _Wanted, sender: int) -> Reply:
    """Notify the station in control of another's request, in the order that it uses."""
    asked = (wanted.action, wanted.takeover, wanted.timeout_s)
    params = (sender, *asked) if operator.wanted.is_former else (*asked, sender)
    request, nothing = operator.request, (0.0, 0.0, 0.0)
    return request.reply(
        mavlink.MAVLink_command_long_message(
            request.system_id,
            request.component_id,
            REQUEST_OPERATOR_CONTROL,
            0,
            *params,
            *nothing,
        )
    )
