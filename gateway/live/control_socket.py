"""The control socket, by which the command line and the panel talk to a running gateway.

A Unix socket that only the user (and root) can open; a system service's, its group too. Each
request and each reply is one line of JSON; docs/control.md describes every verb. A command uses the
named socket, the only one of its user, or the system service's.
"""

from __future__ import annotations

import logging
import os
import pwd
import socket
import struct
from collections.abc import Awaitable, Callable, Mapping
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from gateway.printable import UserError

if TYPE_CHECKING:
    import asyncio

log = logging.getLogger(__name__)

MAX_LINE: Final = 64 << 10
"""Maximum bytes of a line: a request is short; a status of many clients has some thousand."""
MAX_PATH: Final = 107
"""Bytes of `sun_path`, without the zero at its end."""
MAX_CONNECTIONS: Final = 16
"""Maximum connections; for a further one, that with the longest wait for a request is closed."""
BACKLOG: Final = 128
"""Connections that may wait in the kernel, since each wake-up accepts only one."""
IDLE_S: Final = 60.0
"""A connection without a request is closed after this time."""
FOLDER_RIGHTS: Final = 0o700
SOCKET_RIGHTS: Final = 0o600
SERVICE_SOCKET_RIGHTS: Final = 0o660
SERVICE_FOLDER: Final = Path("/run/mavgate")
"""Folder that systemd creates for the unit."""
GROUP: Final = "mavgate"
"""Group whose members may control the service."""
MAX_GATEWAYS: Final = 9
"""Maximum gateways of one user: `run.sock`, `run-2.sock`, …"""
REQUEST_TIMEOUT_S: Final = 10.0
STARTERS: Final = {
    "run": "`mavgate run` or `mavgate demo`",
    "play": "`mavgate play`",
    "fleet": "`mavgate fleet`",
}
"""The command that opens each socket."""

_CREDENTIALS: Final = struct.Struct("3i")
"""Linux `struct ucred`: process, user, group."""
Handler = Callable[..., Awaitable[object] | object]
Verbs = Mapping[str, Handler]
"""Handlers by verb, which is words joined by dots.

A handler takes the verb's parameters by their names and annotated types. It returns, or awaits,
JSON, a msgspec structure or a dataclass; it refuses by ControlError, ValueError or OSError.
"""
SOCKETS: Final = Path("/proc/self/net/unix")
ACCEPTS: Final = "00010000"
"""The flag of a socket that accepts connections, see proc_net(5)."""


class ControlError(UserError):
    """A request was refused, or there is no gateway to send it to; the text gives the reason."""


class _Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    verb: str
    params: dict[str, Any] = {}


class _Answer(msgspec.Struct, frozen=True):
    ok: bool
    result: Any = None
    error: str = ""


class ControlServer:
    """Answer requests on a Unix socket.

    Parameters
    ----------
    path : Path
        Where the socket is created; if another gateway listens there, with the next number.
    *tables : Verbs
        The verbs, in addition to `verbs`, which lists them.
    """

    def __init__(self, path: Path, *tables: Verbs) -> None:
        self.path = path
        self._for_group = "RUNTIME_DIRECTORY" in os.environ
        self._socket: socket.socket | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._writers: dict[asyncio.StreamWriter, bool] = {}
        """Open connections, and whether each waits for a request; the one waiting longest first."""
        self._verbs = {
            verb: (_parameters_of(handler), handler)
            for table in ({"verbs": self._list}, *tables)
            for verb, handler in table.items()
        }

    async def start(self) -> None:
        """Create the socket and listen.

        Raises ControlError if the socket cannot be created, or `MAX_GATEWAYS` run already.
        """
        check_length(self.path)
        try:
            self.path.parent.mkdir(mode=FOLDER_RIGHTS, parents=True, exist_ok=True)
            self.path = _first_free(self.path)
            self._socket = self._bound()
        except OSError as error:
            raise ControlError(f"control socket {self.path}: {error.strerror}") from error
        # Imported here and below: clients do not need it, and it takes half of a command's start.
        from gateway.hub.transports.sockets import accept_each

        accept_each(self._socket, self._on_connection, self._report)

    def close(self) -> None:
        """Stop listening and end all connections."""
        if self._socket is None:
            return
        import asyncio

        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()
        self._socket = None
        for writer in self._writers:
            writer.close()
        self.path.unlink(missing_ok=True)

    async def answer(self, line: bytes) -> bytes:
        """Answer one line by one line; both end with a line feed."""
        return msgspec.json.encode(await self._answer(line), enc_hook=_plain) + b"\n"

    async def _answer(self, line: bytes) -> _Answer:
        try:
            request = msgspec.json.decode(line, type=_Request)
            kind, handler = self._find(request.verb)
            result = handler(**msgspec.structs.asdict(msgspec.convert(request.params, kind)))
            if isinstance(result, Awaitable):
                result = await result
        except (ControlError, msgspec.DecodeError, ValueError, OSError) as error:
            return _Answer(ok=False, error=str(error))
        except RecursionError:
            return _Answer(ok=False, error="the request is nested too deeply")
        return _Answer(ok=True, result=result)

    def _find(self, verb: str) -> tuple[type[msgspec.Struct], Handler]:
        if verb not in self._verbs:
            raise ControlError(f"no such verb: {verb}; there are {', '.join(self._list())}")
        return self._verbs[verb]

    def _list(self) -> list[str]:
        return sorted(self._verbs)

    def _bound(self) -> socket.socket:
        sock = socket.socket(socket.AF_UNIX)
        try:
            sock.setblocking(False)
            sock.bind(str(self.path))
            self.path.chmod(SERVICE_SOCKET_RIGHTS if self._for_group else SOCKET_RIGHTS)
            sock.listen(BACKLOG)
        except OSError:
            sock.close()
            raise
        return sock

    def _report(self, error: OSError | None) -> None:
        if error is not None:
            log.warning("control socket: %s; it is tried again", error.strerror)

    def _on_connection(self, connection: socket.socket, _: object) -> None:
        import asyncio

        connection.setblocking(False)
        task = asyncio.get_running_loop().create_task(self._serve(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        import asyncio

        reader, writer = await asyncio.open_unix_connection(sock=connection, limit=MAX_LINE)
        # A connection that is accepted just before `close` arrives here after it.
        if self._socket is None or not self._is_allowed(writer) or not self._has_room():
            writer.close()
            return
        try:
            while line := await self._next_line(reader, writer):
                writer.write(await self.answer(line))
                await writer.drain()
        except (ConnectionError, ValueError, TimeoutError):
            # The client has gone, is idle, or sent a line beyond the limit.
            log.debug("Control connection ended early")
        finally:
            self._writers.pop(writer, None)
            writer.close()

    async def _next_line(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        import asyncio

        self._writers.pop(writer, None)
        self._writers[writer] = True
        async with asyncio.timeout(IDLE_S):
            line = await reader.readline()
        if writer in self._writers:
            self._writers[writer] = False
        return line

    def _has_room(self) -> bool:
        """Return whether there is room, after closing an idle connection if needed."""
        if len(self._writers) >= MAX_CONNECTIONS:
            idle = next((writer for writer, waits in self._writers.items() if waits), None)
            if idle is None:
                return False
            del self._writers[idle]
            idle.transport.abort()
        return True

    def _is_allowed(self, writer: asyncio.StreamWriter) -> bool:
        """Check the peer's user; the folder's mode alone may be too permissive."""
        user, groups = peer_of(writer)
        is_member = self._for_group and os.getgid() in groups
        return user in (0, os.getuid()) or is_member


def _parameters_of(handler: Handler) -> type[msgspec.Struct]:
    """Make the structure that checks a request from a handler's parameters."""
    fields: list[Any] = [
        (each.name, each.annotation)
        if each.default is each.empty
        else (each.name, each.annotation, each.default)
        for each in signature(handler, eval_str=True).parameters.values()
    ]
    return msgspec.defstruct("Parameters", fields, frozen=True, forbid_unknown_fields=True)


def peer_of(writer: asyncio.StreamWriter) -> tuple[int, tuple[int, ...]]:
    """Return the peer's user id and group ids, from the kernel."""
    link = writer.get_extra_info("socket")
    data = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, group = _CREDENTIALS.unpack(data)
    try:
        groups = os.getgrouplist(pwd.getpwuid(user).pw_name, group)
    except KeyError:
        groups = [group]
    return user, tuple(groups)


def numbered(path: Path) -> list[Path]:
    """List the socket paths of one user's gateways."""
    others = [path.with_stem(f"{path.stem}-{n}") for n in range(2, MAX_GATEWAYS + 1)]
    return [path, *others]


def _first_free(path: Path) -> Path:
    """Find a free path, and remove the socket of a killed gateway; never that of a live one."""
    for candidate in numbered(path):
        if not candidate.is_socket():
            return candidate
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(candidate))
            except ConnectionRefusedError:
                candidate.unlink(missing_ok=True)
                return candidate
    raise ControlError(f"control socket {path}: {MAX_GATEWAYS} gateways listen there already")


def check_length(path: Path) -> None:
    """Check that a path is short enough for a socket; raises ControlError if not."""
    size = len(os.fsencode(path))
    if size > MAX_PATH:
        raise ControlError(
            f"control socket {path}: the path has {size} bytes, and a socket's at most {MAX_PATH}; "
            "let XDG_RUNTIME_DIR name a shorter folder"
        )


def socket_path(name: str) -> Path:
    """Return where the socket of `run`, `play` or `fleet` is created.

    It is in the folder that systemd created for a service, in the user's runtime folder, or in the
    state folder if there is none.
    """
    if service := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(service.split(":")[0]) / f"{name}.sock"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser()
    return (Path(runtime) if runtime else state) / "mavgate" / f"{name}.sock"


def request(
    path: Path, verb: str, params: dict[str, Any] | None = None, *, timeout_s: float | None = None
) -> Any:
    """Send a request to the gateway at a socket, and return its result, decoded from JSON.

    Raises ControlError if no gateway listens, none answers in time, or the request is refused.
    """
    check_length(path)
    line = msgspec.json.encode({"verb": verb, "params": params or {}}) + b"\n"
    try:
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(timeout_s or REQUEST_TIMEOUT_S)
            link.connect(str(path))
            link.sendall(line)
            with link.makefile("rb") as lines:
                answer = msgspec.json.decode(lines.readline(), type=_Answer)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise ControlError(f"nobody listens at the socket {path}") from error
    except (OSError, msgspec.DecodeError) as error:
        raise ControlError(f"no answer on {path}: {error}") from error
    if not answer.ok:
        raise ControlError(answer.error)
    return answer.result


def _plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    raise NotImplementedError(f"{type(value).__name__} is not JSON")


def find_socket(name: str) -> Path:
    """Find the socket of the user's own `run`, `play` or `fleet`, or else of the system service.

    Raises ControlError if none runs, several do, or the running one denies access.
    """
    own = live_sockets(name)
    if len(own) > 1:
        listed = ", ".join(map(str, own))
        raise ControlError(f"several run: choose one by --socket or MAVGATE_SOCKET: {listed}")
    if own:
        return own[0]
    service = SERVICE_FOLDER / f"{name}.sock"
    if service in _listening():
        if os.access(service, os.W_OK):
            return service
        text = f"the service's socket {service} is for the group {GROUP}: "
        raise ControlError(text + f"`sudo usermod -aG {GROUP} $USER`, then log in again")
    starter = STARTERS[name]
    raise ControlError(f"nothing runs here: start {starter} first (no socket {socket_path(name)})")


def live_sockets(name: str) -> list[Path]:
    """List the sockets of this user on which a process listens."""
    listening = _listening()
    return [path for path in numbered(socket_path(name)) if path in listening]


def all_sockets() -> list[Path]:
    """List the live sockets of this user and of the system service."""
    services = (SERVICE_FOLDER / f"{name}.sock" for name in STARTERS)
    own = [path for name in STARTERS for path in live_sockets(name)]
    return [*dict.fromkeys([*own, *_listening().intersection(services)])]


def _listening() -> set[Path]:
    """Read the listening sockets from the kernel; trying each would open a connection."""
    lines = SOCKETS.read_text(encoding="utf-8", errors="replace").splitlines()[1:]
    found = (line.split(maxsplit=7) for line in lines)
    return {Path(words[7]) for words in found if len(words) == 8 and words[3] == ACCEPTS}
