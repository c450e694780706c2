"""`mavgate catalogue`: catalogue of all recordings under a folder."""

from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from gateway.batch.catalogue import Row, figures_of, find_flights, geojson_of, index_folder
from gateway.batch.executors import LocalProcesses
from gateway.cli.support.options import folder_of, read_options, read_settings
from gateway.cli.support.recording_options import ColumnsOption, JobsOption
from gateway.cli.support.terminal import (
    JsonOption,
    console_of,
    print_json,
    progress_bar,
    refuse,
    table_of,
)
from gateway.printable import UNKNOWN, figure
from gateway.units import counted

INDEX: Final = "index"
app = typer.Typer()
FolderOption = Annotated[
    Path | None,
    typer.Option("--folder", "-d", help="Folder of the catalogue; by default the recordings'."),
]
WhereOption = Annotated[
    str,
    typer.Option("--where", help="Condition in SQL: 'duration > 300 and loss > 0.05'."),
]
GeojsonOption = Annotated[bool, typer.Option("--geojson", help="The tracks, for maps.")]
WHOLE: Final = ("vehicle", "duration", "highest", "gps_outages", "faults")
"""Columns that are shown without decimals."""


class _IndexByDefault(TyperGroup):
    """A command group; a first argument that is not one of its commands is a folder to index."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the command `index` if the first argument is not a command."""
        if not args or (args[0] not in self.commands and args[0] not in ctx.help_option_names):
            args = [INDEX, *args]
        return super().parse_args(ctx, args)


group = typer.Typer(
    cls=_IndexByDefault,
    help="Index all recordings under a folder, and list and search their flights.",
)
app.add_typer(group, name="catalogue")


@group.command(INDEX)
def index(
    folder: Annotated[
        Path | None,
        typer.Argument(help="Folder; by default that of the recordings.", show_default=False),
    ] = None,
    *,
    columns: ColumnsOption = None,
    jobs: JobsOption = None,
) -> None:
    """Update the catalogue of a folder; the word `index` may be left out."""
    settings = read_settings()
    root = (folder or folder_of(settings)).expanduser()
    if not root.is_dir():
        refuse(f"{root}: is not a folder")
    options = read_options(settings, columns)
    with progress_bar() as progress:
        task = progress.add_task("reading", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total, refresh=True)

        report = index_folder(root, options, LocalProcesses(jobs), show)
    console_of().print(
        f"{root}: {report.unchanged} unchanged, {report.read - report.broken} new, "
        f"{report.gone} removed, {report.broken} unreadable"
    )


@group.command("list")
def list_flights(
    *,
    where: WhereOption = "",
    folder: FolderOption = None,
    json: JsonOption = False,
    geojson: GeojsonOption = False,
) -> None:
    """List the flights of the catalogue, or those that satisfy a condition."""
    root = _folder(folder)
    if geojson or json:
        print_json(geojson_of(root, where) if geojson else find_flights(root, where))
    else:
        _show_table(find_flights(root, where))


def _folder(folder: Path | None) -> Path:
    return (folder or folder_of(read_settings())).expanduser()


def _show_table(rows: list[Row]) -> None:
    grid = table_of(
        "file", "kind", "began (UTC)", "aircraft", "duration, s", "distance, km", "highest, m",
        "fastest, m/s", "GPS outages", "faults", "loss", left=3,
    )  # fmt: skip
    for row in rows:
        if row["error"] is not None:
            grid.add_row(row["path"], "unreadable", row["error"], *[UNKNOWN] * 8)
            continue
        km = None if row["distance"] is None else row["distance"] / 1000.0
        whole = {key: figure(row[key], ".0f") for key in WHOLE}
        grid.add_row(
            row["path"], row["kind"], row["began"] or UNKNOWN, whole["vehicle"], whole["duration"],
            figure(km, ".2f"), whole["highest"], figure(row["fastest"], ".1f"),
            whole["gps_outages"], whole["faults"], figure(row["loss"], ".1%"),
        )  # fmt: skip
    console = console_of()
    console.print(grid)
    lasted_s = [one.duration for flown in figures_of(rows).values() for one in flown.values()]
    hours = sum(lasted_s) / 3600.0
    files = len({row["path"] for row in rows})
    broken = sum(row["error"] is not None for row in rows)
    console.print(
        f"{counted(len(lasted_s), 'flight')}, {hours:.2f} h, in {counted(files, 'file')}; "
        f"{broken} unreadable"
    )
