"""The estimators compared on the last minutes: overlaid curves, and figures."""

import math
from typing import Final

import numpy as np
from nicegui import ui

from gateway.clock import unix_time_us
from gateway.geometry.angle import wrap_180
from gateway.panel.estimator_trial import ComparisonError, Estimate, compare_apart
from gateway.panel.state.fields import FloatArray, IntArray
from gateway.panel.view_context import ViewContext
from gateway.panel.widgets.charts import StripChart
from gateway.panel.widgets.prompts import heading
from gateway.panel.widgets.table import DataTable
from gateway.reasons import reason_of

QUANTITIES: Final = {
    "roll_deg": ("Roll", "deg", "ATTITUDE.roll", math.degrees(1.0)),
    "pitch_deg": ("Pitch", "deg", "ATTITUDE.pitch", math.degrees(1.0)),
    "yaw_deg": ("Heading", "deg", "ATTITUDE.yaw", math.degrees(1.0)),
    "alt_amsl_m": ("Altitude", "m", "VFR_HUD.alt", 1.0),
}
"""Title, unit, and the aircraft's own field with its factor, by field of `Estimate`."""


class ComparisonCard:
    """A card, built at the current place of the page.

    Parameters
    ----------
    context : ViewContext
        The page.
    """

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._estimates: list[Estimate] = []
        with ui.element("div").classes("card").props("data-card=comparison"):
            with ui.element("div").classes("tools"):
                heading("Estimators on the last minutes")
                ui.element("div").classes("spring")
                titles = {key: title for key, (title, *_) in QUANTITIES.items()}
                self._quantity = ui.select(titles, value="roll_deg", on_change=self._draw)
                self._quantity.props('dense borderless options-dense aria-label="Compared"')
                self._button = ui.button("Compare", icon="compare", on_click=self._compare)
                self._button.props("no-caps unelevated dense")
            self._story = ui.label(
                "Fuses the sensor data of the last three minutes with every estimator, each "
                "with the present parameters."
            ).classes("soft")
            self._chart = StripChart().classes("strip")
            self._chart.set_visibility(False)
            self._table = DataTable(
                ("Estimator", "RMS difference from flight", "RMS distance to the GPS fixes")
            ).classes("residuals")
            self._table.set_visibility(False)

    async def _compare(self) -> None:
        context, system_id = self._context, self._context.system_id
        if system_id is None:
            return
        if context.may_change:
            context.parts.dialogues.ask_for_samples(system_id)
        parameters = context.parts.dialogues.of(system_id).parameters.entries
        values = {name: entry.value for name, entry in parameters.items()}
        self._button.disable()
        self._story.set_text("Fusing …")
        try:
            self._estimates = await compare_apart(context.parts.samples.frames(system_id), values)
        except ComparisonError as error:
            self._story.set_text(f"{error}. Samples are being collected; try again in a moment.")
            return
        except Exception as error:
            self._story.set_text(f"Cannot be compared: {reason_of(error)}.")
            raise
        finally:
            self._button.enable()
        seconds = np.ptp(self._estimates[0].time_us) / 1e6
        self._story.set_text(f"The last {seconds:.0f} s, and the aircraft's own estimate.")
        self._chart.set_visibility(True)
        self._draw()

    def _draw(self) -> None:
        if not self._estimates:
            return
        key = str(self._quantity.value)
        _, unit, field, factor = QUANTITIES[key]
        zero_us = unix_time_us() - self._context.now_us
        flown_us, flown = self._context.parts.history.series(self._context.system_id or 0, field)
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
                    (e.name, ""),
                    (f"{_rms_text(e, key, curves[-1])} {unit}", ""),
                    (f"{_figure(e.to_fixes_m)} m", ""),
                )
                for e in self._estimates
            }
        )


def _rms_text(estimate: Estimate, key: str, flown: tuple[str, IntArray, FloatArray]) -> str:
    _, flown_us, values = flown
    if not len(flown_us):
        return "—"
    rows = np.clip(np.searchsorted(flown_us, estimate.time_us), 0, len(flown_us) - 1)
    apart = getattr(estimate, key) - values[rows]
    if key.endswith("_deg"):
        apart = wrap_180(apart)
    known = apart[np.isfinite(apart)]
    return _figure(float(np.sqrt(np.mean(known**2)))) if len(known) else "—"


def _figure(value: float) -> str:
    return "—" if not math.isfinite(value) else f"{value:.2f}"
