"""Loading of flights for the analysis commands."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from gateway.analysis.flight import Flight, flight_of_files, judged_by
from gateway.analysis.simulated import simulated_flight
from gateway.cli.support.options import folder_of, read_options
from gateway.cli.support.recording_options import (
    files_of,
    print_remarks,
    progress_of,
    read_column_map,
    refusing,
)
from gateway.config import GatewaySettings
from gateway.recordings.files import FileKind, FlightError, SettingsChoice, kind_of
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.reading import ReadOptions, is_table, open_rows

FlightArgument = Annotated[
    Path | None,
    typer.Argument(
        help="A recording by its name, or any flight log; "
        "by default the built-in simulated flight.",
        show_default=False,
    ),
]
ReferenceOption = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        help="A mavgate CSV on the flight's clock, with whose states the estimates are compared.",
    ),
]
SystemOption = Annotated[
    int | None, typer.Option("--system", min=1, max=255, help="Vehicle of a tlog to use.")
]

STORIES: Final = {
    FileKind.TABLE: "Recorded by mavgate.",
    FileKind.CSV: "Recorded by another program; its samples count as calibrated.",
    FileKind.OTHER: "Recorded by another program; its samples count as calibrated.",
    FileKind.TLOG: "Read out of an autopilot's MAVLink log; its samples count as calibrated.",
}


@dataclass(frozen=True, slots=True)
class Loading:
    """How to read a command's flights."""

    settings: GatewaySettings
    choice: SettingsChoice = "recorded"
    columns: Path | None = None
    system: int | None = None
    reference: Path | None = None


def fusion_of(settings: GatewaySettings) -> FusionSettings:
    """Return the part of the settings that fuses a flight."""
    return FusionSettings(estimation=settings.estimation)


def load_flight(path: Path | None, loading: Loading) -> Flight:
    """Read a recording, or the simulated flight; a file without one ends the command."""
    settings = loading.settings
    if path is None:
        return simulated_flight(settings.simulator, fusion_of(settings))
    with refusing():
        parts = files_of([path], folder_of(settings), "tables")
    files = [*parts, loading.reference] if loading.reference is not None else parts
    with progress_of(files) as advance, refusing():
        options = _read_options(loading, advance)
        story = STORIES[FileKind.TABLE if is_table(parts[0]) else kind_of(parts[0])]
        try:
            flight, table, _ = flight_of_files(
                parts, options, name=path.name, story=story, checked=True
            )
        except ValueError as error:
            raise FlightError(str(error)) from error
        print_remarks(table.remarks)
        if loading.reference is None:
            return flight
        return judged_by(
            flight, open_rows(loading.reference, options).blocks, loading.reference.name
        )


def _read_options(loading: Loading, advance: Callable[[int], None]) -> ReadOptions:
    return read_options(
        loading.settings,
        choice=loading.choice,
        columns=read_column_map(loading.columns),
        system_id=loading.system,
        progress=advance,
    )
