"""`mavgate record …`: control the recorder of a running gateway."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from gateway.cli.support.control import ask, is_running, recordings_folder
from gateway.cli.support.options import folder_of, read_options, read_settings
from gateway.cli.support.terminal import JsonOption, console_of, print_json, table_of
from gateway.live.session import SessionState
from gateway.printable import UNKNOWN, figure
from gateway.recordings.index import (
    Recording,
    RecordingError,
    delete_recording,
    find_recording,
    list_recordings,
    rename_recording,
)
from gateway.recordings.moment import civil_time
from gateway.units import US_PER_S, counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from gateway.batch.catalogue import FlightFigures

NameArgument = Annotated[str, typer.Argument(help="Name of a recording, or last.")]


app = typer.Typer()
group = typer.Typer(
    help="Start, stop, name, list and delete recordings.",
    no_args_is_help=True,
)
app.add_typer(group, name="record")


@group.command()
def start() -> None:
    """Record from now on, whatever the setting `mode`; exit code 1 if that is not possible now."""
    found = ask("record.start")
    _show(found)
    if found["state"] == SessionState.BLOCKED:
        raise typer.Exit(1)


@group.command()
def stop() -> None:
    """Stop recording until the next start or flight."""
    _show(ask("record.stop"))


@group.command()
def status(*, json: JsonOption = False) -> None:
    """Show the status of the recorder."""
    found = ask("record.status")
    if json:
        print_json(found)
    else:
        _show(found)


@group.command()
def rename(
    name: Annotated[str, typer.Argument(help="Letters, digits, spaces, dots, hyphens.")],
    *,
    recording: Annotated[
        str | None,
        typer.Option("--recording", help="Recording; by default the current or last one."),
    ] = None,
) -> None:
    """Rename a recording; nothing is ever overwritten."""
    if recording is None and is_running():
        _show(ask("record.save", {"name": name}))
        return
    _list([rename_recording(_folder(), recording or "last", name)])


@group.command()
def delete(
    name: NameArgument,
    *,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Delete a recording, after asking."""
    running = is_running()
    folder = Path(ask("record.status")["folder"]) if running else _folder()
    # `last` may have become another one while the user was asked.
    found = find_recording(folder, name)
    if not yes:
        what = f"{found.name!r}: {counted(len(found.files), 'file')}, {found.size / 1e6:.2f} MB"
        typer.confirm(f"Delete the recording {what}, for ever?", abort=True)
    if running:
        deleted = ask("record.delete", {"name": found.name})["files"]
    else:
        deleted = delete_recording(folder, found.name).files
    for path in deleted:
        console_of().print(f"deleted {path}")


@group.command("list")
def list_all(*, json: JsonOption = False) -> None:
    """List the recordings, the newest last."""
    folder = recordings_folder()
    found = list_recordings(folder)
    if json:
        figures = _figures(found) if found else {}
        listed = [
            {"duration_s": _length_s(flown), "vehicles": sorted(flown)}
            | msgspec.to_builtins(recording, enc_hook=str)
            for recording in found
            for flown in [figures.get(recording.name, {})]
        ]
        print_json(listed)
    elif found:
        _list(found)
    else:
        console_of().print(f"no recordings in {folder}")


@group.command()
def note(text: Annotated[str, typer.Argument(help="What happens now.")]) -> None:
    """Add a remark to the recording at this moment, and send it to the ground stations."""
    _show(ask("record.note", {"text": text}))


def _folder() -> Path:
    return folder_of(read_settings())


def _show(status: dict[str, Any]) -> None:
    console = console_of()
    free = f"{status['free_bytes'] / 1e9:.1f} GB free"
    if status["state"] == SessionState.IDLE and status["name"]:
        length = _clock(status["duration_s"]).removeprefix("0:").removeprefix("0")
        console.print(
            f"Stopped: {status['name']}, {length}, "
            f"{_size(status) / 1e6:.1f} MB, in {status['folder']} ({free})"
        )
        return
    line = status["state"]
    if status["name"]:
        line += f": {status['name']}, part {status['part']}"
    if status["part_bytes"]:
        line += f", {status['part_bytes'] / 1e6:.1f} MB"
    if status["reason"]:
        line += f" ({status['reason']})"
    console.print(line)
    console.print(f"{status['folder']}: {free}")


def _size(status: dict[str, Any]) -> int:
    """Return the size of a recording; of its last part where the files are not readable."""
    try:
        return find_recording(Path(status["folder"]), status["name"]).size
    except (RecordingError, OSError):
        size: int = status["part_bytes"]
        return size


def _figures(recordings: list[Recording]) -> "dict[str, dict[int, FlightFigures]]":
    """Bring the catalogue of the recordings up to date, and take their figures from it."""
    from gateway.batch.catalogue import CatalogueError, figures_of, find_flights, index_folder
    from gateway.batch.executors import ThisProcess

    folder = recordings[0].files[0].parent
    console = console_of(stderr=True)
    with console.status("reading new recordings") as shown:

        def show(done: int, total: int) -> None:
            shown.update(f"reading new recordings: {done} of {total} files")

        try:
            index_folder(folder, read_options(read_settings()), ThisProcess(), show)
            found = figures_of(find_flights(folder))
            return {
                str(path): {vehicle: one for vehicle, one in flown.items() if vehicle is not None}
                for path, flown in found.items()
            }
        except (CatalogueError, OSError) as error:
            console.print(f"no figures of the flights: {error}")
            return {}


def _list(recordings: list[Recording]) -> None:
    grid = table_of(
        "recording", "length", "vehicles", "km", "height, m", "loss", "MB", "last written (UTC)",
        "path",
    )  # fmt: skip
    figures = _figures(recordings)
    for recording in recordings:
        flown = figures.get(recording.name, {})
        each = [flown[system_id] for system_id in sorted(flown)]
        when, length_s = civil_time(recording.modified_s * US_PER_S), _length_s(flown)
        grid.add_row(
            recording.name,
            UNKNOWN if length_s is None else _clock(length_s),
            " ".join(map(str, sorted(flown))) or UNKNOWN,
            _each(each, lambda f: figure(f.distance and f.distance / 1000, ".2f")),
            _each(each, lambda f: figure(f.highest, ".0f")),
            _each(each, lambda f: figure(f.loss, ".1%")),
            f"{recording.size / 1e6:.2f}",
            UNKNOWN if when is None else f"{when:%Y-%m-%d %H:%M:%S}",
            _path(recording),
        )
    console_of().print(grid)


def _length_s(flown: "dict[int, FlightFigures]") -> float | None:
    """Return the length of a recording, given the figures of its vehicles; None if unknown."""
    return max((figures.duration for figures in flown.values()), default=None)


def _each(figures: "list[FlightFigures]", text: "Callable[[FlightFigures], str]") -> str:
    """Write one figure for each vehicle."""
    return " ".join(map(text, figures)) or UNKNOWN


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def _path(recording: Recording) -> str:
    """Return a shell pattern of all its files."""
    first = str(recording.files[0])
    return first if len(recording.files) == 1 else f"{recording.files[0].parent / recording.name}_*"
