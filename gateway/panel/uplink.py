"""The panel's connections: the gateway's control socket, and MAVLink as one more client.

MAVLink uses the hub, with its transports and reconnection. With a URL it connects there. Without
one it requests a separate listening port on loopback from the gateway on this machine, over the
control socket, and again after each timeout of that port: so a restarted gateway is found again. A
second hub receives the frames of a player that the panel starts: they reach only the panel, and
commands to a played aircraft reach its player.
"""

import asyncio
import logging
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.live.control_socket import ControlError, find_socket, request
from gateway.panel.state.commands import result_text
from gateway.panel.state.fleet import FleetState
from gateway.records import NAN, Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location
from gateway.wire.mavlink_splitter import frame_of, message_id_of, origin_of

log = logging.getLogger(__name__)

READING: Final = frozenset(
    {"status", "verbs", "clients.list", "record.status", "record.list", "play.status"}
)
"""Verbs that a viewer may use, because they change nothing."""
STATUS_S: Final = 1.0
SYSTEM_ID: Final = 253
FIRST_COMPONENT: Final = 25
USER_COMPONENTS: Final = 75
"""Number of component ids from MAV_COMP_ID_USER1 on, by which panels of one gateway differ."""
HEARTBEAT_S: Final = 1.0
PROBE_S: Final = 0.2
"""Interval of heartbeats while nothing is received: the first one may be sent before the socket is
open."""
SILENT_US: Final = 3 * US_PER_S
ACK_TIMEOUT_S: Final = 1.5
PROGRESS_TIMEOUT_S: Final = 20.0
"""Timeout after an acknowledgement that a command is in progress: a busy disk may take so long."""
ATTEMPTS: Final = 3
MAX_SENDERS: Final = 64
"""Maximum programs that send through the panel with their own ids."""
LOCAL_ADDRESS: Final = "udp-listen:127.0.0.1:0"
LOCAL_URL: Final = f"{LOCAL_ADDRESS}?name=panel"
PLAYBACK_URL: Final = "udp-listen:127.0.0.1:0?name=playback&trusted=yes"
"""Endpoint that receives the frames of the panel's player."""


class ControlClient:
    """Send requests to a running gateway (or player)."""

    def __init__(self, path: Path | None) -> None:
        self.path = path

    async def ask(self, verb: str, **params: Any) -> Any:
        """Send a request, and return the result, decoded from JSON.

        Raises ControlError if no gateway listens, or the request is refused.
        """
        return await asyncio.to_thread(
            lambda: request(self.path or find_socket("run"), verb, params)
        )


class LoopTask:
    """A coroutine, `_run`, that runs from `start` to `close`."""

    _task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start it; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    def close(self) -> None:
        """Cancel it."""
        if self._task is not None:
            self._task.cancel()

    async def _run(self) -> None:
        raise NotImplementedError


class GatewayWatch(LoopTask):
    """The newest answers of the gateway on this machine."""

    def __init__(self, control: ControlClient, fleet: FleetState) -> None:
        self.status: dict[str, Any] | None = None
        """Result of the verb `status`; None while no gateway runs."""
        self.before: dict[str, Any] | None = None
        """The result before it, to compute rates."""
        self.recorder: dict[str, Any] | None = None
        self._control = control
        self._fleet = fleet
        self._polling = asyncio.Lock()
        """Held during a request, so that an earlier answer cannot arrive after a later one."""

    async def refresh(self) -> None:
        """Poll now, so that the status is not older than this call."""
        async with self._polling:
            try:
                status = await self._control.ask("status")
            except ControlError:
                self.status = self.before = self.recorder = None
                return
            self.before, self.status, self.recorder = self.status, status, status["recorder"]
        for aircraft in status["aircraft"]:
            vehicle = self._fleet.vehicles.get(aircraft["vehicle_id"])
            if vehicle is not None:
                vehicle.exact_mark = _spot_of(aircraft["mark"])

    async def _run(self) -> None:
        while True:
            with suppress(OSError):
                await self.refresh()
            await asyncio.sleep(STATUS_S)


def _spot_of(mark: dict[str, Any] | None) -> Location | None:
    if mark is None:
        return None
    alt_amsl_m = NAN if mark["alt_amsl_m"] is None else mark["alt_amsl_m"]
    return Location(mark["lat_deg"], mark["lon_deg"], alt_amsl_m)


class CommandFailedError(Exception):
    """A command was refused or not answered; the text gives the reason."""


class Uplink(LoopTask):
    """Frames in, requests out."""

    def __init__(
        self, url: str | None, fleet: FleetState, control: ControlClient, clock: GatewayClock
    ) -> None:
        self.is_local = url is None
        if url is not None and "trusted=" not in url:
            # The operator has given it.
            url = f"{url}{'&' if '?' in url else '?'}trusted=yes"
        self._fleet = fleet
        self._control = control
        self._clock = clock
        self._mav: Any = mavlink.MAVLink(
            None, SYSTEM_ID, FIRST_COMPONENT + os.getpid() % USER_COMPONENTS
        )
        self._hub = self._make_hub(url, played=False)
        self._player_hub = self._make_hub(PLAYBACK_URL, played=True)
        self._senders: dict[tuple[int, int], Any] = {}
        self._listeners: list[Callable[[Any], None]] = []
        self._received_us = -SILENT_US
        self._local = self._reported = ""
        self._acks: dict[tuple[int, int], asyncio.Queue[int]] = {}

    def start(self) -> None:
        """Connect; needs a running event loop. Failed connections are retried."""
        self._hub.start()
        self._player_hub.start()
        super().start()

    def close(self) -> None:
        """End the connection."""
        super().close()
        self._hub.close()
        self._player_hub.close()

    @property
    def playback_port(self) -> int:
        """Loopback port that receives the frames of a player; 0 while it is not open."""
        return next(iter(self._player_hub.listening_ports()), 0)

    @property
    def is_alive(self) -> bool:
        """Whether anything was received in the last seconds."""
        return self._clock() - self._received_us < SILENT_US

    def listen(self, listener: Callable[[Any], None]) -> None:
        """Call a listener with every decoded message."""
        self._listeners.append(listener)

    def send(self, message: Any, system_id: int = 0, component_id: int = 0) -> int:
        """Send a message from the ids of a client, by default the panel's; return its bytes."""
        mav = self._sender(system_id, component_id)
        frame = message.pack(mav)
        mav.seq = (mav.seq + 1) % 256
        is_played = frame_of(frame).target[0] in self._fleet.origins
        hub = self._player_hub if is_played else self._hub
        hub.send(Outgoing(frame, message.get_msgId()))
        return len(frame)

    async def command(self, message: Any) -> None:
        """Send a COMMAND_LONG or COMMAND_INT, and wait until it is acknowledged.

        Raises CommandFailedError if it is refused or not answered.
        """
        system_id, number = message.target_system, message.command
        name = mavlink.enums["MAV_CMD"][number].name if number in mavlink.enums["MAV_CMD"] else ""
        results: asyncio.Queue[int] = asyncio.Queue()
        self._acks[system_id, number] = results
        try:
            for _ in range(ATTEMPTS):
                self.send(message)
                try:
                    result = await _outcome(results)
                except TimeoutError:
                    continue
                if result != mavlink.MAV_RESULT_ACCEPTED:
                    raise CommandFailedError(f"{name or number}: {result_text(result)}")
                return
        finally:
            self._acks.pop((system_id, number), None)
        raise CommandFailedError(f"{name or number}: aircraft {system_id} does not answer")

    def _sender(self, system_id: int, component_id: int) -> Any:
        if not system_id:
            return self._mav
        key = (system_id, component_id)
        if key not in self._senders:
            if len(self._senders) >= MAX_SENDERS:
                self._senders.clear()
            self._senders[key] = mavlink.MAVLink(None, *key)
        return self._senders[key]

    def _make_hub(self, url: str | None, *, played: bool) -> Hub:
        def on_frame(incoming: Incoming) -> None:
            # A broadcast also arrives as a foreign frame.
            if not incoming.forwarded:
                self._handle(incoming.frame, played=played)

        def on_foreign(frames: Sequence[bytes]) -> None:
            for frame in frames:
                self._handle(frame, played=played)

        settings = HubSettings(endpoints=(url,) if url else (), ping_interval_s=0.0)
        return Hub(settings, on_frame, self._clock, on_foreign=on_foreign)

    def _handle(self, frame: bytes, *, played: bool) -> None:
        if (origin_of(frame)[0] in self._fleet.origins) is not played:
            # If two have the same id, the page uses the one whose id it has assigned.
            return
        try:
            message = self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            log.debug("message %d cannot be decoded", message_id_of(frame))
            return
        now_us = self._clock()
        if not played and message.get_srcSystem() != SYSTEM_ID:
            self._received_us = now_us
        if message.get_type() == "COMMAND_ACK":
            waiting = self._acks.get((message.get_srcSystem(), message.command))
            if waiting is not None:
                waiting.put_nowait(message.result)
        self._fleet.update(message, now_us)
        for listener in self._listeners:
            listener(message)

    async def _run(self) -> None:
        beat = mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )
        while True:
            if self.is_local and not self.is_alive:
                await self._find_gateway()
            self.send(beat)
            await asyncio.sleep(HEARTBEAT_S if self.is_alive else PROBE_S)

    async def _find_gateway(self) -> None:
        """Ask the gateway on this machine for a separate port, and connect to it."""
        try:
            port = await self._local_port()
        except ControlError as error:
            if str(error) != self._reported:
                self._reported = str(error)
                log.warning("no MAVLink yet: %s", error)
            return
        url = f"udp:127.0.0.1:{port}?name=gateway"
        if not port or url == self._local:
            return
        if self._local:
            self._hub.remove(self._local)
        self._hub.add(url)
        self._local = url

    async def _local_port(self) -> int:
        for _ in range(2):
            status = await self._control.ask("status")
            for listener in status["listeners"]:
                if listener["endpoint"].partition("?")[0] == LOCAL_ADDRESS:
                    return int(listener["port"])
            await self._control.ask("clients.add", url=LOCAL_URL)
        return 0


async def _outcome(results: asyncio.Queue[int]) -> int:
    """Wait for the result of a command, longer once it is being carried out."""
    async with asyncio.timeout(ACK_TIMEOUT_S):
        result = await results.get()
    while result == mavlink.MAV_RESULT_IN_PROGRESS:
        async with asyncio.timeout(PROGRESS_TIMEOUT_S):
            result = await results.get()
    return result
