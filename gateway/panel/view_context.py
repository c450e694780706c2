"""The context of every view: the aircraft, requests to the gateway, units, the role.

A view is a file in `gateway/panel/views/` with a class or function that is called with a
`ViewContext` and creates its NiceGUI elements, inside the tab's panel; `page.py` lists them. One
`ViewContext` belongs to one open page (browser tab).

Data of the aircraft reaches the screen in two ways:

*Moving displays* are drawn in the browser. The page opens one WebSocket (`telemetry_feed.py`), over
which it receives the `Instant` of every aircraft up to 30 times a second, and passes it to
`window.mavgate`:

    const stop = mavgate.subscribe((state) => { ... });   // state: newest Instant, by its names
    mavgate.state          the selected aircraft's newest, or null
    mavgate.vehicles       all, by system id
    mavgate.units          "metric" | "imperial" | "aviation"
    mavgate.show(quantity, value)   -> [text, unit]   quantity: "speed", "length", "climb", …

so a Vue component (a JavaScript file in `gateway/panel/web/`, a Python class next to the view with
`class Horizon(Element, component=WEB / "horizon.js")`) subscribes in `mounted()`, stops in
`unmounted()`, and draws in `requestAnimationFrame`; none of this data passes through NiceGUI.

*Everything else* (tables, texts, buttons) is NiceGUI: read `context.vehicle` in a callback of
`context.every(seconds, callback)`, which runs only while the view's tab is the one shown.

Colours and sizes are the CSS variables of `web/panel.css` (`--ink`, `--paper`, `--accent`, `--sky`,
…), which light and dark set; use no others.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from nicegui import ui

from gateway.clock import GatewayClock, unix_time_us
from gateway.panel.admission import Role
from gateway.panel.dialogues import Dialogue, Dialogues
from gateway.panel.logins import Logins
from gateway.panel.map_tiles import MapTiles
from gateway.panel.open_pages import OpenPages
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.playback import Playback
from gateway.panel.recording_jobs import RecordingJobs
from gateway.panel.state.commands import command_at, command_long
from gateway.panel.state.fields import FieldHistory
from gateway.panel.state.fleet import FleetState
from gateway.panel.state.vehicle import VehicleState
from gateway.panel.uplink import READING, ControlClient, GatewayWatch, Uplink
from gateway.vehicle.plan import Location

WEB: Final = Path(__file__).parent / "web"
"""The components' JavaScript and the style sheet."""


class NotAllowedError(Exception):
    """A viewer requested a change."""


@dataclass(frozen=True)
class PanelParts:
    """Parts shared by all pages."""

    settings: PanelSettings
    recordings: Path
    """Folder of the recordings, of a gateway that runs on this machine."""
    clock: GatewayClock
    fleet: FleetState
    control: ControlClient
    uplink: Uplink
    dialogues: Dialogues
    watch: GatewayWatch
    """The gateway's status, updated every second."""
    jobs: RecordingJobs
    tiles: MapTiles
    pages: OpenPages
    logins: Logins

    @property
    def recordings_folder(self) -> Path:
        """Folder of the recordings: the running gateway's, else that of the settings."""
        recorder = self.watch.recorder
        return self.recordings if recorder is None else Path(recorder["folder"])


@dataclass(eq=False)
class ViewContext:
    """One open page."""

    parts: PanelParts
    role: Role
    units: str
    """`metric`, `imperial` or `aviation`."""
    playback: Playback
    page: str
    shown: str = ""
    """Key of the view that is shown."""
    system_id: int | None = None
    building: str = ""
    """Key of the view that was built last."""
    _on_select: list[Callable[[], None]] = field(default_factory=list)

    @property
    def vehicles(self) -> dict[int, VehicleState]:
        """The aircraft that this page shows."""
        return self.parts.fleet.visible(self.page)

    @property
    def vehicle(self) -> VehicleState | None:
        """The selected aircraft; None before the first."""
        return None if self.system_id is None else self.parts.fleet.vehicles.get(self.system_id)

    @property
    def received(self) -> FieldHistory:
        """The received fields of the selected aircraft; empty before the first."""
        return FieldHistory() if self.vehicle is None else self.vehicle.received

    @property
    def dialogue(self) -> Dialogue:
        """The dialogue with the selected aircraft; before the first, one that sends nothing."""
        return self.parts.dialogues.of(self.system_id or 0)

    @property
    def is_playback(self) -> bool:
        """Whether the selected aircraft is played from a recording."""
        return self.vehicle is not None and not self.vehicle.is_live

    @property
    def why_fixed(self) -> str:
        """The reason why the user may not change the selected aircraft; empty if they may."""
        if not self.may_change:
            return "You are logged in as a viewer."
        if self.vehicle is None:
            return "No aircraft is received."
        return "This aircraft is played from a recording." if self.is_playback else ""

    @property
    def now_us(self) -> int:
        """Time of the panel's clock, to which all times here refer."""
        return self.parts.clock()

    @property
    def zero_unix_us(self) -> int:
        """Civil time of the zero of that clock, by the present system time."""
        return unix_time_us() - self.now_us

    @property
    def may_change(self) -> bool:
        """Whether the user may change things."""
        return self.role is Role.OPERATOR

    async def command(self, number: int, *params: float, at: Location | None = None) -> None:
        """Send a MAV_CMD to the selected aircraft, with parameters or with a location.

        Raises CommandFailedError if it is refused or not answered; NotAllowedError for a viewer.
        """
        self.check_may_change()
        target = (self.system_id or 0, number)
        message = command_long(*target, *params) if at is None else command_at(*target, at)
        await self.parts.uplink.command(message)

    async def ask(self, verb: str, **params: Any) -> Any:
        """Send a request to the gateway's control socket; see docs/control.md.

        Raises ControlError if there is no gateway, or it refuses; NotAllowedError for a viewer who
        requests a change.
        """
        if verb not in READING:
            self.check_may_change()
        return await self.parts.control.ask(verb, **params)

    def check_may_change(self) -> None:
        """Raise NotAllowedError for a viewer; hidden buttons do not prevent forged requests."""
        if not self.may_change:
            raise NotAllowedError("you are logged in as a viewer, with read-only access")

    def every(self, seconds: float, callback: Callable[[], Any]) -> None:
        """Call a function periodically while the view that is being built is shown."""
        key = self.building

        def tick() -> Any:
            return callback() if key in ("", self.shown) else None

        ui.timer(seconds, tick)

    def on_select(self, callback: Callable[[], None]) -> None:
        """Call a function whenever another aircraft is selected."""
        self._on_select.append(callback)

    def select(self, system_id: int | None) -> None:
        """Select another aircraft."""
        self.system_id = system_id
        for callback in self._on_select:
            callback()
