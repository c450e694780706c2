"""Logins: hashed passwords, sessions, and limits for attempts."""

import asyncio
import base64
import hashlib
import hmac
import secrets
import time
from collections import Counter, defaultdict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Final

from gateway.hub.endpoint import is_loopback
from gateway.panel.admission import Holder, Role, Slots, address_group

COST: Final = 1 << 15
"""scrypt's N, with r = 8 and p = 1: 32 MB and some 0.1 s for each login."""
BLOCK: Final = 8
MEMORY: Final = 64 << 20
SALT_BYTES: Final = 16
SESSION_S: Final = 12 * 3600
SESSIONS_OF_ADDRESS: Final = 16
SESSIONS_OF_ROLE: Final = 32
MAX_ATTEMPTS: Final = 5
"""Maximum attempts of one address within `ATTEMPT_WINDOW_S`; a correct password clears them."""
ATTEMPT_WINDOW_S: Final = 60.0
MAX_PEERS: Final = 256
MAX_WAITING: Final = 4
"""Maximum passwords of one network that wait to be hashed."""
MAX_NETWORKS: Final = 16
"""Maximum networks with waiting passwords: an operator waits for one hash of each, some s."""
MAX_KNOWN: Final = 64
"""Maximum stored addresses of successful logins."""


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


class BusyError(Exception):
    """Too many callers are waiting."""


class FairTurns:
    """A lock that waiting callers get in turn by group, one caller of each group after another."""

    def __init__(self) -> None:
        self._callers: Counter[str] = Counter()
        """Callers of each group that wait or have the lock."""
        self._of_group: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._of_all = asyncio.Lock()

    @asynccontextmanager
    async def turn(self, group: str, *, is_known: bool) -> AsyncIterator[None]:
        """Wait for a turn; raises BusyError if too many of the group, or other groups, wait."""
        is_new = group not in self._callers
        is_crowded = is_new and not is_known and len(self._callers) > MAX_NETWORKS
        if is_crowded or self._callers[group] > MAX_WAITING:
            raise BusyError
        self._callers[group] += 1
        try:
            # One caller of each group waits for the other groups, in the order of arrival.
            async with self._of_group[group], self._of_all:
                yield
        finally:
            self._callers[group] -= 1
            if not self._callers[group]:
                del self._callers[group], self._of_group[group]


@dataclass(slots=True)
class Logins:
    """Sessions, and the attempts of each address."""

    operator_hash: str
    viewer_hash: str
    on_close: Callable[[str], object] = lambda _: None
    """Called with the token of a session that has ended, for any reason."""
    _sessions: dict[str, tuple[Role, float]] = field(default_factory=dict)
    _slots: Slots[str] = field(init=False)
    _attempts: dict[str, deque[float]] = field(default_factory=dict)
    _hashing: FairTurns = field(default_factory=FairTurns)
    _known: dict[str, None] = field(default_factory=dict)
    """Addresses from which a login has succeeded, the last one at the end."""

    def __post_init__(self) -> None:
        """Create the slots of the sessions."""
        self._slots = Slots(
            SESSIONS_OF_ROLE, SESSIONS_OF_ADDRESS, SESSIONS_OF_ROLE, self.close_session
        )

    @property
    def is_open(self) -> bool:
        """Whether no password is needed."""
        return not self.operator_hash

    def role_of(self, token: str) -> Role | None:
        """Return the role of a session; None if there is no such session."""
        if self.is_open:
            return Role.OPERATOR
        role, until_s = self._sessions.get(token, (None, 0.0))
        if time.monotonic() < until_s:
            return role
        self.close_session(token)
        return None

    def may_attempt(self, host: str) -> bool:
        """Return whether an address may attempt a login, and count the attempt.

        It is counted before the password is checked, which takes time: otherwise any number of
        parallel attempts would be checked.
        """
        group, now_s = address_group(host), time.monotonic()
        attempts = self._attempts.get(group)
        if attempts is None:
            if len(self._attempts) >= MAX_PEERS:
                self._attempts.pop(next(iter(self._attempts)))
            attempts = self._attempts[group] = deque(maxlen=MAX_ATTEMPTS)
        if len(attempts) == MAX_ATTEMPTS and now_s - attempts[0] < ATTEMPT_WINDOW_S:
            return False
        attempts.append(now_s)
        return True

    async def check(self, host: str, password: str) -> Role | None:
        """Return the role of a password; one password is hashed at a time, in a thread.

        Networks have turns, and so has each address from which a login has succeeded. Raises
        BusyError if too many wait.
        """
        address = address_group(host)
        is_known = address in self._known or is_loopback(host)
        async with self._hashing.turn(address if is_known else _network(host), is_known=is_known):
            role = await asyncio.to_thread(self._role_of_password, password)
        if role is not None:
            self._attempts.pop(address, None)
            self._known.pop(address, None)
            self._known[address] = None
            if len(self._known) > MAX_KNOWN:
                del self._known[next(iter(self._known))]
        return role

    def open_session(self, role: Role, host: str) -> str:
        """Open a session and return its token; an older one of the role may be ended for it."""
        token = secrets.token_urlsafe(32)
        self._slots.admit(token, Holder(role, token, address_group(host)))
        self._sessions[token] = (role, time.monotonic() + SESSION_S)
        return token

    def close_session(self, token: str) -> None:
        """End a session."""
        self._slots.release(token)
        if self._sessions.pop(token, None) is not None:
            self.on_close(token)

    def _role_of_password(self, password: str) -> Role | None:
        if matches(password, self.operator_hash):
            return Role.OPERATOR
        return Role.VIEWER if matches(password, self.viewer_hash) else None


def _network(host: str) -> str:
    """Return the network of an address, /24 or /64, or the text itself if it is none."""
    group = address_group(host)
    return group.rpartition(".")[0] or group


def _derive(password: str, salt: bytes, cost: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=cost, r=BLOCK, p=1, maxmem=MEMORY)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
