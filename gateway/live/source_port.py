"""The transports of sources: they receive bytes and reconnect.

| transport  | opened                                        | lost                              |
| ---------- | --------------------------------------------- | --------------------------------- |
| serial     | as soon as the device or USB id exists        | unplugged: tried again            |
| udp        | at once; an address in use is tried again     | never                             |
| tcp        | when the server accepts                       | closed by the server: tried again |
| tcp-listen | when a client connects; the newest one is used| when it leaves or vanishes        |
| poll       | when the server answers                       | without an answer: tried again    |
| push       | with the first content                        | never                             |
| stdin      | at once                                       | at its end, for good              |
| file       | as soon as it exists, from its beginning      | shortened: read from its beginning|
| (a tlog)   | the same; bytes at their recorded times       | at its end, for good              |

The first four are transports of the hub, with its intervals, limits and keepalive. Every source
processes at most `PART` bytes in a turn of the event loop.
"""

import asyncio
import logging
import os
import secrets
import stat
import sys
from collections.abc import Callable
from typing import Final, cast

import numpy as np
import serial

from gateway.hub.endpoint import Endpoint
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.byte_link import ByteLink, UdpReceiver
from gateway.hub.transports.serial_line import SerialClient
from gateway.hub.transports.tcp import TcpClient, TcpListener
from gateway.hub.transports.url_files import read_text
from gateway.live.part import TLOG
from gateway.live.serial_port import PortNotFoundError, find_port, list_serial_ports, open_port
from gateway.printable import reason_of
from gateway.sources.recorded_bytes import TUNNEL_ID, tunnelled
from gateway.sources.source import PolledDecoder, SourceInput
from gateway.wire.framing import Fault

log = logging.getLogger(__name__)

READ_SIZE: Final = 4096
PART: Final = 1024
"""Bytes that are processed in a turn of the loop: 100 small frames or 500 bad lines, some 10 ms."""
TICK_S: Final = 0.25
RETRY_S: Final = 1.0
FILE_POLL_S: Final = 0.05
POLL_S: Final = 0.1
ANSWER_S: Final = 3.0
"""Timeout of an answer."""
MAX_ANSWER: Final = 1 << 20
TOKEN_BYTES: Final = 12
"""Bytes of a token that the URL does not set: 96 bits, 16 characters."""
NOT_OPEN: Final = {"refused": "connection refused", "unreachable": "unreachable"}
"""Reasons of states of a transport that has not given one."""
GONE: Final = "the other side closed the connection"
REPLACED: Final = "another client has connected"
NO_CLIENT: Final = "no client is connected"


def read_map(path: str) -> str:
    """Read the map of columns that a source's option names; ValueError if it cannot be read."""
    try:
        return read_text(path)
    except OSError as error:
        raise ValueError(f"columns={path}: {reason_of(error)}") from error


class _SourceSerial(SerialClient):
    """A serial port by its device or its USB id."""

    def _open(self) -> serial.Serial:
        ports = list_serial_ports()
        try:
            return open_port(find_port(self.endpoint.host, ports), self.endpoint.port, ports)
        except PortNotFoundError as error:
            raise OSError(str(error)) from error


class _NewestClient(TcpListener):
    """A port whose newest client replaces the one before.

    A board that lost its supply connects again long before its old connection has timed out.
    """

    is_replacing = False

    def _has_room(self, host: str, now_us: int) -> bool:  # noqa: ARG002
        self.is_replacing = True
        for client in tuple(self._clients.values()):
            self.leave(client)
        self.is_replacing = False
        return True


LINKS: Final[dict[str, Callable[[HubContext, int, Endpoint], Client]]] = {
    "serial": _SourceSerial,
    "udp": UdpReceiver,
    "tcp": TcpClient,
}


class SourcePort(ByteLink):
    """Keep one source open, and pass on its bytes.

    `on_bytes` is called with the source and every chunk that arrives. The hub's limits apply to
    sources too.
    """

    read_bytes = PART
    _timer: asyncio.TimerHandle | None = None
    _task: asyncio.Task[None] | None = None
    _complaint = ""
    _is_closed = False

    def __init__(
        self,
        source: SourceInput,
        on_bytes: Callable[[SourceInput, bytes], None],
        hub: HubContext,
    ) -> None:
        super().__init__(hub)
        self._source = source
        self._on_bytes = on_bytes
        self.token = ""
        """Token for pushing content; empty if this source accepts none."""
        if source.url.transport == "push":
            self.token = source.url.options.get("token") or secrets.token_urlsafe(TOKEN_BYTES)

    def start(self) -> None:
        """Begin to open it; needs a running event loop."""
        endpoint, transport = self._source.url.endpoint, self._source.url.transport
        if transport == "push":
            self._source.lost("nothing was posted yet")
        elif endpoint is None or transport == "poll":
            self._task = asyncio.get_running_loop().create_task(self._run())
        else:
            context = cast("HubContext", self)
            if transport == "tcp-listen":
                self.link = _NewestClient(context, endpoint)
            else:
                self.link = link = LINKS[transport](context, self._hub.new_client_id(), endpoint)
                if isinstance(link, UdpReceiver):
                    link.split = self.parts_of
                self.appear(link)
            self._tick()

    def _tick(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(TICK_S, self._tick)
        self.tick(self._hub.now_us())

    def tick(self, now_us: int) -> None:
        """Open the transport if it is closed, and note why it is not open."""
        super().tick(now_us)
        if isinstance(self.link, TcpListener):
            if self.reason or not self.peers:
                self.lost(self.reason or NO_CLIENT)
        elif self.state != "open":
            self.lost(self.reason or NOT_OPEN.get(self.state, ""))

    def take(self, data: bytes, now_us: int) -> None:  # noqa: ARG002
        """Process received bytes."""
        self.feed(data)

    def greet(self, client_id: int) -> None:  # noqa: ARG002
        """Log that it is open, so that its next fault is logged again."""
        self.opened()

    def vanish(self, client: Client) -> None:
        """Note that the client of a listening port has gone."""
        super().vanish(client)
        is_replaced = isinstance(self.link, _NewestClient) and self.link.is_replacing
        self.lost(REPLACED if is_replaced else GONE)

    def close(self) -> None:
        """Close it without another attempt to open it."""
        self._is_closed = True
        if self._timer is not None:
            self._timer.cancel()
            super().close()
        if self._task is not None:
            self._task.cancel()

    async def _run(self) -> None:
        url = self._source.url
        read = {"poll": self._poll, "stdin": self._stdin, "file": self._file}[url.transport]
        while True:
            try:
                await read()
            except OSError as error:
                if url.transport == "stdin":
                    self._ended(reason_of(error))
                    return
                self.lost(reason_of(error))
            else:
                if url.transport == "stdin" or url.address.endswith(TLOG):
                    self._ended("its end was reached")
                    return
            await asyncio.sleep(RETRY_S)

    def opened(self) -> None:
        """Log that it is open, so that its next fault is logged again."""
        log.info("source %s is open", self._source.url.name)
        self._complaint = ""
        self._source.opened()

    def _ended(self, reason: str) -> None:
        log.info("source %s: %s", self._source.url.name, reason)
        self._source.lost(reason)

    def lost(self, reason: str) -> None:
        """Note, and log once, the reason why it is not open; empty if an open one has ended."""
        reason = reason or (GONE if self._source.connected else "")
        if not reason or self._is_closed:
            return
        is_new = self._source.connected or reason != self._complaint
        if is_new and reason not in (NO_CLIENT, REPLACED):
            log.warning("source %s: %s; trying again", self._source.url.name, reason)
        self._complaint = reason
        self._source.lost(reason)

    def feed(self, data: bytes) -> None:
        """Process received bytes."""
        self._on_bytes(self._source, data)

    def parts_of(self, data: bytes) -> list[bytes]:
        """Divide bytes to process in several turns; lines are kept whole."""
        parts, at = [], 0
        while at < len(data):
            end = at + PART
            if self._source.has_lines and end < len(data):
                end = data.rfind(b"\n", at, end) + 1 or data.find(b"\n", end) + 1 or len(data)
            parts.append(data[at:end])
            at = end
        return parts

    async def _feed_parts(self, data: bytes) -> None:
        for part in self.parts_of(data):
            self.feed(part)
            await asyncio.sleep(0)

    async def _poll(self) -> None:
        """Send the decoder's requests, and pass each answer on as a line."""
        decoder, endpoint = self._source.decoder, self._source.url.endpoint
        assert isinstance(decoder, PolledDecoder)
        assert endpoint is not None
        while True:
            async with asyncio.timeout(ANSWER_S):
                answer = await _get(endpoint.host, endpoint.port, decoder.request())
            if not self._source.connected:
                self.opened()
            self.feed(answer.replace(b"\n", b" ") + b"\n")
            await asyncio.sleep(POLL_S)

    @property
    def name(self) -> str:
        """The URL without its options."""
        return self._source.url.name

    def refuse(self, size: int) -> None:
        """Count a post with a wrong token."""
        self._source.count(Fault("token", size, "a post to the panel had a wrong token"))

    def push(self, data: bytes) -> None:
        """Process content that was posted with the token."""
        if data and not self._source.connected:
            self.opened()
        self.feed(data)

    async def _stdin(self) -> None:
        file = sys.stdin.fileno()
        kind = os.fstat(file).st_mode
        if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind) or os.isatty(file)):
            # An event loop cannot wait for a file or /dev/null, which never block.
            self.opened()
            while data := os.read(file, READ_SIZE):
                await self._feed_parts(data)
            return
        reader = asyncio.StreamReader(limit=READ_SIZE)
        protocol = asyncio.StreamReaderProtocol(reader)
        await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
        self.opened()
        while data := await reader.read(READ_SIZE):
            await self._feed_parts(data)

    async def _file(self) -> None:
        """Follow a file; one that has become shorter is read again from its beginning."""
        path = self._source.url.address
        if path.endswith(TLOG):
            await self._recorded(path)
            return
        with open(path, "rb", buffering=0) as file:  # noqa: PTH123
            self.opened()
            while True:
                while data := file.read(READ_SIZE):
                    await self._feed_parts(data)
                if os.stat(path).st_size < file.tell():  # noqa: PTH116
                    self.lost("the file was shortened")
                    return
                await asyncio.sleep(FILE_POLL_S)

    async def _recorded(self, path: str) -> None:
        """Read the bytes of this source from a recording, at their recorded times."""
        from gateway.recordings.tlog import TlogScanner

        scanner, loop, start_s = TlogScanner(), asyncio.get_running_loop(), None
        with open(path, "rb") as file:  # noqa: PTH123
            self.opened()
            while block := file.read(READ_SIZE):
                # The recording may contain gigabytes of other messages.
                await asyncio.sleep(0)
                batch = scanner.feed(block)
                for record in batch.records(np.flatnonzero(batch.message_ids == TUNNEL_ID)):
                    data = tunnelled(record.frame, self._source.node)
                    if not data:
                        continue
                    time_s = record.time_us / 1e6
                    start_s = loop.time() - time_s if start_s is None else start_s
                    await asyncio.sleep(max(start_s + time_s - loop.time(), 0.0))
                    self.feed(data)


async def _get(host: str, port: int, path: str) -> bytes:
    """Request a path by HTTP, and return the answer's content; raises OSError without one."""
    reader, writer = await asyncio.open_connection(host, port)
    try:
        # In version 1.0 an answer ends with the connection.
        writer.write(f"GET {path} HTTP/1.0\r\nHost: {host}:{port}\r\n\r\n".encode())
        answer = b""
        while len(answer) <= MAX_ANSWER and (data := await reader.read(READ_SIZE)):
            answer += data
    finally:
        writer.close()
    head, gap, content = answer.partition(b"\r\n\r\n")
    if head.split()[1:2] != [b"200"] or not gap or len(answer) > MAX_ANSWER:
        raise ConnectionError("no HTTP answer with status 200")
    return content
