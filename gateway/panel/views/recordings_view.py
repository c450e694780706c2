"""View 4: recordings, and a flight that is played again."""

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from gateway.batch.catalogue import Row
from gateway.panel.access import RECORDINGS
from gateway.panel.playback import SPEEDS, Playback, Profile
from gateway.panel.recording_files import FORMATS, RecordingFacts
from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.widgets import (
    Cells,
    DataTable,
    RecorderControls,
    RowButton,
    UploadButton,
    asking,
    closing,
    confirm,
    heading,
    notify_failure,
    ongoing,
)
from gateway.printable import printable
from gateway.recordings.index import delete_recording, list_recordings

REFRESH_S: Final = 1.0
IDLE: Final = "idle"
POSITION_S: Final = 0.25
MUCH_LOST: Final = 0.05
"""A share of lost samples that a pilot should see."""
FACTS: Final = ("Duration", "Distance", "Height", "Loss")


class TimeSlider(Element, component=WEB / "time_slider.js"):
    """A slider through a recording; emits `seek` with seconds since its start."""


class RecordingsView:
    """The view's elements."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._playback = context.playback
        self._facts = RecordingFacts()
        with ui.element("div").classes("cards one"):
            self._player = ui.element("div").classes("card padded").props("data-role=player")
            with self._player:
                self._build_player()
            with ui.element("div").classes("card padded"):
                RecorderControls(context)
            with ui.element("div").classes("card padded"):
                with ui.element("div").classes("line"):
                    heading("Recordings").classes("spring")
                    self._search = ui.input(placeholder="Name, or duration > 300 and loss > 0.05")
                    self._search.props('dense outlined clearable aria-label="Search recordings"')
                    if context.may_change:
                        upload = UploadButton(
                            context, RECORDINGS, ".tlog,.csv",
                            label="Upload…", title="Upload a recording",
                        )  # fmt: skip
                        upload.on("uploaded", self.refresh)
                self._trouble = ui.label().classes("soft")
                self._table = DataTable(
                    ("Name", "Last written (UTC)", "Size", "Files", *FACTS),
                    "Nothing was recorded yet.",
                    buttons=self._buttons(),
                )
        context.every(REFRESH_S, self.refresh)
        context.every(POSITION_S, self._show_position)

    def _buttons(self) -> list[RowButton]:
        buttons = [RowButton("play_arrow", "Open", self._open)]
        buttons += [RowButton("download", "Download", self._download)]
        buttons += [RowButton("share", "Export", self._ask_export)]
        if self._context.may_change:
            buttons += [RowButton("delete", "Delete", self._ask_delete)]
        return buttons

    def _build_player(self) -> None:
        with ui.element("div").classes("line"):
            self._title = ui.label().classes("title spring")
            self._fused_again = ui.switch("fused again next to it", on_change=self._on_fused_again)
            close = ui.button(icon="close", on_click=partial(self._play, self._playback.close))
            close.props('flat round dense aria-label="Close the recording"')
        self._slider = TimeSlider()
        self._slider.on("seek", self._on_seek)
        with ui.element("div").classes("line"):
            toggle = partial(self._play, self._playback.toggle)
            self._toggle = ui.button(icon="pause", on_click=toggle)
            self._toggle.props('round dense aria-label="Play or pause"')
            for icon, to, title in (("replay_10", "-10", "Back"), ("forward_10", "+10", "Ahead")):
                seek = partial(self._play, self._playback.order, "seek", to=to)
                button = ui.button(icon=icon, on_click=seek)
                button.props("flat round dense").props["aria-label"] = f"{title} ten seconds"
            self._speed = ui.select(
                {speed: f"{speed:g}×" for speed in SPEEDS}, value=1, on_change=self._on_speed
            )
            self._speed.props('dense borderless options-dense aria-label="Speed"').classes("short")
            ui.label("space plays and pauses").classes("soft hint")
        self._player.set_visibility(False)

    async def refresh(self) -> None:
        """Show the folder."""
        parts = self._context.parts
        facts, search = self._facts, (self._search.value or "").strip()
        folder = self._context.parts.recordings_folder
        # Querying a catalogue of thousands would block the page too long.
        await asyncio.to_thread(facts.look, folder, search)
        self._trouble.set_text(facts.trouble)
        recordings = list_recordings(folder)
        recorder = parts.watch.recorder
        if recorder is None or recorder["state"] == IDLE:
            parts.jobs.index(folder, recordings)
        if parts.jobs.is_indexing:
            self._trouble.set_text("Indexing the recordings …")
        self._trouble.set_visibility(
            bool(recordings) and bool(facts.trouble or parts.jobs.is_indexing)
        )
        shown = [entry for entry in reversed(recordings) if facts.shows(entry.name, search)]
        self._table.show(
            {
                entry.name: _row(entry, facts.of(entry.name), facts.track(entry.name))
                for entry in shown
            }
        )

    def _show_position(self) -> None:
        playback, status = self._playback, self._playback.status
        self._player.set_visibility(status is not None)
        if status is None:
            return
        self._title.set_text(printable(playback.name))
        self._fused_again.set_value(playback.has_fused_again)
        playing = status["state"] == "playing"
        self._toggle.props["icon"] = "pause" if playing else "play_arrow"
        new = {
            "curves": _curves_of(playback, self._context.system_id),
            "duration": status["duration_s"],
            "position": round(status["position_s"], 2),
            "playing": playing,
            "speed": status["speed"] or SPEEDS[-1],
        }
        for key, value in new.items():
            if self._slider.props.get(key) != value:
                self._slider.props[key] = value

    def _ask_delete(self, name: str) -> None:
        confirm(f"Delete the recording {name} for ever?", "Delete", partial(self._delete, name))

    async def _delete(self, name: str) -> None:
        context = self._context
        with notify_failure(context):
            context.check_may_change()
            if context.parts.watch.recorder is None:
                delete_recording(context.parts.recordings_folder, name)
            else:
                await context.ask("record.delete", name=name)
            ui.notify(f"{printable(name)} is deleted", type="positive")
            await self.refresh()

    def _download(self, name: str) -> None:
        ui.download.from_url(f"/recordings/{quote(name)}")

    def _ask_export(self, name: str) -> None:
        with asking(f"Export {name}") as dialog:
            for kind, (label, _, _) in FORMATS.items():
                export = closing(dialog, partial(self._export, name, kind))
                ui.button(label, on_click=export).props("no-caps outline")

    async def _export(self, name: str, kind: str) -> None:
        parts = self._context.parts
        text = f"{name}: making {FORMATS[kind][0]} …"
        with notify_failure(self._context), ongoing(text):
            url = await parts.jobs.export(parts.recordings_folder, name, kind)
            ui.download.from_url(url)

    async def _open(self, name: str, *, fused_again: bool = False) -> None:
        folder = self._context.parts.recordings_folder
        with ongoing(f"Opening {name} …"):
            await self._play(self._playback.open, folder, name, fused_again=fused_again)
        if self._playback.status is not None:
            # The new player does not know the speed that was chosen for another.
            self._speed.set_value(1)

    async def _on_fused_again(self, event: Any) -> None:
        if self._playback.name and event.value != self._playback.has_fused_again:
            await self._open(self._playback.name, fused_again=event.value)

    async def _play(self, act: Callable[..., Any], *args: Any, **params: Any) -> None:
        """Change the playback, and show its state."""
        with notify_failure(self._context):
            self._context.check_may_change()
            if (answer := act(*args, **params)) is not None:
                await answer
            self._show_position()

    async def _on_seek(self, event: GenericEventArguments) -> None:
        await self._play(self._playback.order, "seek", to=f"{float(event.args):.2f}")

    async def _on_speed(self, event: Any) -> None:
        await self._play(self._playback.order, "play.speed", speed=float(event.value))


def _curves_of(playback: Playback, system_id: int | None) -> list[Profile]:
    """Return the heights of all played aircraft, those of the selected one first."""
    order = sorted(playback.aircraft, key=lambda key: (key != system_id, key))
    return [playback.aircraft[key].profile for key in order]


def _row(recording: Any, facts: Row | None, track: str) -> Cells:
    when = datetime.fromtimestamp(recording.modified_s, UTC)
    kinds = sorted({Path(file).suffix.lstrip(".") for file in recording.files})
    return (
        (recording.name, "", "", track),
        f"{when:%Y-%m-%d %H:%M:%S}",
        f"{recording.size / 1e6:.2f} MB",
        f"{len(recording.files)} {'+'.join(kinds)}",
        *_facts_cells(facts),
    )


def _facts_cells(facts: Row | None) -> Cells:
    """Return the catalogue's cells; blank where unknown."""
    if facts is None:
        return ("",) * len(FACTS)
    if facts["error"] is not None:
        return (("broken", "bad"), "", "", "")
    duration, distance, highest, loss = (
        facts[key] for key in ("duration", "distance", "highest", "loss")
    )
    return (
        "" if duration is None else str(timedelta(seconds=round(duration))),
        "" if distance is None else f"{distance / 1000.0:.2f} km",
        "" if highest is None else f"{highest:.0f} m",
        ("" if loss is None else f"{loss:.1%}", "warn" if (loss or 0.0) > MUCH_LOST else ""),
    )
