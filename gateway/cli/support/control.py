"""The running gateway, player or fleet that a command asks, and its option `--socket`."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar, cast

import typer

from gateway.cli.support.options import folder_of, read_settings
from gateway.live.control_socket import find_socket, live_sockets, request

SOCKET_VARIABLE: Final = "MAVGATE_SOCKET"
SocketOption = Annotated[
    Path | None,
    typer.Option(
        "--socket",
        envvar=SOCKET_VARIABLE,
        help="Control socket of the gateway, if several run.",
    ),
]
Command = TypeVar("Command", bound=Callable[..., object])

_named: ContextVar[Path | None] = ContextVar("socket", default=None)


def ask(
    verb: str,
    params: dict[str, Any] | None = None,
    *,
    of: str = "run",
    wait_s: float | None = None,
) -> Any:
    """Send a request to the running gateway, or player."""
    return request(socket_of(of), verb, params, timeout_s=wait_s)


def socket_of(of: str) -> Path:
    """Return the selected gateway's socket; raises ControlError if there is none."""
    return _chosen() or find_socket(of)


def is_running() -> bool:
    """Return whether a gateway of this user runs."""
    return _chosen() is not None or bool(live_sockets("run"))


def _chosen() -> Path | None:
    """Return the socket that the user has chosen, for commands without `--socket` too."""
    named = _named.get() or os.environ.get(SOCKET_VARIABLE)
    return Path(named) if named else None


def recordings_folder(config: Path | None) -> Path:
    """Return the folder of recordings: the running gateway's, unless settings are given."""
    if config is None and is_running():
        return Path(ask("record.status")["folder"])
    return folder_of(read_settings(config))


class AskingTyper(typer.Typer):
    """A group whose commands all have the option `--socket`."""

    def command(self, *args: Any, **named: Any) -> Callable[[Command], Command]:
        """Add a command; see `with_socket`."""
        register = super().command(*args, **named)

        def add(function: Command) -> Command:
            register(with_socket(function))
            return function

        return add


def with_socket(function: Command) -> Command:
    """Give a command the option `--socket`, which selects the gateway for `ask`."""
    own = inspect.signature(function)
    option = inspect.Parameter(
        "socket", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=SocketOption
    )

    @functools.wraps(function)
    def asking(*args: Any, socket: Path | None, **named: Any) -> object:
        token = _named.set(socket)
        try:
            return function(*args, **named)
        finally:
            _named.reset(token)

    asking.__signature__ = own.replace(  # type: ignore[attr-defined]
        parameters=[*own.parameters.values(), option]
    )
    return cast(Command, asking)
