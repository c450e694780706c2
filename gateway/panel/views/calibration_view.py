"""View 5: each sensor calibrated step by step; storing needs a confirmation."""

import math
from functools import partial
from typing import Any, Final

from nicegui import ui
from nicegui.element import Element

from gateway.geometry.angle import wrap_180
from gateway.panel.state.calibration import (
    CELLS,
    ORIENTATIONS,
    SIDE_NAMES,
    CalibrationRun,
    RunState,
)
from gateway.panel.state.fields import FloatArray, parameter_unit
from gateway.panel.state.parameters import ListState
from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.widgets import DataTable, allow, choice, heading, store_parameters
from gateway.printable import UNKNOWN, figure, printable
from gateway.sensing.calibrating import CalibrationStep

REFRESH_S: Final = 0.2
MIN_CELLS: Final = 60
MNT_NAMES: Final = tuple(f"CAL_MNT_{axis}" for axis in ("ROLL", "PIT", "YAW"))
MAG_MNT_NAMES: Final = tuple(f"CAL_MAG_MNT_{axis}" for axis in ("ROLL", "PIT", "YAW"))
ANGLE_DEG: Final = 3.0
"""Maximum difference of angles: that of a level calibration on top of an orientation."""
MEASURED: Final = "another one, as measured"
GUIDE: Final = {
    CalibrationStep.MOUNTING: "When: first of all, and when the board was turned. Any other angle "
    "is measured by the command mavgate calibrate mounting, some degrees by Level. Good: raising "
    "the nose raises the pitch, and lowering the right wing raises the roll.",
    CalibrationStep.GYRO: "When: before the first flight, and when the temperature has changed by "
    "more than 10 °C. Good: a rate at rest below 0.1 °/s.",
    CalibrationStep.ACCEL: "When: once for each board. Good: an error of gravity over the six "
    "sides below 0.05 m/s².",
    CalibrationStep.LEVEL: "When: the board was mounted or moved in the aircraft, after the "
    "accelerometer. Good: a tilt when level below 0.5°.",
    CalibrationStep.MAG: "When: anything of steel or a power wire was moved, or in another region. "
    "Good: a spread of the field's strength below 1.5 µT.",
}
TITLES: Final = {
    CalibrationStep.MOUNTING: ("Mounting", "developer_board", "how the board lies"),
    CalibrationStep.GYRO: ("Gyroscope", "360", "leave it at rest, 3 s"),
    CalibrationStep.ACCEL: ("Accelerometer", "view_in_ar", "six positions"),
    CalibrationStep.LEVEL: ("Level", "horizontal_rule", "as it flies, at rest, 3 s"),
    CalibrationStep.MAG: ("Magnetometer", "explore", "turn it about all axes"),
}
INSTRUCTIONS: Final = {
    CalibrationStep.GYRO: "Lay the aircraft down and do not touch it until this is done.",
    CalibrationStep.ACCEL: "Rest it on each of its six sides in turn, for two seconds each, in any "
    "order. A wall or a box helps; small tilts do no harm.",
    CalibrationStep.LEVEL: "Set the aircraft as it flies straight and level, and let go of it.",
    CalibrationStep.MAG: "Away from steel, turn it slowly about all its axes, upside down too, "
    "until the sphere is covered.",
}


class FieldSphere(Element, component=WEB / "field_sphere.js"):
    """The magnetometer's samples on a sphere that can be turned, with uncovered directions."""

    def __init__(self) -> None:
        super().__init__()
        self._props["cells"] = CELLS.round(4).tolist()

    def show(self, points: FloatArray, seen: list[bool]) -> None:
        """Show samples in radii from the sphere's centre, shape (n, 3), and the seen cells."""
        rounded: Any = points.round(3).tolist()
        self.run_method("show", rounded, seen)


class CalibrationView:
    """The steps on the left, the guide to one of them on the right."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._step = CalibrationStep.MOUNTING
        self._drawn: object = None
        self._choice: ui.select
        self._outcomes: dict[CalibrationStep, tuple[str, str]] = {}
        with ui.element("div").classes("calibration"):
            with ui.element("div").classes("steps"):
                self._steps = {step: self._build_step(step) for step in TITLES}
            self._guide = ui.element("div").classes("card guide")
        self._context.on_select(self._on_select)
        self._context.every(REFRESH_S, self._refresh)
        self._refresh()

    def _run(self) -> CalibrationRun | None:
        run = self._context.dialogue.calibration
        return run if run is not None and run.step is self._step else None

    def _on_select(self) -> None:
        self._outcomes.clear()
        self._drawn = None
        self._refresh()

    def _refresh(self) -> None:
        """Show the present state; the guide is built again for another step or another run."""
        run, dialogue = self._run(), self._context.dialogue
        dialogue.load()
        if run is not None and run.state.is_over:
            done = run.state is RunState.DONE
            self._outcomes[run.step] = ("done", "good") if done else ("failed", "bad")
        ready = dialogue.parameters.state is ListState.COMPLETE
        for step, (card, state) in self._steps.items():
            card.props.set_optional("aria-current", "step" if step is self._step else None)
            outcome, look = self._outcomes.get(step, ("", ""))
            state.classes(look, replace="state").set_text(outcome)
        # Not for each state of a run, since replaced buttons would lose clicks and the focus.
        if (self._step, run) != self._drawn:
            self._drawn = (self._step, run)
            self._build_guide()
        if self._step is CalibrationStep.MOUNTING:
            self._refresh_mounting(ready=ready)
        else:
            self._refresh_guide(run, ready=ready)

    def _build_step(self, step: CalibrationStep) -> tuple[ui.element, ui.label]:
        """Build the button of a step, once: a replaced one would lose clicks and the focus."""
        title, icon, short = TITLES[step]
        with ui.element("button").classes("card step") as card:
            ui.icon(icon)
            with ui.element("b"):
                ui.label(title)
            state = ui.label()
            ui.label(short).classes("soft")
        card.on("click", partial(self._show, step))
        return card, state

    def _show(self, step: CalibrationStep) -> None:
        run = self._context.dialogue.calibration
        if run is not None and not run.state.is_over and step is not run.step:
            ui.notify(f"{TITLES[run.step][0]}: cancel it first", type="warning")
            return
        self._step = step
        self._refresh()

    def _build_guide(self) -> None:
        self._guide.clear()
        with self._guide:
            heading(TITLES[self._step][0])
            if self._step is CalibrationStep.MOUNTING:
                self._build_mounting()
            else:
                self._now = ui.label()
                self._progress = ui.linear_progress(0.0, show_value=False)
                self._progress.props('aria-label="Progress" instant-feedback')
                if self._step is CalibrationStep.ACCEL:
                    self._build_poses()
                if self._step is CalibrationStep.MAG:
                    self._build_cloud()
                with ui.element("div").classes("buttons"):
                    self._buttons = {
                        "cancel": _button("Cancel", None, self._cancel, quiet=True),
                        "store": _button("Store it", "save", self._store),
                        "undo": _button("Undo it", "undo", self._undo, quiet=True),
                        "start": _button("Start", "play_arrow", self._start),
                    }
                self._residuals = DataTable(("", "before", "after")).classes("residuals")
                self._residuals.set_visibility(False)
            ui.label(GUIDE[self._step]).classes("soft guide-note")

    def _refresh_guide(self, run: CalibrationRun | None, *, ready: bool) -> None:
        runs = run is not None and not run.state.is_over
        done = run is not None and run.state is RunState.DONE
        look = "good" if done else "" if run is None or runs else "bad"
        self._now.classes(look, replace="now").set_text(self._instruction(run, ready=ready))
        self._progress.set_visibility(runs)
        for name, shown in (("cancel", runs), ("store", done), ("undo", done), ("start", not runs)):
            self._buttons[name].set_visibility(shown)
        start = self._buttons["start"]
        allow(start, self._why_not(ready=ready))
        start.set_text("Start" if run is None else "Again")
        start.classes("" if run is None else "quiet")
        if run is not None:
            self._move(run)
            if done and not self._residuals.visible:
                self._show_residuals(run)
        self._residuals.set_visibility(done)

    def _build_mounting(self) -> None:
        ui.label(
            "Choose how the board lies in the aircraft, seen from above. Its x arrow is printed "
            "next to the chips; both the IMU and the compass are set."
        ).classes("now")
        self._pictures = {}
        with ui.element("div").classes("poses four"):
            for number, (name, (roll_deg, pitch_deg, yaw_deg)) in enumerate(ORIENTATIONS.items()):
                with ui.element("button").classes("pose pick") as card:
                    card.props["title"] = f"Choose {name}"
                    picture = ui.element("img").classes("pose-picture")
                    picture.props["src"] = f"/web/mounting.svg#way{number}"
                    # Empty, because the name below it has the same text.
                    picture.props["alt"] = ""
                    ui.label(name)
                    angles = f"roll {roll_deg:.0f}°, pitch {pitch_deg:.0f}°, yaw {yaw_deg:.0f}°"
                    ui.label(angles).classes("soft")
                card.on("click", partial(self._choose, name))
                self._pictures[name] = card
        self._choice = choice("Orientation of the board", [*ORIENTATIONS, MEASURED], None)
        with ui.element("div").classes("buttons"):
            self._buttons = {
                "use": _button("Use it", "check", self._mount),
                "store": _button("Store it", "save", self._store, quiet=True),
            }

    def _choose(self, name: str) -> None:
        self._choice.set_value(name)
        self._refresh()

    def _refresh_mounting(self, *, ready: bool) -> None:
        # Set only once: a refresh must not change a choice that is not applied yet.
        if ready and self._choice.value is None:
            self._choice.set_value(self._orientation())
        for name, card in self._pictures.items():
            pressed = "true" if name == self._choice.value else "false"
            if card.props.get("aria-pressed") != pressed:
                card.props["aria-pressed"] = pressed
        for button in self._buttons.values():
            allow(button, self._why_not(ready=ready))

    def _orientation(self) -> str:
        entries = self._context.dialogue.parameters.entries
        now = [entries[name].value for name in MNT_NAMES if name in entries]
        near = (
            name
            for name, angles in ORIENTATIONS.items()
            if len(now) == len(angles)
            and all(
                abs(wrap_180(have - want)) < ANGLE_DEG
                for have, want in zip(now, angles, strict=True)
            )
        )
        return next(near, MEASURED)

    def _mount(self) -> None:
        """Set the angles of both sensors, in use until the gateway ends."""
        self._context.check_may_change()
        angles, dialogue = ORIENTATIONS.get(self._choice.value), self._context.dialogue
        if angles is None:
            ui.notify("Choose an orientation first", type="warning")
            return
        for names in (MNT_NAMES, MAG_MNT_NAMES):
            for name, angle_deg in zip(names, angles, strict=True):
                dialogue.change(name, angle_deg)
        self._outcomes[self._step] = ("in use", "good")
        ui.notify(
            "In use until the gateway ends. Raise the nose: the pitch must rise.", type="info"
        )

    def _why_not(self, *, ready: bool) -> str:
        """Return the reason why no calibration is possible now; empty if it is."""
        return self._context.why_fixed or ("" if ready else "The parameters are being read.")

    def _instruction(self, run: CalibrationRun | None, *, ready: bool) -> str:
        vehicle = self._context.vehicle
        if vehicle is None:
            return "No aircraft is received."
        if not vehicle.is_live:
            return "This aircraft is played from a recording. Choose a live one to calibrate it."
        if run is None or run.state is RunState.ASKED:
            waits = "" if ready else " Reading the parameters first, so that it can be undone …"
            return INSTRUCTIONS[self._step] + waits
        if run.state is RunState.FAILED:
            return f"Not calibrated: {printable(run.trouble)}. Nothing has changed; try again."
        if run.state is RunState.CHECKING:
            return "Done. Measuring the remaining error; leave it as it is for a moment."
        if run.state is RunState.DONE:
            return "Calibrated, and in use until the gateway ends. Store it?"
        return INSTRUCTIONS[self._step]

    def _build_poses(self) -> None:
        self._poses = {}
        with ui.element("div").classes("poses"):
            for side, name in SIDE_NAMES.items():
                with ui.element("div").classes("pose") as pose:
                    pose.props["data-side"] = side
                    picture = ui.element("img").classes("pose-picture")
                    picture.props["src"] = f"/web/poses.svg#{side}"
                    picture.props["alt"] = f"Aircraft {name}"
                    ui.label(name)
                    state = ui.label("still to do").classes("state")
                self._poses[side] = (pose, state)

    def _build_cloud(self) -> None:
        self._sent = -1
        with ui.element("div").classes("cloud"):
            self._sphere = FieldSphere()
            self._figures = {}
            with ui.element("dl").classes("figures"):
                for name in ("Samples", "Directions seen", "Centre (hard iron)", "Strength"):
                    with ui.element("dt"):
                        ui.label(name)
                    with ui.element("dd"):
                        self._figures[name] = ui.label()

    def _show_residuals(self, run: CalibrationRun) -> None:
        found = [(f"{r.name} ({r.unit})", r.before, r.after) for r in run.residuals()]
        metas = self._context.dialogue.metas
        for name, (old, new) in self._changes().items():
            meta = metas.get(name)
            factor, unit = parameter_unit(meta.unit if meta else "")
            words = f"{meta.short} ({unit}), {name}" if meta else name
            found.append((words, old * factor, new * factor))
        self._residuals.show(
            {name: (name, figure(old, ".4g"), figure(new, ".4g")) for name, old, new in found}
        )

    def _changes(self) -> dict[str, tuple[float, float]]:
        dialogue = self._context.dialogue
        entries = dialogue.parameters.entries
        return {
            name: (old, entries[name].value)
            for name, old in dialogue.before.items()
            if name in entries and entries[name].value != old
        }

    def _move(self, run: CalibrationRun) -> None:
        self._progress.set_value(run.progress / 100.0)
        if run.step is CalibrationStep.ACCEL:
            for side, (pose, state) in self._poses.items():
                done = side in run.sides_done
                now = side == run.side_now and not done and run.state is RunState.RUNNING
                look = "done" if done else "now" if now else ""
                pose.classes(look, replace="pose")
                state.set_text("done ✓" if done else "hold still …" if now else "still to do")
        if run.step is CalibrationStep.MAG:
            self._move_cloud(run)

    def _move_cloud(self, run: CalibrationRun) -> None:
        points = run.field_points
        if len(points) == self._sent:
            return
        self._sent = len(points)
        (x, y, z), radius = run.sphere()
        seen = run.cover()
        if len(points) and math.isfinite(radius) and radius > 0.0:
            self._sphere.show((points - (x, y, z)) / radius, seen)
        left = len(seen) - sum(seen)
        enough = "well covered" if sum(seen) >= MIN_CELLS else f"{left} directions uncovered"
        centre = ", ".join(figure(value, ".1f") for value in (x, y, z))
        directions = f"{sum(seen)} of {len(seen)}, {enough}"
        texts = [str(len(points)), directions, f"{centre} µT", figure(radius, ".1f", "µT")]
        if not len(points):
            texts = [UNKNOWN] * len(texts)
        for label, text in zip(self._figures.values(), texts, strict=True):
            label.set_text(text)

    async def _start(self) -> None:
        self._context.check_may_change()
        if not self._has_other_unanswered():
            self._context.dialogue.calibrate(self._step)
            self._refresh()

    def _has_other_unanswered(self) -> bool:
        """Return, and show, whether another calibration is neither stored nor undone."""
        other = self._context.dialogue.unanswered
        if other is None or other is self._step:
            return False
        # Storing this one would store the other too.
        ui.notify(f"{TITLES[other][0]}: store it or undo it first", type="warning")
        return True

    async def _cancel(self) -> None:
        self._context.check_may_change()
        self._context.dialogue.cancel()

    async def _store(self) -> None:
        """Store it in the vehicle: this button is the confirmation."""
        if self._has_other_unanswered():
            return
        if await store_parameters(self._context, f"{TITLES[self._step][0]}: stored"):
            self._end()

    async def _undo(self) -> None:
        self._context.check_may_change()
        for name, (old, _) in self._changes().items():
            self._context.dialogue.change(name, old)
        self._outcomes.pop(self._step, None)
        ui.notify(f"{TITLES[self._step][0]}: as it was before", type="info")
        self._end(stored=False)

    def _end(self, *, stored: bool = True) -> None:
        self._context.dialogue.calibration = None
        if stored:
            self._outcomes[self._step] = ("stored", "good")
        self._refresh()


def _button(text: str, icon: str | None, act: Any, *, quiet: bool = False) -> ui.button:
    button = ui.button(text, icon=icon, on_click=act).props("no-caps unelevated")
    return button.classes("quiet" if quiet else "")
