"""The transports of sources: they receive bytes and reconnect.

| transport  | opened                                        | lost                              |
| ---------- | --------------------------------------------- | --------------------------------- |
| serial     | as soon as the device or USB id exists        | unplugged: tried again            |
| udp        | at once; an address in use is tried again     | never                             |
| tcp        | when the server accepts                       | closed by the server: tried again |
| tcp-listen | when a client connects, one at a time         | when it leaves                    |
| poll       | when the server answers                       | without an answer: tried again    |
| push       | with the first content                        | never                             |
| stdin      | at once                                       | at its end, for good              |
| file       | as soon as it exists, from its beginning      | shortened: read from its beginning|
| (a tlog)   | the same; bytes at their recorded times       | at its end, for good              |
"""

import asyncio
import logging
import os
import secrets
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import serial

from gateway.live.part import TLOG
from gateway.live.serial_port import PortNotFoundError, find_port, list_serial_ports, open_port
from gateway.printable import reason_of
from gateway.sources.recorded_bytes import TUNNEL_ID, tunnelled
from gateway.sources.source import PolledDecoder, SourceInput
from gateway.wire.framing import Fault

log = logging.getLogger(__name__)

READ_SIZE: Final = 4096
RETRY_S: Final = 1.0
FILE_POLL_S: Final = 0.05
POLL_S: Final = 0.1
ANSWER_S: Final = 3.0
"""Timeout of an answer."""
MAX_ANSWER: Final = 1 << 20
TOKEN_BYTES: Final = 12
"""Bytes of a token that the URL does not set: 96 bits, 16 characters."""
DEFAULT_BAUD: Final = {"crsf": 420_000, "ltm": 9600}
USUAL_BAUD: Final = 115_200


def read_map(path: str) -> str:
    """Read the map of columns that a source's option names; ValueError if it cannot be read."""
    try:
        return Path(path).expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"columns={path}: {reason_of(error)}") from error


class SourcePort:
    """Keep one source open, and pass on its bytes.

    `on_bytes` is called with the source and every chunk that arrives.
    """

    def __init__(self, source: SourceInput, on_bytes: Callable[[SourceInput, bytes], None]) -> None:
        self._source = source
        self._on_bytes = on_bytes
        self._task: asyncio.Task[None] | None = None
        self._complaint = ""
        self.token = ""
        """Token for pushing content; empty if this source accepts none."""
        if source.url.transport == "push":
            self.token = source.url.options.get("token") or secrets.token_urlsafe(TOKEN_BYTES)

    def start(self) -> None:
        """Begin to open it; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    def close(self) -> None:
        """Close it for good."""
        if self._task is not None:
            self._task.cancel()

    async def _run(self) -> None:
        url = self._source.url
        read = {
            "serial": self._serial,
            "udp": self._udp,
            "tcp": self._tcp,
            "tcp-listen": self._tcp_listen,
            "poll": self._poll,
            "push": self._push,
            "stdin": self._stdin,
            "file": self._file,
        }[url.transport]
        while True:
            try:
                await read()
            except (OSError, PortNotFoundError) as error:
                reason = str(error) if isinstance(error, PortNotFoundError) else reason_of(error)
                if url.transport == "stdin":
                    self._ended(reason)
                    return
                self._lost(reason)
            else:
                if url.transport == "stdin" or url.address.endswith(TLOG):
                    self._ended("its end was reached")
                    return
            await asyncio.sleep(RETRY_S)

    def _opened(self) -> None:
        log.info("source %s is open", self._source.url.name)
        self._complaint = ""
        self._source.opened()

    def _ended(self, reason: str) -> None:
        log.info("source %s: %s", self._source.url.name, reason)
        self._source.lost(reason)

    def _lost(self, reason: str) -> None:
        """Note, and log once, the reason why it is not open."""
        if self._source.connected or reason != self._complaint:
            log.warning("source %s: %s; trying again", self._source.url.name, reason)
        self._complaint = reason
        self._source.lost(reason)

    def _feed(self, data: bytes) -> None:
        self._on_bytes(self._source, data)

    async def _serial(self) -> None:
        url, ports = self._source.url, list_serial_ports()
        baud = int(url.options.get("baud", DEFAULT_BAUD.get(url.kind, USUAL_BAUD)))
        port = open_port(find_port(url.address, ports), baud, ports)
        try:
            await self._read_file(port)
        finally:
            port.close()

    async def _read_file(self, port: serial.Serial) -> None:
        """Read an open port until it is disconnected."""
        loop, lost = asyncio.get_running_loop(), asyncio.get_running_loop().create_future()
        file = port.fileno()

        def read() -> None:
            try:
                data = os.read(file, READ_SIZE)
            except BlockingIOError:
                return
            except OSError as error:
                data, reason = b"", reason_of(error)
            else:
                reason = "the device hung up"
            if data:
                self._feed(data)
            elif not lost.done():
                lost.set_result(reason)

        self._opened()
        loop.add_reader(file, read)
        try:
            self._lost(await lost)
        finally:
            loop.remove_reader(file)

    async def _udp(self) -> None:
        url = self._source.url
        transport, protocol = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: _Datagrams(self._feed), local_addr=(url.address, url.port)
        )
        self._opened()
        try:
            await protocol.closed
        finally:
            transport.close()

    async def _tcp(self) -> None:
        url = self._source.url
        reader, writer = await asyncio.open_connection(url.address, url.port)
        await self._stream(reader, writer)

    async def _tcp_listen(self) -> None:
        url = self._source.url
        server = await asyncio.start_server(self._client, url.address, url.port)
        self._source.lost("no client is connected")
        async with server:
            await server.serve_forever()

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._source.connected:
            writer.close()
            return
        try:
            await self._stream(reader, writer)
        except OSError as error:
            self._lost(reason_of(error))

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._opened()
        try:
            while data := await reader.read(READ_SIZE):
                self._feed(data)
            self._lost("the other side closed the connection")
        finally:
            writer.close()

    async def _poll(self) -> None:
        """Send the decoder's requests, and pass each answer on as a line."""
        decoder = self._source.decoder
        assert isinstance(decoder, PolledDecoder)
        url = self._source.url
        while True:
            async with asyncio.timeout(ANSWER_S):
                answer = await _get(url.address, url.port, decoder.request())
            if not self._source.connected:
                self._opened()
            self._feed(answer.replace(b"\n", b" ") + b"\n")
            await asyncio.sleep(POLL_S)

    async def _push(self) -> None:
        self._source.lost("nothing was posted yet")
        await asyncio.get_running_loop().create_future()

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
            self._opened()
        self._feed(data)

    async def _stdin(self) -> None:
        file = sys.stdin.fileno()
        kind = os.fstat(file).st_mode
        if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind) or os.isatty(file)):
            # An event loop cannot wait for a file or /dev/null, which never block.
            self._opened()
            while data := os.read(file, READ_SIZE):
                self._feed(data)
                await asyncio.sleep(0)
            return
        reader = asyncio.StreamReader(limit=READ_SIZE)
        protocol = asyncio.StreamReaderProtocol(reader)
        await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
        self._opened()
        while data := await reader.read(READ_SIZE):
            self._feed(data)

    async def _file(self) -> None:
        """Follow a file; one that has become shorter is read again from its beginning."""
        path = self._source.url.address
        if path.endswith(TLOG):
            await self._recorded(path)
            return
        with open(path, "rb", buffering=0) as file:  # noqa: PTH123
            self._opened()
            while True:
                while data := file.read(READ_SIZE):
                    self._feed(data)
                    await asyncio.sleep(0)
                if os.stat(path).st_size < file.tell():  # noqa: PTH116
                    self._lost("the file was shortened")
                    return
                await asyncio.sleep(FILE_POLL_S)

    async def _recorded(self, path: str) -> None:
        """Read the bytes of this source from a recording, at their recorded times."""
        from gateway.recordings.tlog import TlogScanner

        scanner, loop, start_s = TlogScanner(), asyncio.get_running_loop(), None
        with open(path, "rb") as file:  # noqa: PTH123
            self._opened()
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
                    self._feed(data)


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


class _Datagrams(asyncio.DatagramProtocol):
    """Pass on datagrams; a receiver ignores network errors."""

    def __init__(self, feed: Callable[[bytes], None]) -> None:
        self._feed = feed
        self.closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def datagram_received(self, data: bytes, _address: object) -> None:
        """Pass on a datagram."""
        self._feed(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """Report that the socket is closed."""
        if not self.closed.done():
            self.closed.set_result(None)
