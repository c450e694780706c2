"""TLS without a socket: bytes of the network in, bytes of the stream out, and back."""

import functools
import ssl
from pathlib import Path
from typing import Final

from gateway.routing.hub_settings import HubSettings

READ_BYTES: Final = 16_384
"""One record of TLS."""


class TlsLayer:
    """One end of one connection.

    Parameters
    ----------
    context : ssl.SSLContext
        Certificates and what is accepted.
    server_name : str, optional
        Whom we call; None if we were called.
    """

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
        """Whether both have agreed on keys."""
        self.is_ended = False
        """Whether the peer has said that nothing more comes."""

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """Take bytes of the network.

        Returns
        -------
        tuple of bytes
            What the peer said, and what is to be sent at once.

        Raises
        ------
        ssl.SSLError
            If they are no TLS, or a certificate is not accepted; `outgoing` then tells the peer.
        """
        self._inward.write(data)
        plain = b""
        try:
            if not self.is_open:
                self._stream.do_handshake()
                self.is_open = True
            while chunk := self._stream.read(READ_BYTES):
                plain += chunk
        except ssl.SSLWantReadError:
            # All that is complete was read.
            pass
        except ssl.SSLZeroReturnError:
            self.is_ended = True
        return plain, self.outgoing()

    def wrap(self, plain: bytes) -> bytes:
        """Return the bytes to send for some of the stream."""
        self._stream.write(plain)
        return self.outgoing()

    def outgoing(self) -> bytes:
        """Return what is to be sent at once."""
        return self._outward.read()


def server_context(settings: HubSettings) -> ssl.SSLContext:
    """Return what a listening port shows; a certificate that was replaced is read again.

    Raises
    ------
    OSError
        If the files cannot be read or are none.
    """
    if not settings.tls_certificate:
        raise OSError("set hub.tls_certificate to a PEM file")
    certificate = Path(settings.tls_certificate).expanduser()
    key = Path(settings.tls_key).expanduser() if settings.tls_key else certificate
    return _server_context(certificate, certificate.stat().st_mtime_ns, key, key.stat().st_mtime_ns)


def caller_context(settings: HubSettings) -> ssl.SSLContext:
    """Return what we accept servers by.

    Raises
    ------
    OSError
        If the file cannot be read or is none.
    """
    if not settings.tls_authority:
        return ssl.create_default_context()
    return ssl.create_default_context(cafile=Path(settings.tls_authority).expanduser())


@functools.lru_cache(maxsize=4)
def _server_context(
    certificate: Path,
    certificate_ns: int,  # noqa: ARG001
    key: Path,
    key_ns: int,  # noqa: ARG001
) -> ssl.SSLContext:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    # A password is never asked for: nobody sits before a daemon.
    context.load_cert_chain(certificate, key, password="")
    return context
