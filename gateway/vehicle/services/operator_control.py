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

from dataclasses import dataclass, replace
from typing import Any, Final

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


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A request for control, or its release, of either order of parameters."""

    action: int
    takeover: int
    timeout_s: float
    systems: range
    """System ids that may send it; empty for any."""
    is_former: bool

    def parameters(self, system_id: int) -> tuple[float, ...]:
        """Return the command's parameters that forward a system's request."""
        if self.is_former:
            return (system_id, self.action, self.takeover, self.timeout_s)
        return (self.action, self.takeover, self.timeout_s, system_id)


def read_wanted(params: tuple[float, ...], sender: int) -> _Wanted:
    """Read the command; if both orders are possible, the present one is assumed."""
    first, second, third, fourth, fifth = map(whole, params[:5])
    is_former = is_former_control(params, sender)
    if is_former:
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
    allows_takeover: bool
    uses_former: bool
    """Whether it requested control with the former order of parameters."""


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
        request = command.request
        wanted = read_wanted(command.params, request.system_id)
        is_release, reason = wanted.action == RELEASE_CONTROL, request.reason
        if wanted.systems and request.system_id not in wanted.systems and not is_release:
            reason = reason or "requested for another system"
        if reason:
            text = f"Refused control to system {request.system_id}: {reason}"
            return DENIED, self._explain(text, now_us)
        if is_release:
            return self._release(request, now_us)
        result, answers = self._request(
            request, now_us, allows_takeover=wanted.takeover == 1, uses_former=wanted.is_former
        )
        if result == FAILED:
            answers = [*answers, *self._notice(request, wanted)]
        return result, answers

    def _notice(self, request: Request, wanted: _Wanted) -> list[Answer]:
        """Notify the station in control of another's request, in the order that it uses."""
        if self._operator is None:
            return []
        operator = self._operator.request
        notice = mavlink.MAVLink_command_long_message(
            operator.system_id,
            operator.component_id,
            REQUEST_OPERATOR_CONTROL,
            0,
            *replace(wanted, is_former=self._operator.uses_former).parameters(request.system_id),
            *(0.0, 0.0, 0.0),
        )
        return [operator.reply(notice)]

    def poll(self, now_us: int) -> list[Answer]:
        """Send CONTROL_STATUS, and release the control of a station that timed out."""
        if not self.exclusive or now_us < self._due_us:
            return []
        operator = self._operator
        if operator is not None and now_us - operator.received_us > TIMEOUT_US:
            return self._change(
                None, f"System {operator.request.system_id} lost control: timeout", now_us
            )
        self._due_us = now_us + INTERVAL_US
        return [Reply(self.status())]

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self.exclusive else None

    def remove_client(self, client_id: int) -> None:
        """Release the control of a station whose link has closed."""
        if self._operator is not None and self._operator.request.client_id == client_id:
            self._operator = None
            self._due_us = 0

    def status(self) -> Any:
        """Encode CONTROL_STATUS."""
        operator = self._operator
        is_free = operator is None or operator.allows_takeover
        flags = SYSTEM_MANAGER | (TAKEOVER_ALLOWED if is_free else 0)
        return CONTROL_STATUS(flags, operator.request.system_id if operator else 0, *[0] * 10)

    def _is_operator(self, request: Request) -> bool:
        if self._operator is None:
            return False
        operator = self._operator.request
        return (operator.client_id, operator.system_id) == (request.client_id, request.system_id)

    def _request(
        self,
        request: Request,
        now_us: int,
        *,
        allows_takeover: bool = False,
        uses_former: bool = False,
    ) -> Outcome:
        if not self.exclusive:
            return ACCEPTED, []
        operator = self._operator
        is_own = operator is not None and operator.request.system_id == request.system_id
        if operator is not None and not is_own and not operator.allows_takeover:
            return FAILED, self._explain(
                f"System {request.system_id} requests control; {self.denial(request)}", now_us
            )
        text = "" if is_own else f"System {request.system_id} is in control"
        granted = _Operator(request, now_us, allows_takeover, uses_former)
        return ACCEPTED, self._change(granted, text, now_us)

    def _release(self, request: Request, now_us: int) -> Outcome:
        if not self.exclusive:
            return ACCEPTED, []
        if not self._is_operator(request):
            return DENIED, []
        return ACCEPTED, self._change(None, f"System {request.system_id} released control", now_us)

    def _change(self, operator: _Operator | None, text: str, now_us: int) -> list[Answer]:
        self._operator = operator
        self._due_us = now_us + INTERVAL_US
        explained = self._explain(text, now_us) if text else []
        return [Reply(self.status()), *explained]
