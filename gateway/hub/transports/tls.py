"""TLS without a socket: network bytes in, plain bytes out, and back."""

import functools
import ssl
from pathlib import Path
from typing import Final

from gateway.hub.settings import HubSettings

READ_BYTES: Final = 16_384
"""One record of TLS."""


class TlsLayer:
    """One end of one connection.

    Parameters
    ----------
    context : ssl.SSLContext
        Certificates and accepted authorities.
    server_name : str, optional
        Name of the server; None if we are the server.
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
        except ssl.SSLWantReadError:
            # All that is complete was read.
            pass
        except ssl.SSLZeroReturnError:
            self.is_ended = True
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


def caller_context(settings: HubSettings) -> ssl.SSLContext:
    """Return the context for connecting to servers.

    Raises OSError if the file cannot be read or is invalid.
    """
    if not settings.tls_authority:
        return ssl.create_default_context()
    return ssl.create_default_context(cafile=Path(settings.tls_authority).expanduser())


def valid_until_s(certificate: Path, key: Path) -> float:
    """Return when a certificate ends, in s since 1970.

    It is shown to a client that trusts it, whoever signed it: Python reads no other.

    Parameters
    ----------
    certificate, key : Path
        PEM files; both may be the same.

    Raises
    ------
    OSError
        If the files cannot be read or are invalid; ssl.SSLCertVerificationError if the certificate
        is not valid now.
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
