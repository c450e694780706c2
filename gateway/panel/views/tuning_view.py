"""View 6: every parameter with its meaning, changed live, next to plots of its effect.

A card compares the estimators on the last minutes: overlaid curves, and figures.
"""

import math
from typing import Any, Final

import numpy as np
from nicegui import ui

from gateway.analysis.metrics import rms
from gateway.geometry.angle import wrap_180
from gateway.panel import widgets
from gateway.panel.dialogues import Dialogue
from gateway.panel.estimator_trial import (
    LEAST_HZ,
    LEAST_S,
    ComparisonError,
    Estimate,
    compare_apart,
)
from gateway.panel.state.fields import FloatArray, IntArray, parameter_unit
from gateway.panel.state.parameters import ListState, ParameterMeta, is_same_value
from gateway.panel.view_context import NotAllowedError, ViewContext
from gateway.printable import figure, printable, reason_of
from gateway.units import counted

QUANTITIES: Final = {
    "roll_deg": ("Roll", "°", "ATTITUDE.roll", math.degrees(1.0)),
    "pitch_deg": ("Pitch", "°", "ATTITUDE.pitch", math.degrees(1.0)),
    "yaw_deg": ("Heading", "°", "ATTITUDE.yaw", math.degrees(1.0)),
    "alt_amsl_m": ("Altitude", "m", "VFR_HUD.alt", 1.0),
}
"""Title, unit, and the aircraft's field with its factor, by field of `Estimate`."""
REFRESH_S: Final = 0.25
MAX_ROWS: Final = 120
"""Maximum rows, since more would be confusing; the search finds the others."""
ALL: Final = "all groups"
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
"""Plots that may show the effect of a change, by the label of the choice."""


class ParameterRow:
    """A row, built at the current position in the page."""

    def __init__(self, context: ViewContext, dialogue: Dialogue, meta: ParameterMeta) -> None:
        self._context = context
        self._meta = meta
        self._system_id = dialogue.parameters.system_id
        self._shown: object = None
        self._factor, self._unit = parameter_unit(meta.unit)
        value = self._in_shown_unit(dialogue.parameters.entries[meta.name].value)
        self._settled: float | None = value
        """Value of the field while it is not being edited."""
        self.has_focus = False
        with ui.element("div").classes("parameter") as self._row:
            self._row.props["data-name"] = meta.name
            with ui.element("div"):
                meaning = ui.label(printable(meta.short)).classes("meaning")
                meaning.tooltip(printable(meta.long or meta.short))
                ui.label(printable(meta.name)).classes("name")
                ui.label(printable(range_of(meta))).classes("range")
                self._trouble = ui.label().classes("trouble").props("role=alert")
            self._field = self._build_field(value)
        self.refresh(dialogue)

    def refresh(self, dialogue: Dialogue) -> None:
        """Show the aircraft's present value."""
        name, parameters = self._meta.name, dialogue.parameters
        value, trouble = parameters.entries[name].value, parameters.refused.get(name, "")
        pending = name in parameters.pending
        changed = math.isfinite(self._meta.default) and not is_same_value(value, self._meta.default)
        value = self._in_shown_unit(value)
        if (value, trouble, pending) == self._shown:
            return
        self._shown = (value, trouble, pending)
        self._trouble.set_text("waiting for the answer …" if pending else printable(trouble))
        self._trouble.set_visibility(bool(trouble) or pending)
        self._row.classes(add="changed" if changed else "", remove="" if changed else "changed")
        if pending:
            return
        # Text that is typed and not sent yet stays; an equal value is not written again.
        settled = self._settled
        is_shown = settled is not None and is_same_value(settled, value)
        if self._field.value == settled and not is_shown:
            self._settled = value
            self._field.set_value(value)

    def _in_shown_unit(self, value: float) -> float:
        # Rounded to the digits of a 32-bit float: further ones come from the conversion.
        return value if self._factor == 1.0 else float(f"{value * self._factor:.7g}")

    def _build_field(self, value: float) -> Any:
        field: Any
        meta, may = self._meta, self._context.may_change
        if meta.choices:
            options = {each.value: printable(each.description) for each in meta.choices}
            options.setdefault(value, f"{value:g}")
            field = ui.select(options, value=value, on_change=lambda e: self._set(e.value))
            field.props("dense outlined options-dense")
        else:
            field = ui.number(value=value, suffix=printable(self._unit), format="%.7g")
            field.props("dense outlined step=any hide-bottom-space")
            # Only a finished value is sent, not each typed digit.
            field.on("keydown.enter", lambda: self._set(field.value))
            field.on("blur", lambda: self._set(field.value))
        field.on("focus", lambda: setattr(self, "has_focus", True))
        field.on("blur", lambda: setattr(self, "has_focus", False))
        field.props["aria-label"] = meta.name
        field.set_enabled(may)
        return field

    def _set(self, value: float | None) -> None:
        self._settled = value
        if value is None:
            return
        name, dialogue = self._meta.name, self._context.parts.dialogues.of(self._system_id)
        parameters = dialogue.parameters
        kept = self._in_shown_unit(parameters.entries[name].value)
        if name not in parameters.pending and is_same_value(value, kept):
            return
        try:
            self._context.check_may_change()
            dialogue.change(name, float(value) / self._factor)
        except (ValueError, NotAllowedError) as error:
            ui.notify(printable(str(error)), type="negative")
            return
        self._shown = None


def range_of(meta: ParameterMeta) -> str:
    """Describe the range, unit and default of a parameter."""
    parts = []
    factor, unit = parameter_unit(meta.unit)
    # Adding zero removes the sign of a negative zero.
    low, high, default = (v * factor + 0.0 for v in (meta.low, meta.high, meta.default))
    if math.isfinite(low) or math.isfinite(high):
        ends = [f"{end:.5g}" if math.isfinite(end) else "any" for end in (low, high)]
        parts.append(f"{' to '.join(ends)} {unit}".strip())
    elif unit:
        parts.append(unit)
    if math.isfinite(default):
        words = (each.description for each in meta.choices if each.value == meta.default)
        parts.append(f"default {next(words, '') or f'{default:.5g}'}")
    return " · ".join(parts)


class ComparisonCard:
    """A card, built at the current position in the page."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._estimates: list[Estimate] = []
        self._is_fusing = False
        with ui.element("div").classes("card").props("data-card=comparison"):
            with ui.element("div").classes("tools"):
                widgets.heading("Estimators on the last minutes")
                ui.element("div").classes("spring")
                titles = {key: title for key, (title, *_) in QUANTITIES.items()}
                self._quantity = ui.select(titles, value="roll_deg", on_change=self._draw)
                self._quantity.props('dense borderless options-dense aria-label="Compared"')
                self._button = ui.button("Compare", icon="compare", on_click=self._compare)
                self._button.props("no-caps unelevated dense")
            self._summary = ui.label(
                "Fuses the sensor data of the last three minutes with every estimator, each "
                "with the present parameters."
            ).classes("soft")
            self._collecting = ui.label().classes("figure").props("role=status")
            self._chart = widgets.StripChart().classes("strip")
            self._chart.set_visibility(False)
            self._table = widgets.DataTable(
                ("Estimator", "RMS difference from flight", "RMS distance to the GPS fixes")
            ).classes("residuals")
            self._table.set_visibility(False)
        context.on_select(self._collect)
        context.every(1.0, self._refresh)
        self._collect()
        self._refresh()

    def _collect(self) -> None:
        """Request the samples when the view is opened, before they are needed."""
        if self._context.may_change:
            self._context.dialogue.ask_for_samples()

    def _refresh(self) -> None:
        vehicle = self._context.vehicle
        share = 0.0 if vehicle is None else vehicle.samples.collected(LEAST_S, LEAST_HZ)
        reason = "" if share >= 1.0 else f"Collecting samples: {share:.0%}"
        widgets.allow(self._button, "The samples are being fused." if self._is_fusing else reason)
        self._collecting.set_text(reason)
        self._collecting.set_visibility(bool(reason))

    async def _compare(self) -> None:
        if (vehicle := self._context.vehicle) is None:
            return
        values = self._context.dialogue.parameters.values
        self._is_fusing = True
        self._refresh()
        self._summary.set_text("Fusing …")
        try:
            self._estimates = await compare_apart([*vehicle.samples.frames], values)
        except ComparisonError as error:
            self._summary.set_text(f"Cannot be compared: {error}.")
            return
        except Exception as error:
            self._summary.set_text(f"Cannot be compared: {reason_of(error)}.")
            raise
        finally:
            self._is_fusing = False
            self._refresh()
        seconds = np.ptp(self._estimates[0].time_us) / 1e6
        self._summary.set_text(f"The last {seconds:.0f} s, and the aircraft's own estimate.")
        self._chart.set_visibility(True)
        self._draw()

    def _draw(self) -> None:
        if not self._estimates:
            return
        key = str(self._quantity.value)
        _, unit, field, factor = QUANTITIES[key]
        zero_us = self._context.zero_unix_us
        flown_us, flown = self._context.received.series(field)
        begin_us, end_us = self._estimates[0].time_us[[0, -1]]
        inside = (flown_us >= begin_us) & (flown_us <= end_us)
        curves: list[tuple[str, IntArray, FloatArray]] = [
            (e.name, e.time_us, np.asarray(getattr(e, key))) for e in self._estimates
        ]
        curves.append(("as flown", flown_us[inside], flown[inside] * factor))
        self._chart.set_fields(
            [(name, unit) for name, _, _ in curves],
            [((time_us + zero_us) // 1000, values) for _, time_us, values in curves],
            (int(end_us) + zero_us) / 1000,
        )
        self._chart.set_window(max(int((end_us - begin_us) // 1_000_000), 1))
        self._chart.pause(paused=True)
        self._table.set_visibility(True)
        self._table.show(
            {
                e.name: (
                    e.name,
                    figure(_rms(e, key, curves[-1]), ".2f", unit),
                    figure(e.to_fixes_m, ".2f", "m"),
                )
                for e in self._estimates
            }
        )


def _rms(estimate: Estimate, key: str, flown: tuple[str, IntArray, FloatArray]) -> float:
    """Return the RMS difference of an estimate from the flown values; NaN without any."""
    _, flown_us, values = flown
    if not len(flown_us):
        return math.nan
    rows = np.clip(np.searchsorted(flown_us, estimate.time_us), 0, len(flown_us) - 1)
    apart = getattr(estimate, key) - values[rows]
    if key.endswith("_deg"):
        apart = wrap_180(apart)
    return rms(apart)


class TuningView:
    """The parameters on the left, their effect on the right."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._rows: dict[str, ParameterRow] = {}
        self._grouped: object = None
        self._drawn: object = None
        self._loaded_id: int | None = None
        with ui.element("div").classes("tools"):
            self._search = ui.input(placeholder="Search: gps, cutoff, heading …")
            self._search.props('dense outlined clearable debounce=200 aria-label="Search"')
            self._search.classes("spring").on_value_change(self._draw)
            self._group = widgets.choice("Group", [ALL], ALL, self._draw)
            self._state = ui.label().classes("soft")
            self._button = ui.button("Store all", icon="save", on_click=self._store)
            self._button.props("no-caps unelevated dense")
            widgets.icon_button("refresh", "Read all parameters again", self._reload)
        with ui.element("div").classes("tuning"):
            self._list = ui.element("div").classes("card settings")
            with ui.element("div").classes("effect"):
                self._build_effect()
        self._context.on_select(self._on_select)
        self._context.every(REFRESH_S, self._refresh)
        self._draw()
        self._refresh()

    def _build_effect(self) -> None:
        with ui.element("div").classes("card"):
            with ui.element("div").classes("tools"):
                widgets.heading("Effect")
                ui.element("div").classes("spring")
                effect = ui.select(list(EFFECTS), value="attitude")
                effect.props('dense borderless options-dense aria-label="What is plotted"')
            self._chart = widgets.LiveChart(self._context, EFFECTS["attitude"])
            effect.on_value_change(lambda event: self._chart.choose(EFFECTS[event.value]))
        ComparisonCard(self._context)

    def _on_select(self) -> None:
        self._grouped = None
        self._group.set_value(ALL)
        self._draw()
        self._chart.reload()
        self._refresh()

    def _refresh(self) -> None:
        widgets.allow(self._button, self._context.why_fixed)
        dialogue = self._context.dialogue
        if not (system_id := dialogue.parameters.system_id):
            self._state.set_text("")
            return
        if self._loaded_id != system_id:
            self._loaded_id = system_id
            dialogue.load()
        self._chart.refresh()
        self._state.set_text(_state_of(dialogue))
        complete = dialogue.parameters.state is ListState.COMPLETE
        state = (system_id, len(dialogue.parameters.entries), len(dialogue.metas))
        # Not while a field is edited, which would lose its text and the focus.
        is_edited = any(row.has_focus for row in self._rows.values())
        if complete and state != self._grouped and not is_edited:
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
        """Build the visible rows; keep the present ones, with typed text, if they are the same."""
        dialogue = self._context.dialogue
        names, known = self._wanted(dialogue), len(dialogue.parameters.entries)
        metas = {name: dialogue.metas.get(name) for name in names}
        state = (self._context.system_id, known > 0, metas)
        if state == self._drawn:
            return
        self._drawn = state
        self._list.clear()
        self._rows = {}
        if self._context.system_id is None:
            with self._list:
                ui.label("No aircraft is received.").classes("empty")
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
        self._context.dialogue.load(again=True)

    async def _store(self) -> None:
        await widgets.store_parameters(self._context, "All parameters are stored")


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
