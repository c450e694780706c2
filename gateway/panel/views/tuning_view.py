"""View 6: every parameter with its meaning, changed live, next to plots of its effect."""

from typing import Any, Final

from nicegui import ui
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.dialogues import Dialogue
from gateway.panel.state.parameters import ListState, ParameterMeta
from gateway.panel.uplink import CommandFailedError
from gateway.panel.view_context import ViewContext
from gateway.panel.widgets.charts import LiveChart
from gateway.panel.widgets.comparison import ComparisonCard
from gateway.panel.widgets.parameter_row import ParameterRow
from gateway.panel.widgets.prompts import heading
from gateway.printable import printable
from gateway.units import counted

REFRESH_S: Final = 0.25
MAX_ROWS: Final = 120
"""More would be confusing; the search finds the others."""
ALL: Final = "all groups"
STORE: Final = 1.0
"""PREFLIGHT_STORAGE_PARAMETER_ACTION: write."""

EFFECTS: Final = {
    "attitude": ("ATTITUDE.roll", "ATTITUDE.pitch"),
    "heading": ("ATTITUDE.yaw",),
    "height": ("VFR_HUD.alt", "VFR_HUD.climb"),
    "speed": ("VFR_HUD.groundspeed", "VFR_HUD.airspeed"),
    "rates": ("ATTITUDE.rollspeed", "ATTITUDE.pitchspeed", "ATTITUDE.yawspeed"),
    "acceleration": ("HIGHRES_IMU.xacc", "HIGHRES_IMU.yacc", "HIGHRES_IMU.zacc"),
    "field": ("HIGHRES_IMU.xmag", "HIGHRES_IMU.ymag", "HIGHRES_IMU.zmag"),
    "accuracy": ("ESTIMATOR_STATUS.pos_horiz_accuracy", "ESTIMATOR_STATUS.pos_vert_accuracy"),
}
"""Plots in which a change may show, by the label of the choice."""


def build(context: ViewContext) -> None:
    """Build the view."""
    _TuningView(context).build()


class _TuningView:
    """The parameters on the left, their effect on the right."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._rows: dict[str, ParameterRow] = {}
        self._grouped: object = None
        self._drawn: object = None
        self._asked: int | None = None

    def build(self) -> None:
        with ui.element("div").classes("tools"):
            self._search = ui.input(placeholder="Search: gps, cutoff, heading …")
            self._search.props('dense outlined clearable debounce=200 aria-label="Search"')
            self._search.classes("spring").on_value_change(self._draw)
            self._group = ui.select([ALL], value=ALL, on_change=self._draw)
            self._group.props('dense outlined options-dense aria-label="Group"')
            self._state = ui.label().classes("soft")
            store = ui.button("Store all", icon="save", on_click=self._store)
            store.props("no-caps unelevated dense").set_enabled(self._context.may_change)
            again = ui.button(icon="refresh", on_click=self._reload)
            again.props('flat round dense aria-label="Read all parameters again"')
        with ui.element("div").classes("tuning"):
            self._list = ui.element("div").classes("card settings")
            with ui.element("div").classes("effect"):
                self._build_effect()
        self._context.on_select(self._on_select)
        self._context.every(REFRESH_S, self._refresh)
        self._draw()
        self._refresh()

    @property
    def _dialogue(self) -> Dialogue | None:
        system_id = self._context.system_id
        return None if system_id is None else self._context.parts.dialogues.of(system_id)

    def _build_effect(self) -> None:
        with ui.element("div").classes("card"):
            with ui.element("div").classes("tools"):
                heading("Effect")
                ui.element("div").classes("spring")
                choice = ui.select(list(EFFECTS), value="attitude")
                choice.props('dense borderless options-dense aria-label="What is plotted"')
            self._chart = LiveChart(self._context, EFFECTS["attitude"])
            choice.on_value_change(lambda event: self._chart.choose(EFFECTS[event.value]))
        ComparisonCard(self._context)

    def _on_select(self) -> None:
        self._grouped = None
        self._group.set_value(ALL)
        self._draw()
        self._chart.reload()
        self._refresh()

    def _refresh(self) -> None:
        dialogue = self._dialogue
        if dialogue is None:
            self._state.set_text("")
            return
        system_id = dialogue.parameters.system_id
        if self._asked != system_id:
            self._asked = system_id
            self._context.parts.dialogues.load(system_id)
        self._chart.refresh()
        self._state.set_text(_state_of(dialogue))
        complete = dialogue.parameters.state is ListState.COMPLETE
        state = (system_id, len(dialogue.parameters.entries), len(dialogue.metas))
        if complete and state != self._grouped:
            self._grouped = state
            groups = sorted(
                {_group_of(name, dialogue.metas) for name in dialogue.parameters.entries}
            )
            options = {group: printable(group) for group in (ALL, *groups)}
            self._group.set_options(options, value=self._group.value)
            self._draw()
        for row in self._rows.values():
            row.refresh(dialogue)

    def _draw(self, _: Any = None) -> None:
        """Build the visible rows; leave them as they are, with what is typed, if none changes."""
        dialogue = self._dialogue
        names = [] if dialogue is None else self._wanted(dialogue)
        metas = {} if dialogue is None else {name: dialogue.metas.get(name) for name in names}
        known = 0 if dialogue is None else len(dialogue.parameters.entries)
        state = (self._context.system_id, known > 0, metas)
        if state == self._drawn:
            return
        self._drawn = state
        self._list.clear()
        self._rows = {}
        if dialogue is None:
            with self._list:
                ui.label("No aircraft is heard.").classes("empty")
            return
        last = ""
        with self._list:
            for name in names[:MAX_ROWS]:
                group = _group_of(name, dialogue.metas)
                if group != last:
                    last = group
                    ui.label(printable(group)).classes("group")
                meta = metas[name] or ParameterMeta(name=name)
                self._rows[name] = ParameterRow(self._context, dialogue, meta)
            if len(names) > MAX_ROWS:
                ui.label(f"{len(names) - MAX_ROWS} more; search for them").classes("empty")
            if not names:
                text = "No parameter matches." if known else "No parameters yet."
                ui.label(text).classes("empty")

    def _wanted(self, dialogue: Dialogue) -> list[str]:
        words = (self._search.value or "").casefold().split()
        found = []
        for name in dialogue.parameters.entries:
            group = _group_of(name, dialogue.metas)
            meta = dialogue.metas.get(name)
            text = f"{name} {group} {meta.short} {meta.long}" if meta else name
            if self._group.value in (ALL, group) and all(w in text.casefold() for w in words):
                found.append((group, name))
        return [name for _, name in sorted(found)]

    def _reload(self) -> None:
        if self._context.system_id is not None:
            self._context.parts.dialogues.load(self._context.system_id, reload=True)

    async def _store(self) -> None:
        try:
            await self._context.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, STORE)
        except CommandFailedError as error:
            ui.notify(f"Not stored: {error}", type="negative")
        else:
            ui.notify("All parameters are stored", type="positive")


def _group_of(name: str, metas: dict[str, ParameterMeta]) -> str:
    meta = metas.get(name)
    if meta is None or not meta.group:
        return name.partition("_")[0]
    if meta.category and meta.category != meta.group:
        return f"{meta.category} · {meta.group}"
    return meta.group


def _state_of(dialogue: Dialogue) -> str:
    parameters = dialogue.parameters
    match parameters.state:
        case ListState.LOADING:
            return f"reading {len(parameters.entries)} of {parameters.count or '…'}"
        case ListState.FAILED:
            return f"{counted(len(parameters.entries), 'parameter')}; the aircraft sends no more"
        case ListState.COMPLETE:
            return counted(len(parameters.entries), "parameter")
        case _:
            return ""
