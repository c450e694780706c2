"""TLS: one connection without a socket, its contexts, and a byte stream that may be encrypted."""

import contextlib
import functools
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gateway.hub.settings import HubSettings
from gateway.hub.transports.stream import StreamClient
from gateway.hub.transports.tcp import TcpClient
from gateway.hub.transports.url_files import read_text, regular_file

READ_BYTES: Final = 16_384
"""Bytes of one read: a TLS record."""

MakeContext = Callable[[], ssl.SSLContext]
"""Makes a TLS context; raises OSError if that fails."""


class TlsLayer:
    """One end of one connection; without the name of a server, we are the server."""

    def __init__(self, context: ssl.SSLContext, server_name: str | None = None) -> None:
        self._inward = ssl.MemoryBIO()
        self._outward = ssl.MemoryBIO()
        self._stream = context.wrap_bio(
            self._inward,
            self._outward,
            server_side=server_name is None,
            server_hostname=server_name,
        )
        self.is_open = False
        """Whether the handshake is complete."""
        self.is_ended = False
        """Whether the peer has closed its direction."""

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """Process network bytes.

        Raises ssl.SSLError if they are not TLS, or a certificate is not accepted;
        `outgoing` then holds the alert.
        """
        self._inward.write(data)
        plain = b""
        try:
            if not self.is_open:
                self._stream.do_handshake()
                self.is_open = True
            while chunk := self._stream.read(READ_BYTES):
                plain += chunk
            self.is_ended = True
        except ssl.SSLWantReadError:
            # All complete records were read.
            pass
        return plain, self.outgoing()

    def wrap(self, plain: bytes) -> bytes:
        """Return the bytes to send for some plain bytes."""
        self._stream.write(plain)
        return self.outgoing()

    def outgoing(self) -> bytes:
        """Return the bytes to send at once."""
        return self._outward.read()

    def peer_valid_until_s(self) -> float:
        """Return when the verified certificate of the peer ends, in s since 1970."""
        found = self._stream.getpeercert() or {}
        return ssl.cert_time_to_seconds(str(found["notAfter"]))


def server_context(settings: HubSettings) -> ssl.SSLContext:
    """Return the context of a listening port; a replaced certificate is read again.

    Raises OSError if the files cannot be read or are invalid.
    """
    if not settings.tls_certificate:
        raise OSError("set hub.tls_certificate to a PEM file")
    certificate = Path(settings.tls_certificate).expanduser()
    key = Path(settings.tls_key).expanduser() if settings.tls_key else certificate
    return _server_context(certificate, certificate.stat().st_mtime_ns, key, key.stat().st_mtime_ns)


def client_context(authority: str, certificate: str = "", key: str = "") -> ssl.SSLContext:
    """Return a context for connecting to servers, with our own certificate if one is given.

    Raises OSError if a file cannot be read or is invalid.
    """
    context = ssl.create_default_context(cadata=read_text(authority) if authority else None)
    if certificate:
        context.load_cert_chain(
            regular_file(certificate), regular_file(key) if key else None, password=""
        )
    return context


def valid_until_s(certificate: Path, key: Path) -> float:
    """Return when a certificate ends, in s since 1970.

    Python reads only verified certificates: so an in-memory client, which accepts this one as its
    own authority, connects to an in-memory server that presents it. Raises OSError if the PEM
    files, which may be the same, cannot be read or are invalid; ssl.SSLCertVerificationError if
    the certificate is not valid now.
    """
    trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    trusting.check_hostname = False
    trusting.verify_flags = ssl.VERIFY_X509_PARTIAL_CHAIN
    trusting.load_verify_locations(certificate)
    server, client = TlsLayer(_presenting(certificate, key)), TlsLayer(trusting, "localhost")
    sent = b""
    while not client.is_open:
        _, asked = client.feed(sent)
        _, sent = server.feed(asked)
    return client.peer_valid_until_s()


@functools.lru_cache(maxsize=4)
def _server_context(
    certificate: Path,
    certificate_ns: int,  # noqa: ARG001
    key: Path,
    key_ns: int,  # noqa: ARG001
) -> ssl.SSLContext:
    return _presenting(certificate, key)


def _presenting(certificate: Path, key: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    # Never ask for a password: a daemon has no terminal.
    context.load_cert_chain(certificate, key, password="")
    return context


class TlsStream(StreamClient):
    """A byte stream with or without TLS."""

    _tls: TlsLayer | None = None

    def begin_tls(self, layer: TlsLayer) -> None:
        """Encrypt everything from now on; a caller sends the first message of the handshake."""
        self._tls = layer
        if self._socket is not None and (hello := layer.feed(b"")[1]):
            self._write(self._socket, hello)

    def secured(self) -> None:
        """Continue after the handshake."""

    def give_up(self, reason: str) -> None:
        """Close the connection and record the reason."""
        raise NotImplementedError

    def encrypt(self, data: bytes) -> bytes:
        """Return the network bytes of some bytes."""
        return data if self._tls is None else self._tls.wrap(data)

    def _wrap(self, frames: bytes) -> bytes:
        return self.encrypt(frames)

    def decrypt(self, data: bytes) -> bytes:
        """Return the bytes in some network bytes; answers of the handshake are sent."""
        if self._tls is None:
            return data
        assert self._socket is not None
        was_open = self._tls.is_open
        try:
            plain, reply = self._tls.feed(data)
        except ssl.SSLError as error:
            with contextlib.suppress(OSError):
                self._socket.send(self._tls.outgoing())
            text = f"tls: {error.reason or error}".replace("_", " ").lower()
            if isinstance(error, ssl.SSLCertVerificationError):
                text += f": {error.verify_message}"
            self.give_up(text)
            return b""
        if reply:
            self._write(self._socket, reply)
        if self._tls.is_open and not was_open and self._socket is not None:
            self.secured()
        if self._tls.is_ended and not plain and self._socket is not None:
            self._broke()
        return plain


class TlsClient(TlsStream, TcpClient):
    """A TCP connection with TLS that the gateway makes, without MAVLink."""

    make_context: MakeContext
    _context: ssl.SSLContext

    async def _connect(self) -> None:
        try:
            # Reads files, which takes long on a network drive.
            self._context = await self.loop.run_in_executor(None, self.make_context)
        except OSError as error:
            self.become("unreachable", error)
            self._task = None
        else:
            await super()._connect()

    def _begin(self) -> None:
        self.begin_tls(TlsLayer(self._context, self.endpoint.host))

    def secured(self) -> None:
        """Send from now on."""
        self.become("open")

    def give_up(self, reason: str) -> None:
        """Close the connection, and keep the reason until another is made."""
        self._broke()
        self.state, self.reason = "unreachable", reason

    def accept(self, data: bytes, now_us: int) -> None:
        """Process received bytes."""
        if plain := self.decrypt(data):
            self.sink_bytes(plain, now_us)
