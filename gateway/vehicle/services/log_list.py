"""The list of on-board logs, which is empty: recordings are on the gateway's disk."""

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.actions import Answer, Request


class LogListService:
    """Answer LOG_REQUEST_LIST at once; without an answer ground stations ask on for seconds."""

    types = ("LOG_REQUEST_LIST",)

    def changes_state(self, _request: Request) -> bool:
        """Return False: nothing here changes state."""
        return False

    def refuse(self, _request: Request) -> list[Answer]:
        """Say nothing."""
        return []

    def handle(self, request: Request, _now_us: int) -> list[Answer]:
        """Answer with one LOG_ENTRY of no logs, as MAVLink's log protocol says."""
        return [request.reply(mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))]
