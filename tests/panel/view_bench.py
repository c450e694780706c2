"""A page without a browser: its views on the gateway's vehicle, with answers that the test sets."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from nicegui import ElementFilter, background_tasks, core, ui
from nicegui.testing.user_interaction import UserInteraction

from gateway.live.control_socket import ControlError
from gateway.panel.admission import Role
from gateway.panel.dialogues import Dialogues
from gateway.panel.logins import Logins
from gateway.panel.map_tiles import MapTiles
from gateway.panel.open_pages import OpenPages
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.playback import Playback
from gateway.panel.recording_jobs import RecordingJobs
from gateway.panel.state.fleet import FleetState
from gateway.panel.uplink import CommandFailedError, GatewayWatch
from gateway.panel.view_context import PanelParts, ViewContext
from tests.kit.process import START_LIMIT_S
from tests.kit.vehicle_bench import VehicleBench


class ViewBench:
    """The context of a page on which vehicle 1 is selected; build views with it.

    It stands for the panel's uplink and control socket too: it keeps commands and requests.
    """

    def __init__(self, folder: Path, role: Role = Role.OPERATOR) -> None:
        self.commands: list[Any] = []
        self.refusal = ""
        """Reason for which commands are refused."""
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.answers: dict[str, Any] = {}
        """Answers of the gateway by verb; it refuses the others."""
        self.is_local = True
        self._outgoing: list[Any] = []
        self._ticks: list[Callable[[], Any]] = []
        self.vehicle = VehicleBench(self)
        fleet = FleetState()
        settings = PanelSettings(tiles_folder=str(folder / "tiles"), map_styles=())
        us: Any = self
        self.parts = PanelParts(
            settings, folder, us.now_us, fleet, us, us,
            Dialogues(fleet, self._outgoing.append, us.now_us), GatewayWatch(us, fleet),
            RecordingJobs(), MapTiles(settings), OpenPages(), Logins("", ""),
        )  # fmt: skip
        self.playback = Playback(us, fleet, "page")
        self.context = ViewContext(self.parts, role, "metric", self.playback, "page", system_id=1)
        us.context.every = lambda _, tick: self._ticks.append(tick)

    def now_us(self) -> int:
        return self.vehicle.now_us

    def handle(self, message: Any, now_us: int) -> list[Any]:
        """Handle a message of the vehicle; return the panel's."""
        self.parts.fleet.update(message, now_us)
        return self._taken()

    def poll(self, now_us: int) -> list[Any]:
        self.parts.dialogues.of(1).poll()
        return self._taken()

    def _taken(self) -> list[Any]:
        taken = self._outgoing[:]
        self._outgoing.clear()
        return taken

    async def command(self, message: Any) -> None:
        if self.refusal:
            raise CommandFailedError(self.refusal)
        self.commands.append(message)

    async def ask(self, verb: str, **params: Any) -> Any:
        self.asked.append((verb, params))
        if verb not in self.answers:
            raise ControlError(f"no {verb}")
        return self.answers[verb]

    def fly(self, seconds: float = 0.1, **sensors: Any) -> None:
        """Let the time pass, and refresh the views."""
        self.vehicle.hold(seconds, **sensors)
        self.refresh()

    def refresh(self) -> None:
        for tick in self._ticks:
            result = tick()
            if asyncio.iscoroutine(result):
                asyncio.run(result)


def emit(element: ui.element, kind: str = "click", arguments: Any = None) -> None:
    """Emit an event as the browser does, and wait until its handlers have ended."""

    async def handle() -> None:
        core.loop = asyncio.get_running_loop()
        user: Any = SimpleNamespace(client=element.client)
        UserInteraction(user, {element}, None).trigger(kind, arguments)
        async with asyncio.timeout(START_LIMIT_S):
            await asyncio.gather(*background_tasks.running_tasks, return_exceptions=True)
        core.loop = None

    asyncio.run(handle())


def texts(kind: type[Any] = ui.label) -> list[str]:
    return [element.text for element in ElementFilter(kind=kind) if element.visible]


def named(name: str, kind: type[Any] = ui.button) -> Any:
    """Return the newest element with a text, or with a label for screen readers."""
    found = [
        each
        for each in ElementFilter(kind=kind)
        if name
        in (getattr(each, "text", ""), each.props.get("aria-label"), each.props.get("label"))
    ]
    assert found, (name, texts(kind) if kind is ui.button else "")
    return found[-1]


def press(name: str) -> None:
    button = named(name)
    assert button.enabled, (name, button.props.get("title"))
    emit(button)
