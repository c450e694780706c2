"""Options of commands: the settings file, and the running gateway that is asked.

The settings import every stage, and with them NumPy: a command that never reads them must not wait
for that, so they are imported where they are read.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar, cast

import typer

from gateway.cli.support.terminal import refuse
from gateway.live.control_socket import ControlError, find_socket, live_sockets, request

if TYPE_CHECKING:
    from gateway.aircraft import AircraftSettings
    from gateway.config import GatewaySettings
    from gateway.pipeline import PipelineSettings
    from gateway.recordings.reading import ReadOptions

USER_CONFIG: Final = Path("~/.config/mavgate/gateway.toml")

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help=f"Settings file; by default gateway.toml in {USER_CONFIG.parent}."
    ),
]


def load_settings(file: Path | None) -> GatewaySettings:
    """Load the given settings, the user's own, or the defaults."""
    from gateway.config import GatewaySettings, load

    if file is None:
        file = USER_CONFIG.expanduser()
        if not file.exists():
            return GatewaySettings()
    return load(file)


def or_refuse(read: Callable[[], GatewaySettings]) -> GatewaySettings:
    """Read settings at the start of a command, which ends if they are wrong."""
    from gateway.config import ConfigError

    try:
        return read()
    except ConfigError as error:
        refuse(str(error))


def read_settings(file: Path | None) -> GatewaySettings:
    """Load the settings; end the command if they are wrong."""
    return or_refuse(lambda: load_settings(file))


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings in these settings."""
    return Path(settings.recording.folder).expanduser()


def read_aircraft(settings: GatewaySettings) -> dict[int, AircraftSettings]:
    """Load the settings of single aircraft."""
    from gateway.config import ConfigError, load_aircraft

    try:
        return load_aircraft(settings)
    except ConfigError as error:
        refuse(str(error))


def read_options(settings: GatewaySettings, **how: Any) -> ReadOptions:
    """Return how flights are read: the limits of the settings, and further fields by name."""
    from gateway.recordings.reading import ReadOptions

    current = pipeline_settings(settings)
    return ReadOptions(current, unpacked_limit=settings.recording.unpacked_limit, **how)


def pipeline_settings(settings: GatewaySettings) -> PipelineSettings:
    """Return the pipeline's settings, the single aircraft's files included."""
    from gateway.pipeline import PipelineSettings

    return PipelineSettings(settings.default_aircraft, read_aircraft(settings))


SocketOption = Annotated[
    Path | None,
    typer.Option(
        "--socket",
        envvar="MAVGATE_SOCKET",
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
    """Send a request to the running gateway (or player); end the command if that fails."""
    try:
        return request(socket_of(of), verb, params, timeout_s=wait_s)
    except ControlError as error:
        refuse(str(error))


def socket_of(of: str) -> Path:
    """Return the selected gateway's socket; end the command if there is none."""
    try:
        return _named.get() or find_socket(of)
    except ControlError as error:
        refuse(str(error))


def is_running() -> bool:
    """Return whether a gateway of this user runs."""
    return _named.get() is not None or bool(live_sockets("run"))


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
