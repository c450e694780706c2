"""`mavgate record …`: control the recorder of a running gateway."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import typer

from gateway.cli.support.options import argument, ask, folder_of, is_running, option, read_settings
from gateway.cli.support.terminal import JsonOption, console_of, duration_text, print_json
from gateway.live.session import SessionState
from gateway.recordings.index import (
    RecordingError,
    delete_recording,
    find_recording,
    rename_recording,
)
from gateway.units import counted

app = typer.Typer()
group = typer.Typer(
    help="Start, stop, name and delete recordings, and add remarks.",
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
    print_json(found) if json else _show(found)


@group.command()
def rename(
    name: str = argument("New name: letters, digits, spaces, dots, hyphens.", ...),
    recording: str | None = argument(
        "Recording; by default the current or last one.", show_default=False
    ),
) -> None:
    """Rename a recording; nothing is ever overwritten."""
    if recording is None and is_running():
        _show(ask("record.rename", name=name))
        return
    folder = folder_of(read_settings())
    renamed = rename_recording(folder, recording or "last", name)
    console_of().print(f"{renamed.name}: {counted(len(renamed.files), 'file')} in {folder}")


@group.command()
def delete(
    name: str = argument("Name of a recording, or last.", ...),
    *,
    yes: bool = option("--yes -y", "Do not ask for confirmation.", False),
) -> None:
    """Delete a recording, after asking."""
    running = is_running()
    folder = Path(ask("record.status")["folder"]) if running else folder_of(read_settings())
    # `last` may mean another recording after the user has answered.
    found = find_recording(folder, name)
    if not yes:
        what = f"{found.name!r}: {counted(len(found.files), 'file')}, {found.size / 1e6:.2f} MB"
        typer.confirm(f"Delete the recording {what}, for ever?", abort=True)
    if running:
        deleted = ask("record.delete", name=found.name)["files"]
    else:
        deleted = delete_recording(folder, found.name).files
    for path in deleted:
        console_of().print(f"deleted {path}")


@group.command()
def note(text: str = argument("Text of the remark.", ...)) -> None:
    """Add a remark to the recording at this moment, and send it to the ground stations."""
    _show(ask("record.note", text=text))


def _show(status: dict[str, Any]) -> None:
    console = console_of()
    if status["held_s"] and status["state"] == SessionState.IDLE:
        console.print(f"waits for arming, with {status['held_s']:.0f} s in memory")
    size, free = status["part_bytes"], f"{status['free_bytes'] / 1e9:.1f} GB free"
    if status["state"] == SessionState.IDLE and status["name"]:
        # That of its last part is all that is known if the files cannot be accessed.
        with suppress(RecordingError, OSError):
            size = find_recording(Path(status["folder"]), status["name"]).size
        length = duration_text(status["duration_s"]).removeprefix("0:").removeprefix("0")
        console.print(
            f"Stopped: {status['name']}, {length}, "
            f"{size / 1e6:.1f} MB, in {status['folder']} ({free})"
        )
        return
    line = status["state"]
    if status["name"]:
        line += f": {status['name']}, part {status['part']}"
    if size:
        line += f", {size / 1e6:.1f} MB"
    if status["reason"]:
        line += f" ({status['reason']})"
    console.print(line)
    console.print(f"{status['folder']}: {free}")
