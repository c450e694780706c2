"""`mavgate diff`: two recordings or parameter files, compared."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.support.options import output_file
from gateway.cli.support.recording_options import (
    ForceOption,
    SystemOption,
    progress_of,
    recorded_files,
)
from gateway.cli.support.terminal import JsonOption, console_of, print_json, refuse, table_of
from gateway.output import check_output, write_new
from gateway.recordings.comparison import (
    SECTIONS,
    Comparison,
    Contents,
    as_html,
    compare,
    read_param_file,
    read_recording,
)
from gateway.recordings.files import TLOG, FlightError, Progress, format_of

app = typer.Typer()

PARAM_ENDINGS = (".param", ".params", ".parm")


@app.command()
def diff(
    first: Annotated[Path, typer.Argument(help="Tlog, recording by name, or .param file.")],
    second: Annotated[Path, typer.Argument(help="The same, to compare with.")],
    *,
    page: Annotated[Path | None, output_file("Page to write.", (".html",), "--html")] = None,
    json: JsonOption = False,
    system: SystemOption = None,
    force: ForceOption = False,
) -> None:
    """Compare recordings or parameter files: parameters, missions, figures, texts."""
    files = [file for name in (first, second) for file in recorded_files([name], "tlogs")]
    if len(files) > 2:
        refuse("a recording of several parts is one file after `mavgate convert NAME -o ALL.tlog`")
    if page is not None:
        check_output(page, files, overwrite=force)
    with progress_of(files) as advance:
        found = compare(*(_read(file, system, advance) for file in files))
    if page is not None:
        write_new(page, (each.encode() for each in as_html(found)), overwrite=force, inputs=files)
        console_of().print(str(page))
    elif json:
        print_json(found)
    else:
        _show(found)


def _read(file: Path, system: int | None, progress: Progress) -> Contents:
    if file.suffix in PARAM_ENDINGS:
        return read_param_file(file)
    if format_of(file) != TLOG:
        raise FlightError(f"{file}: is neither a tlog nor a file of parameters (.param)")
    return read_recording(file, system, progress)


def _show(found: Comparison) -> None:
    for section, heading in SECTIONS.items():
        rows: dict[str, tuple[str, str]] = getattr(found, section)
        if not rows:
            continue
        table = table_of(heading, *(Path(name).name for name in found.names), left=3)
        for name, pair in rows.items():
            table.add_row(name if section != "texts" else "", *pair)
        console_of().print(table)
    if not (found.parameters or found.plans or found.texts):
        console_of().print("no differences of parameters, missions and texts")
