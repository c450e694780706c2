"""View 4: recordings."""

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Final
from urllib.parse import quote

from nicegui import ui

from gateway.batch.catalogue import FlightFigures
from gateway.panel import widgets
from gateway.panel.access import RECORDINGS
from gateway.panel.player_bar import open_playback
from gateway.panel.recording_jobs import CUTS, EXTRACTS, FORMATS, KINDS, ExportError, Order
from gateway.panel.recording_search import RecordingFacts
from gateway.panel.view_context import ViewContext
from gateway.printable import figure, printable
from gateway.recordings.index import Recording, delete_recording, list_recordings
from gateway.recordings.moment import parse_moment
from gateway.units import counted

REFRESH_S: Final = 1.0
MUCH_LOST: Final = 0.05
"""Share of lost samples above which the loss is highlighted."""
ARMED_OPTIONS: Final = ("--armed", "--margin=10")
FACTS: Final = ("Duration", "Distance", "Height", "Loss")


class RecordingsView:
    """The view's elements."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._facts = RecordingFacts()
        with ui.element("div").classes("cards one"):
            with ui.element("div").classes("card padded live-only"):
                widgets.RecorderControls(context)
            with ui.element("div").classes("card padded"):
                with ui.element("div").classes("line"):
                    widgets.heading("Recordings").classes("spring")
                    self._search = ui.input(placeholder="Name, or duration > 300 and loss > 0.05")
                    self._search.props('dense outlined clearable aria-label="Search recordings"')
                    if context.may_change:
                        upload = widgets.UploadButton(
                            context, RECORDINGS, ".tlog,.csv",
                            label="Upload…", title="Upload a recording",
                        )  # fmt: skip
                        upload.on("uploaded", self.refresh)
                self._trouble = ui.label().classes("soft")
                self._table = widgets.DataTable(
                    ("Name", "Last written (UTC)", "Size", "Files", *FACTS),
                    "Nothing was recorded yet.",
                    buttons=self._buttons(),
                )
        context.every(REFRESH_S, self.refresh)

    def _buttons(self) -> list[widgets.RowButton]:
        buttons = [widgets.RowButton("play_arrow", "Open", self._open)]
        buttons += [widgets.RowButton("download", "Download", self._download)]
        buttons += [widgets.RowButton("share", "Export", self._ask_export)]
        if self._context.may_change:
            buttons += [widgets.RowButton("content_cut", "Cut or extract", self._ask_part)]
            buttons += [widgets.RowButton("delete", "Delete", self._ask_delete)]
        return buttons

    async def refresh(self) -> None:
        """Show the folder."""
        parts = self._context.parts
        facts, search = self._facts, (self._search.value or "").strip()
        folder = self._context.parts.recordings_folder
        # In a thread: querying a catalogue of thousands would block the page too long.
        await asyncio.to_thread(facts.look, folder, search)
        self._trouble.set_text(facts.trouble)
        recordings = list_recordings(folder)
        recorder = parts.watch.recorder
        if recorder is None or recorder["state"] == widgets.IDLE:
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

    def _ask_delete(self, name: str) -> None:
        widgets.confirm(
            f"Delete the recording {name} permanently?", "Delete", partial(self._delete, name)
        )

    async def _delete(self, name: str) -> None:
        context = self._context
        with widgets.notify_failure(context):
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
        with widgets.asking(f"Export {name}") as dialog:
            for kind, (label, _, _) in FORMATS.items():
                export = widgets.close_and(dialog, partial(self._export, name, kind))
                ui.button(label, on_click=export).props("no-caps outline")

    def _ask_part(self, name: str) -> None:
        """Ask for a part of a recording: a cut or anonymised tlog, or an extract."""
        with widgets.asking(f"Cut or extract {name}") as dialog:
            with ui.element("div").classes("line"):
                begin = ui.input("From", placeholder="1:20").props("dense outlined")
                end = ui.input("To", placeholder="2026-06-11T14:25:30Z").props("dense outlined")
            armed = ui.checkbox("Only while armed, and 10 s before and after")

            def cut_options() -> tuple[str, ...]:
                limits = (("--from", begin.value), ("--to", end.value))
                given = [(option, text) for option, text in limits if text]
                try:
                    for _, text in given:
                        parse_moment(text)
                except ValueError as error:
                    raise ExportError(str(error)) from error
                found = tuple(f"{option}={text}" for option, text in given)
                return found + (ARMED_OPTIONS if armed.value else ())

            for kind, (label, *_) in CUTS.items():
                make = widgets.close_and(dialog, partial(self._make_part, name, kind, cut_options))
                ui.button(label, on_click=make).props("no-caps outline")
            number = ui.number("Vehicle", min=1, max=255, precision=0)
            number.props("dense outlined")

            def extract_options() -> tuple[str, ...]:
                return () if number.value is None else (f"--system={int(number.value)}",)

            for kind, (label, *_) in EXTRACTS.items():
                make = widgets.close_and(
                    dialog, partial(self._make_part, name, kind, extract_options)
                )
                ui.button(label, on_click=make).props("no-caps outline")

    async def _make_part(
        self, name: str, kind: str, options: Callable[[], tuple[str, ...]]
    ) -> None:
        with widgets.notify_failure(self._context):
            self._context.check_may_change()
            await self._export(name, kind, options())

    async def _export(self, name: str, kind: str, options: tuple[str, ...] = ()) -> None:
        parts = self._context.parts
        text = f"{name}: making {KINDS[kind][0]} …"
        with widgets.notify_failure(self._context), widgets.progress_shown(text):
            holder = parts.pages.holder(self._context.page)
            url = await parts.jobs.export(
                Order(parts.recordings_folder, name, kind, options), holder
            )
            ui.download.from_url(url)

    async def _open(self, name: str) -> None:
        await open_playback(self._context, name)


def _row(recording: Recording, facts: FlightFigures | str | None, track: str) -> widgets.Cells:
    when = datetime.fromtimestamp(recording.modified_s, UTC)
    endings = [file.suffix for file in recording.files]
    kinds = [(endings.count(".csv"), "table"), (endings.count(".tlog"), "tlog")]
    return (
        (recording.name, "", "", track),
        f"{when:%Y-%m-%d %H:%M:%S}",
        f"{recording.size / 1e6:.2f} MB",
        ", ".join(counted(count, kind) for count, kind in kinds if count),
        *_facts_cells(facts),
    )


def _facts_cells(facts: FlightFigures | str | None) -> widgets.Cells:
    """Return the catalogue's cells; blank where unknown."""
    if facts is None:
        return ("",) * len(FACTS)
    if isinstance(facts, str):
        return ((facts, "bad"), "", "", "")
    distance, highest, loss = facts.distance, facts.highest, facts.loss
    return (
        str(timedelta(seconds=round(facts.duration))),
        figure(distance and distance / 1000.0, ".2f", "km"),
        figure(highest, ".0f", f"m above {facts.height_above}"),
        (figure(loss, ".1%"), "warn" if (loss or 0.0) > MUCH_LOST else ""),
    )
