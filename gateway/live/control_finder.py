"""Choose a command's control socket: the named one, the user's own, or the service's."""

import os
from pathlib import Path
from typing import Final

from gateway.live.control_socket import (
    GROUP,
    SERVICE_FOLDER,
    STARTERS,
    ControlError,
    numbered,
    socket_path,
)

SOCKETS: Final = Path("/proc/net/unix")
ACCEPTS: Final = "00010000"
"""The flag of a socket that takes connections, see proc_net(5)."""


def find_socket(name: str) -> Path:
    """Find the gateway or player that a command is for.

    Parameters
    ----------
    name : str
        `run` for the gateway, `play` for a player.

    Returns
    -------
    Path
        The user's own if one runs, otherwise the system service's.

    Raises
    ------
    ControlError
        If none runs, several do, or the running one denies access.
    """
    own = live_sockets(name)
    if len(own) > 1:
        listed = ", ".join(map(str, own))
        raise ControlError(f"several run: choose one by --socket: {listed}")
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


def _listening() -> set[Path]:
    """Read the listening sockets from the kernel; trying each would open a connection."""
    lines = SOCKETS.read_text(encoding="utf-8", errors="replace").splitlines()[1:]
    found = (line.split(maxsplit=7) for line in lines)
    return {Path(words[7]) for words in found if len(words) == 8 and words[3] == ACCEPTS}
