"""Message rates that a client requests for itself alone.

A request for fewer messages thins the common stream at the hub. A request for more gives the
client a separate stream instead of the common one. That costs CPU time, so only clients that may
change things get it.
"""

from collections.abc import Container
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval
from gateway.vehicle.requests import Answer, Reply, Request, Service
from gateway.vehicle.telemetry.streams import OFF, Stream
from gateway.vehicle.telemetry.telemetry import CARRIED_MESSAGES, Telemetry

MAX_FAST_STREAMS: Final = 64
"""Each costs an encoding of its own."""
MIN_INTERVAL_US: Final = 1000
MIN_TIMED_INTERVAL_US: Final = 20_000
"""Of messages that no sample carries: faster they would only repeat themselves."""
MAX_REQUESTED: Final = 1024
"""Clients come and go; the oldest requested intervals are discarded first."""
KEEPS_CLIENTS_US: Final = 1_000_000
"""A client that gets fewer heartbeats loses the vehicle."""

DEFAULT: Final = 0
NONE: Final = -1

HEARTBEAT: Final = mavlink.MAVLINK_MSG_ID_HEARTBEAT

_GROUPS: Final[dict[int, tuple[int, ...]]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    ),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
    ),
    mavlink.MAV_DATA_STREAM_POSITION: (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,),
    mavlink.MAV_DATA_STREAM_EXTRA1: (
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    ),
    mavlink.MAV_DATA_STREAM_EXTRA2: (mavlink.MAVLINK_MSG_ID_VFR_HUD,),
}
DATA_STREAMS: Final = _GROUPS | {mavlink.MAV_DATA_STREAM_ALL: tuple(sum(_GROUPS.values(), ()))}
"""REQUEST_DATA_STREAM's groups, as autopilots fill them."""


class IntervalService(Service):
    """Which client gets which message how often."""

    types = ("REQUEST_DATA_STREAM",)

    def __init__(self, system_id: int, telemetry: Telemetry) -> None:
        self._system_id = system_id
        self._telemetry = telemetry
        self._requested: dict[tuple[int, int], int] = {}
        self._fast: dict[tuple[int, int], Stream] = {}

    def handle(self, request: Request, _now_us: int) -> list[Answer]:
        """Thin a group of messages by REQUEST_DATA_STREAM, which has no answer.

        It only ever thins: its rate is for whole groups, and raising everything in them would
        flood the client.
        """
        message = request.message
        ids = DATA_STREAMS.get(message.req_stream_id, ())
        wanted_us = NONE
        if message.start_stop and message.req_message_rate:
            wanted_us = 1_000_000 // message.req_message_rate
        answers: list[Answer] = []
        for message_id in ids:
            common_us = self._telemetry.streams[message_id].interval_us
            faster = 0 <= wanted_us <= common_us
            answers += self._take(request.client_id, message_id, DEFAULT if faster else wanted_us)
        return answers

    def set_interval(
        self, request: Request, message_id: int, requested_us: int
    ) -> list[Answer] | None:
        """Apply one client's requested interval, as in MAV_CMD_SET_MESSAGE_INTERVAL.

        None if the message is never streamed, or the rate cannot be granted.
        """
        stream = self._telemetry.streams.get(message_id)
        if stream is None:
            return None
        if message_id == HEARTBEAT and requested_us != DEFAULT:
            # A vehicle without heartbeats disappears from ground stations.
            if not 0 < requested_us <= KEEPS_CLIENTS_US:
                return None
            requested_us = DEFAULT
        if requested_us < 0:
            requested_us = NONE
        elif requested_us != DEFAULT:
            carried = message_id in CARRIED_MESSAGES
            requested_us = max(MIN_INTERVAL_US if carried else MIN_TIMED_INTERVAL_US, requested_us)
        if _is_faster(requested_us, stream.interval_us) and not request.may_change:
            return None
        return self._take(request.client_id, message_id, requested_us)

    def interval_us(self, client_id: int, message_id: int) -> int:
        """Return a client's MESSAGE_INTERVAL: -1 if it gets none, 0 if it is never sent."""
        stream = self._telemetry.streams.get(message_id)
        if stream is None:
            return DEFAULT
        return self._requested.get((client_id, message_id), stream.interval_us)

    def remove_client(self, client_id: int) -> None:
        """Discard the rates of a client that has gone."""
        for table in (self._requested, self._fast):
            for key in [key for key in table if key[0] == client_id]:
                del table[key]

    def on_state(self, time_us: int) -> list[Answer]:
        """Send the messages of an IMU sample to the clients that requested more."""
        return self._due(CARRIED_MESSAGES, time_us, Stream.offer)

    @property
    def has_fast(self) -> bool:
        """Whether a client requested more than the settings' rate."""
        return bool(self._fast)

    def poll(self, now_us: int) -> list[Answer]:
        """Send the timed messages to the clients that requested more."""
        if not self._fast:
            return []
        timed = [m for _, m in self._fast if m not in CARRIED_MESSAGES]
        return self._due(timed, now_us, Stream.tick)

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        due = [s.due_us or 0 for (_, m), s in self._fast.items() if m not in CARRIED_MESSAGES]
        return min(due, default=None)

    def _take(self, client_id: int, message_id: int, requested_us: int) -> list[Answer]:
        key = (client_id, message_id)
        self._fast.pop(key, None)
        self._requested.pop(key, None)
        common_us = self._telemetry.streams[message_id].interval_us
        if requested_us != DEFAULT:
            if len(self._requested) >= MAX_REQUESTED:
                self._requested.pop(next(iter(self._requested)))
            self._requested[key] = requested_us
        if _is_faster(requested_us, common_us) and len(self._fast) < MAX_FAST_STREAMS:
            self._fast[key] = Stream(requested_us)
            requested_us = NONE
        return [ClientInterval(client_id, self._system_id, message_id, requested_us)]

    def _due(self, wanted: Container[int], time_us: int, ask: Any) -> list[Answer]:
        found: list[Answer] = []
        for (client_id, message_id), stream in self._fast.items():
            if message_id in wanted and ask(stream, time_us):
                message = self._telemetry.build(message_id, time_us)
                if message is not None:
                    found.append(Reply(message, client_id))
        return found


def _is_faster(requested_us: int, common_us: int) -> bool:
    return requested_us > 0 and (common_us == OFF or requested_us < common_us)
