"""Passwords and sessions of the panel."""

import base64
import hashlib
import hmac
import secrets
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from gateway.panel.view_context import Role

COST: Final = 1 << 15
"""scrypt's N with r = 8 and p = 1: 32 MB and some 0.1 s, once a login."""
BLOCK: Final = 8
MEMORY: Final = 64 << 20
SALT_BYTES: Final = 16
SESSION_S: Final = 12 * 3600
MAX_SESSIONS: Final = 64
MAX_FAILURES: Final = 5
FAILURE_WINDOW_S: Final = 60.0
MAX_PEERS: Final = 256


def hash_password(password: str) -> str:
    """Hash a password for the settings file: `scrypt$N$salt$hash`."""
    salt = secrets.token_bytes(SALT_BYTES)
    return "$".join(("scrypt", str(COST), _text(salt), _text(_derive(password, salt, COST))))


def matches(password: str, hashed: str) -> bool:
    """Return whether a password matches a hash; an invalid hash matches none."""
    try:
        kind, cost, salt, digest = hashed.split("$")
        derived = _derive(password, base64.b64decode(salt), int(cost))
        return kind == "scrypt" and hmac.compare_digest(derived, base64.b64decode(digest))
    except (ValueError, MemoryError):
        return False


@dataclass(slots=True)
class PageLock:
    """Sessions, and addresses with too many wrong passwords.

    Parameters
    ----------
    operator_hash, viewer_hash : str
        From the settings; without the first no password is needed.
    """

    operator_hash: str
    viewer_hash: str
    _sessions: dict[str, tuple[Role, float]] = field(default_factory=dict)
    _failures: dict[str, deque[float]] = field(default_factory=dict)

    @property
    def is_open(self) -> bool:
        """Whether no password is needed."""
        return not self.operator_hash

    def role_of(self, token: str) -> Role | None:
        """Return the role of a session; None if there is no such session."""
        if self.is_open:
            return Role.OPERATOR
        role, until_s = self._sessions.get(token, (None, 0.0))
        return role if time.monotonic() < until_s else None

    def may_try(self, peer: str) -> bool:
        """Return whether an address may try another password."""
        now_s = time.monotonic()
        failures = self._failures.get(peer, ())
        return sum(now_s - then_s < FAILURE_WINDOW_S for then_s in failures) < MAX_FAILURES

    def check(self, password: str) -> Role | None:
        """Return the role of a password. Slow: do not call it on the event loop."""
        if matches(password, self.operator_hash):
            return Role.OPERATOR
        return Role.VIEWER if matches(password, self.viewer_hash) else None

    def note_failure(self, peer: str) -> None:
        """Note a wrong password."""
        if len(self._failures) >= MAX_PEERS and peer not in self._failures:
            self._failures.pop(next(iter(self._failures)))
        self._failures.setdefault(peer, deque(maxlen=MAX_FAILURES)).append(time.monotonic())

    def open_session(self, role: Role) -> str:
        """Open a session and return its token."""
        if len(self._sessions) >= MAX_SESSIONS:
            self._sessions.pop(next(iter(self._sessions)))
        token = secrets.token_urlsafe(32)
        self._sessions[token] = (role, time.monotonic() + SESSION_S)
        return token

    def close_session(self, token: str) -> None:
        """End a session."""
        self._sessions.pop(token, None)


def _derive(password: str, salt: bytes, cost: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=cost, r=BLOCK, p=1, maxmem=MEMORY)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
