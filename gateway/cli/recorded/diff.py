"""`mavgate diff`: compare two recordings, parameter files or running vehicles."""

import re
from base64 import b64decode
from pathlib import Path

import typer

from gateway.aircraft import Aircraft
from gateway.answers.log_answers import LogAnswers
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import argument, ask, output_file, read_options, read_settings
from gateway.cli.support.recordings import print_remarks, progress_of, recorded_files
from gateway.cli.support.terminal import JsonOption, console_of, print_json, table_of
from gateway.output import check_output, write_new
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recordings
from gateway.recordings.workshop.comparison import (
    SECTIONS,
    Comparison,
    Contents,
    as_html,
    compare,
    contents_of,
    read_param_file,
    read_recording,
    rows_of,
)
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.extracts import RecordedPlan
from gateway.vehicle_state.senders import AUTOPILOT, RecordedSender

app = typer.Typer()

LIVE = re.compile(r"live:(\d+)")
PARAM_ENDINGS = (".param", ".params", ".parm")


@app.command()
def diff(
    first: Path = argument(
        "Recording, log of an autopilot, .param file, or live:1 for an aircraft of the "
        "running gateway.",
        ...,
    ),
    second: Path = argument("The same, to compare with.", ...),
    *,
    page: Path | None = output_file("Page to write.", (".html",), "--html"),
    json: JsonOption = False,
    system: int | None = opt.SYSTEM,
    force: bool = opt.FORCE,
) -> None:
    """Compare recordings, parameter files or running vehicles: parameters, missions, texts."""
    sides = [_files_of(name) for name in (first, second)]
    files = [file for side in sides for file in side]
    if page is not None:
        check_output(page, files, overwrite=force)
    with progress_of(files) as advance:
        settings = read_settings()
        options = read_options(settings, system_id=system, progress=advance)
        names = zip((first, second), sides, strict=True)
        both = [_read(str(name), side, options) for name, side in names]
    metadata = Aircraft(1, settings.default_aircraft).vehicle.metadata
    for one in both:
        if metadata.describes(one.parameters):
            one.add_known(metadata.of_parameters())
    found = compare(*both)
    if page is not None:
        write_new(page, (each.encode() for each in as_html(found)), overwrite=force, inputs=files)
        console_of().print(str(page))
    elif json:
        print_json(found)
    else:
        _show(found)


def _files_of(name: Path) -> list[Path]:
    return [] if LIVE.fullmatch(str(name)) else recorded_files([name], "tlogs")


def _read(name: str, files: list[Path], options: ReadOptions) -> Contents:
    if (live := LIVE.fullmatch(name)) is not None:
        return _read_live(name, int(live[1]))
    if files[0].suffix in PARAM_ENDINGS:
        return read_param_file(files[0])
    flight = FlightToWrite(open_recordings(files), options)
    found = read_recording(str(files[0]), flight)
    print_remarks(dict.fromkeys(flight.remarks))
    return found


def _read_live(name: str, vehicle_id: int) -> Contents:
    answers = LogAnswers()
    first, verb = 0, "vehicle.introduction"
    while frames := ask(verb, vehicle_id=vehicle_id, first=first):
        for frame in frames:
            answers.add_frame(b64decode(frame), 0)
        first += len(frames)
    return contents_of(name, RecordedPlan(answers, RecordedSender(vehicle_id << 8 | AUTOPILOT)))


def _show(found: Comparison) -> None:
    for section in SECTIONS:
        (first, *heads), rows = rows_of(found, section)
        if rows:
            shown = ((name if section != "texts" else "", *cells) for name, *cells in rows)
            columns = (first, *(Path(head).name for head in heads))
            console_of().print(table_of(*columns, left=5, rows=shown))
    if not (found.parameters or found.plans or found.texts):
        console_of().print("no differences of parameters, missions and texts")
