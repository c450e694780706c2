"""PING and TIMESYNC: a client measures the round trip and its clock's offset to ours."""

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.actions import Answer, Request

NS_PER_US: Final = 1000


class TimingService:
    """Answer PING and TIMESYNC requests; ignore answers to others."""

    types = ("PING", "TIMESYNC")

    def changes_state(self, _request: Request) -> bool:
        """Return False: nothing here changes state."""
        return False

    def refuse(self, _request: Request) -> list[Answer]:
        """Say nothing."""
        return []

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer a request at once.

        Parameters
        ----------
        request : Request
            A PING with target 0, 0 is a request; one with a target is an answer. A
            TIMESYNC with `tc1` 0 is a request.
        now_us : int
            Gateway clock.

        Returns
        -------
        list of Answer
        """
        message = request.message
        if message.get_type() == "PING":
            if (message.target_system, message.target_component) != (0, 0):
                return []
            answer = mavlink.MAVLink_ping_message(
                message.time_usec, message.seq, request.system_id, request.component_id
            )
            return [request.reply(answer)]
        if message.tc1 != 0:
            return []
        return [request.reply(mavlink.MAVLink_timesync_message(now_us * NS_PER_US, message.ts1))]
