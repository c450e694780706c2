"""View 3: the receiver, its nodes, and the gateway's clients."""

from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import segno
from nicegui import ui

from gateway.hub.endpoint import is_loopback
from gateway.live.control_socket import ControlError
from gateway.panel.view_context import ViewContext
from gateway.panel.widgets import (
    Cells,
    DataTable,
    RowButton,
    allow,
    confirm,
    heading,
    notify_failure,
)
from gateway.printable import NO_RECEIVER, UNKNOWN, figure, printable, receiver_state
from gateway.records import NodeId, RadioState, board_name, channel_name
from gateway.units import US_PER_S, counted

REFRESH_S: Final = 1.0
SERIAL_S: Final = 2.0
NOT_CONFIGURED: Final = "No receiver is configured."
AUTO: Final = "find the receiver by its frames"
OPEN_BY_ADDRESS: Final = (
    "A phone cannot reach these URLs: open this page by this computer's address in the network"
)
LOOPBACK_ONLY: Final = (
    "Only this machine reaches the panel: a phone needs panel.address, a password, and a "
    "certificate or insecure = true"
)
SILENT_US: Final = 2 * US_PER_S
LOSS_WARN: Final = 5.0
LOSS_BAD: Final = 20.0
"""Loss of payloads, percent, above which the estimators mostly extrapolate."""

NEW_ENDPOINT: Final = "udp:192.168.1.7:14550, or a source: crsf:/dev/ttyUSB0"
CLIENT_COLUMNS: Final = (
    "Client", "State", "Sent", "Rate", "Dropped", "Received", "Round trip", "Heard", "Trust"
)  # fmt: skip
NODE_COLUMNS: Final = (
    "Node", "Rate", "Received", "Lost", "Loss", "Restarts", "Clock", "Age", "Chips"
)  # fmt: skip

Record = Mapping[str, Any]
_SHOWN: Final = ("HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT")


class LinkView:
    """The view's tables."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._was_shown = False
        with ui.element("div").classes("cards"):
            with ui.element("div").classes("card padded wide"):
                heading("Receiver")
                self._receiver = ui.label(UNKNOWN).classes("figure").props("data-role=receiver")
                if context.may_change:
                    self._build_serial()
                self._nodes = DataTable(NODE_COLUMNS, "No node was received.")
                self._nodes.props("data-role=nodes")
            with ui.element("div").classes("card padded wide"):
                heading("Sources")
                self._sources = DataTable(
                    ("Source", "State", "Records", "Newest", "Faults"), "No source is configured."
                ).props("data-role=sources")
            with ui.element("div").classes("card padded wide"):
                heading("Clients")
                self._build_clients()
            if context.may_change:
                self._build_push()
            with ui.element("div").classes("card padded"):
                heading("Listening")
                self._ports = DataTable(("Port", "State", "Clients", "Turned away"), "No port.")
            with ui.element("div").classes("card padded"):
                heading("Aircraft over MAVLink")
                self._vehicles = DataTable(
                    ("Aircraft", "Heartbeat", "Attitude", "Position", "Messages"),
                    "No aircraft was received.",
                )
        context.every(REFRESH_S, self.refresh)
        self.refresh()

    def _build_clients(self) -> None:
        may = self._context.may_change
        self._clients = DataTable(
            CLIENT_COLUMNS,
            "No client.",
            buttons=[RowButton("close", "Remove this client", self._ask_remove)] if may else (),
        )
        if may:
            with ui.element("div").classes("line"):
                self._url = ui.input(placeholder=NEW_ENDPOINT).props(
                    'dense outlined aria-label="Endpoint of a new client or source"'
                )
                ui.button("Add", on_click=self._add).props("no-caps")

    def _build_serial(self) -> None:
        """Build the choice of the receiver's port, which is hidden for a simulated one."""
        with ui.element("div").classes("line") as self._serial:
            self._port = ui.select({"auto": AUTO}, value="auto").classes("spring")
            self._port.props('dense outlined options-dense aria-label="Serial port"')
            ui.button("Connect", on_click=self._connect).props("no-caps")
            self._leave = ui.button("Disconnect", on_click=partial(self._ask, "serial.disconnect"))
            self._leave.props("no-caps outline")
        self._serial_reason = ui.label().classes("soft").props("data-role=serial")
        self._serial.set_visibility(False)
        self._context.every(SERIAL_S, self._refresh_serial)

    def _build_push(self) -> None:
        """Build the list of URLs to which a phone posts, which is hidden without such a source."""
        with ui.element("div").classes("card padded").props("data-role=push") as self._push:
            heading("Posts of a phone")
            request = ui.context.client.request
            self._base = str(request.base_url)
            if is_loopback(self._context.parts.settings.address):
                ui.label(f"{LOOPBACK_ONLY}.").classes("soft")
            elif is_loopback(request.url.hostname or ""):
                ui.label(f"{OPEN_BY_ADDRESS}.").classes("soft")
            self._push_urls = ui.element("div")
        self._push.set_visibility(False)
        self._pushed: Record = {}
        self._context.every(SERIAL_S, self._refresh_push)

    async def _refresh_push(self) -> None:
        try:
            sources = await self._context.ask("source.tokens")
        except ControlError:
            sources = {}
        self._push.set_visibility(bool(sources))
        if sources == self._pushed:
            return
        self._pushed = sources
        self._push_urls.clear()
        with self._push_urls:
            for token, name in sources.items():
                url = f"{self._base}push/{token}"
                ui.label(printable(f"{name}: {url}"))
                ui.image(segno.make(url).svg_data_uri(scale=4, light="#fff")).classes("w-48")

    async def _refresh_serial(self) -> None:
        try:
            status = await self._context.ask("serial.status")
        except ControlError:
            status = None
        self._show_serial(status)

    def _show_serial(self, status: Record | None) -> None:
        shown = status is not None and not status["is_fixed"]
        self._serial.set_visibility(shown)
        self._serial_reason.set_visibility(shown)
        if status is None:
            return
        options = {"auto": AUTO, status["wanted"]: status["wanted"]} | {
            port["device"]: printable(f"{port['device']}  {port['description']}")
            for port in status["ports"]
        }
        options["auto"] = AUTO
        if options != self._port.options:
            # A port that the user has selected stays selected while it exists.
            kept = self._port.value if self._was_shown else status["wanted"]
            self._port.set_options(options, value=kept if kept in options else "auto")
        self._was_shown = True
        allow(self._leave, "No port is connected." if status["state"] == "closed" else "")
        self._serial_reason.set_text(printable(_serial_line(status)))

    async def _ask(self, verb: str, **params: Any) -> bool:
        """Request a change and show its result; return whether it was carried out."""
        done = False
        with notify_failure(self._context):
            answer = await self._context.ask(verb, **params)
            done = True
            if verb.startswith("serial."):
                self._show_serial(answer)
            await self._context.parts.watch.refresh()
            self.refresh()
        return done

    async def _connect(self) -> None:
        await self._ask("serial.connect", port=self._port.value)

    async def _add(self) -> None:
        url = self._url.value
        if await self._ask("clients.add", url=url.strip()) and self._url.value == url:
            self._url.value = ""

    def _ask_remove(self, name: str) -> None:
        remove = partial(self._ask, "clients.remove", name=name)
        confirm(f"Remove the client {name}? It will receive no more data.", "Remove", remove)

    def refresh(self) -> None:
        """Show the newest status."""
        self._vehicles.show(self._vehicle_rows())
        watch = self._context.parts.watch
        status = watch.status
        if status is None:
            self._receiver.set_text("No gateway runs on this machine.")
            for table in (self._nodes, self._sources, self._clients, self._ports):
                table.show({})
            return
        self._receiver.set_text(_receiver_line(status))
        self._nodes.set_visibility(status["report"]["port"] != NO_RECEIVER)
        now_us = status["report"]["time_us"]
        boards = {_key_of(b): b for one in status["aircraft"] for b in one["boards"]}
        nodes = {_key_of(node): node for node in status["report"]["nodes"]}
        self._nodes.show(
            {key: _node_row(node, now_us, boards.get(key)) for key, node in nodes.items()}
        )
        self._sources.show(
            {source["url"]: _source_row(source, now_us) for source in status["report"]["sources"]}
        )
        former = watch.before or {"clients": (), "time_us": status["time_us"]}
        before = {client["client_id"]: client["sent"] for client in former["clients"]}
        span_s = (status["time_us"] - former["time_us"]) / US_PER_S
        self._clients.show(
            {
                client["name"]: _client_row(client, status["time_us"], before, span_s)
                for client in status["clients"]
            }
        )
        self._ports.show(
            {
                port["name"]: (
                    port["name"],
                    (port["reason"] or port["state"], "bad" if port["reason"] else "good"),
                    str(port["clients"]),
                    (str(port["turned_away"]), "warn" if port["turned_away"] else ""),
                )
                for port in status["listeners"]
            }
        )

    def _vehicle_rows(self) -> dict[str, Cells]:
        rows: dict[str, Cells] = {}
        for system_id, vehicle in sorted(self._context.vehicles.items()):
            ages = [self._age(vehicle.state.heard_us.get(name)) for name in _SHOWN]
            rows[str(system_id)] = (vehicle.title, *ages, str(len(vehicle.state.fields)))
        return rows

    def _age(self, heard_us: int | None) -> str | tuple[str, str]:
        if heard_us is None:
            return UNKNOWN
        age_us = self._context.now_us - heard_us
        return (f"{age_us / US_PER_S:.1f} s ago", "bad" if age_us > SILENT_US else "")


def _serial_line(status: Record) -> str:
    match status["state"]:
        case "open":
            return f"{status['device']} is open, until the gateway ends or another is connected"
        case "waiting":
            return status["reason"] or f"looking for the receiver on {status['wanted']}"
    return "disconnected: no data until a port is connected"


def _receiver_line(status: Record) -> str:
    report = status["report"]
    received = report["bytes_received"], report["frames"]
    if not receiver_state(report["port"], report["connected"], *received):
        return NOT_CONFIGURED
    parts = [
        f"{report['port']} {'connected' if report['connected'] else 'NOT CONNECTED'}",
        f"{counted(report['frames'], 'frame')}, {report['frames_lost']} lost on the line",
    ]
    if (receiver := report["receiver"]) is not None:
        parts.append(f"{channel_name(receiver['channel'])}, noise {receiver['noise_percent']} %")
        if problem := RadioState(receiver["radio"]).problem:
            parts.append(problem.upper())
    parts += [counted(count, f"{kind} fault") for kind, count in report["faults"]]
    return " · ".join(parts)


def _key_of(node: Record) -> str:
    return f"{node['node']['vehicle_id']}.{node['node']['node_id']}"


def _name_of(node: Record, board: Record | None) -> str:
    return board_name(NodeId(**node["node"]), board["sensors_present"] if board else 0)


def _node_row(node: Record, now_us: int, board: Record | None) -> Cells:
    total = node["received"] + node["lost"]
    loss = 100 * node["lost"] / total if total else 0.0
    age_us = max(0, now_us - node["last_time_us"])
    kind = "bad" if loss > LOSS_BAD else "warn" if loss > LOSS_WARN else ""
    rate = figure(node["rate_hz"], ".0f", "Hz")
    if (signal := node["signal"]) is not None:
        rate += f", {signal['rssi_dbm']} dBm, SNR {signal['snr_db']:.0f} dB"
    return (
        _name_of(node, board),
        rate,
        str(node["received"]),
        str(node["lost"]),
        (f"{loss:.2f} %", kind),
        (str(node["restarts"]), "warn" if node["restarts"] else ""),
        figure(node["clock_skew_ppm"], "+.0f", "ppm"),
        (f"{age_us / US_PER_S:.1f} s", "bad" if age_us > SILENT_US else "good"),
        ", ".join(board["chips"]) if board is not None else UNKNOWN,
    )


def _source_row(source: Record, now_us: int) -> Cells:
    age = UNKNOWN
    if source["last_time_us"] is not None:
        age = f"{max(0, now_us - source['last_time_us']) / US_PER_S:.1f} s ago"
    faults = ", ".join(f"{count} {kind}" for kind, count in source["faults"])
    state = ("connected", "good") if source["connected"] else (printable(source["reason"]), "bad")
    return (
        printable(source["url"]),
        state,
        str(source["records"]),
        age,
        (faults or "none", "warn" if faults else ""),
    )


def _client_row(client: Record, now_us: int, before: dict[int, int], span_s: float) -> Cells:
    sent_before = before.get(client["client_id"])
    rate = UNKNOWN
    if sent_before is not None and span_s > 0:
        rate = f"{(client['sent'] - sent_before) / span_s:.0f} Hz"
    heard_us, trip_us = client["heard_us"], client["round_trip_us"]
    # A client that has not answered yet is no fault: the panel's own is one for a second.
    kind = {"open": "good", "unproven": ""}.get(client["state"], "bad")
    heard = "never" if heard_us is None else f"{(now_us - heard_us) / US_PER_S:.0f} s ago"
    trust = "may change" if client["trusted"] else "may look"
    if not client["receives"]:
        # An output.
        heard = trust = UNKNOWN
    return (
        client["name"],
        (client["reason"] or client["state"], kind),
        str(client["sent"]),
        rate,
        (str(client["dropped"]), "warn" if client["dropped"] else ""),
        str(client["received"]),
        figure(trip_us and trip_us / 1000, ".1f", "ms"),
        heard,
        trust,
    )
