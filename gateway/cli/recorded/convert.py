"""`mavgate convert` and `fuse`: write files from recordings."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any, Final

import typer

from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import CONFIG, option, output_file, read_options, read_settings
from gateway.cli.support.recordings import (
    print_remarks,
    progress_of,
    read_range,
    read_sensors,
    recorded_files,
)
from gateway.cli.support.terminal import console_of, refuse, table_of
from gateway.estimation.select import ESTIMATORS
from gateway.output import write_new
from gateway.recordings.files import FlightError
from gateway.recordings.recording import open_recordings
from gateway.recordings.table import Position, SettingsChoice
from gateway.recordings.workshop.anonymising import (
    FIRST_DAY,
    LAST_DAY,
    MAX_PLACE_DEG,
    Anonymiser,
    Anonymity,
)
from gateway.recordings.workshop.convert import AS_RECORDED, WRITERS, FlightToWrite, Fusing
from gateway.recordings.workshop.editing import FrameEdit, Renumbering, TlogEdits
from gateway.recordings.workshop.selection import (
    MAX_MARGIN_S,
    FrameChoice,
    StateChoice,
    message_ids_of,
)
from gateway.wire.system_ids import LAST_ID

app = typer.Typer()

OF_ONE_MESSAGE: Final = (".parquet", ".csv")
"""Formats that can contain all messages of one type instead of the table."""
FROM_TLOGS: Final = (".tlog", ".kml", ".gpx", ".geojson", ".mcap")
"""Formats that are made from a recording's tlogs, which contain all vehicles and messages."""


PANEL: Final = "Tlog to tlog"
"""Heading of these options in the help."""


_option: Final = partial(option, rich_help_panel=PANEL)
"""Return an option for writing tlogs from tlogs."""


@app.command()
def convert(
    files: list[Path] = opt.FILES,
    *,
    output: Path = output_file("Output; its ending selects the format.", WRITERS, default=...),
    begin: str | None = opt.FROM,
    end: str | None = opt.TO,
    columns: Path | None = opt.COLUMNS,
    sensor: list[str] | None = opt.SENSOR,
    system: list[int] | None = option(
        "--system", "Vehicle of a tlog to use; for a tlog also several.", min=1, max=255
    ),
    component: list[int] | None = _option(
        "--component", "Keep frames of this component; may be repeated.", min=0, max=255
    ),
    message: list[str] | None = _option(
        "--message",
        "Keep messages of this name, id or pattern (CAMERA_*); may be repeated. For Parquet "
        "and CSV: this message instead of the table.",
    ),
    without: list[str] | None = _option(
        "--without", "Leave out messages of this name, id or pattern; may be repeated."
    ),
    armed: bool = _option(
        "--armed", "Keep the time while a vehicle is armed, or one of --system.", False
    ),
    modes: list[str] | None = _option(
        "--from-mode", "Keep the time while a vehicle is in this mode; may be repeated."
    ),
    margin_s: float = _option(
        "--margin",
        "Margin before and after --armed and --from-mode, s.",
        0.0,
        min=0.0,
        max=MAX_MARGIN_S,
    ),
    merge: bool | None = _option(
        "--merge/--join",
        "Leave out copies of frames that are in several files, and align their clocks; or "
        "keep all. By default files are merged if they overlap.",
    ),
    rename: list[str] | None = _option(
        "--as", "OLD:NEW gives a system another id, also where it is addressed."
    ),
    merge_systems: bool = _option(
        "--merge-systems", "With --as, give several systems the same id.", False
    ),
    anonymise: bool = _option(
        "--anonymise", "Move coordinates and dates, replace texts and identifiers.", False
    ),
    place: str | None = _option(
        "--place", "LAT,LON to which --anonymise moves the first position."
    ),
    day: str | None = _option("--day", "Day to which --anonymise moves the recording: 2020-01-31."),
    keep_unknown: bool = _option(
        "--keep-unknown", "With --anonymise, keep messages that are not known here.", False
    ),
    force: bool = opt.FORCE,
) -> None:
    """Convert, trim, join, merge and edit recordings.

    Convert between tlogs and tables, or to a track for a map, MCAP for Foxglove, or Parquet. Logs
    of other autopilots (tlog, ULog, DataFlash) become tables that can be fused, and so does a CSV
    of another program, by its column map. States are the recorded ones, and a tlog of a DataFlash
    log or ULog holds the estimates and messages of its autopilot: `mavgate fuse` makes the same
    files of states that it computes from the samples.
    """
    choice = FrameChoice(
        frozenset(system or ()), frozenset(component or ()),
        message_ids_of(message or ()), message_ids_of(without or ()),
    )  # fmt: skip
    anonymity = _read_anonymity(place, day, keep_unknown=keep_unknown, wanted=anonymise)
    anonymiser = None if anonymity is None else Anonymiser(anonymity)
    renumbering = Renumbering(_read_renames(rename), merge=merge_systems) if rename else None
    edits = TlogEdits(
        read_range(begin, end), choice, _read_state(modes or [], margin_s, armed=armed), merge,
        tuple(edit for edit in (anonymiser, renumbering) if edit is not None),
    )  # fmt: skip
    _check_edits(edits, output, message or [], system or [])
    of_tlogs = output.suffix in FROM_TLOGS or message
    files = recorded_files(files, "tlogs" if of_tlogs else "tables")
    how = {"system_id": system[0] if system else None, "sensors": read_sensors(sensor)}
    _write(
        files, output, columns, how,
        edits if message or output.suffix == ".tlog" else TlogEdits(edits.limits), force=force,
    )  # fmt: skip
    _print_edits(edits.frames)


def _write(
    files: Sequence[Path],
    output: Path,
    columns: Path | None,
    how: dict[str, Any],
    edits: TlogEdits,
    fusing: Fusing = AS_RECORDED,
    *,
    force: bool,
) -> None:
    """Write a flight in the format of the suffix, and print the remarks and the size.

    `how` are options for reading.
    """
    with progress_of(files) as advance:
        options = read_options(read_settings(), columns, progress=advance, **how)
        flight = FlightToWrite(open_recordings(files), options, edits, fusing, title=output.stem)
        inputs = [*files, columns, CONFIG.get()]
        size = write_new(output, WRITERS[output.suffix](flight), overwrite=force, inputs=inputs)
    print_remarks(flight.remarks)
    if lacks := flight.lacks(output.suffix):
        print_remarks([f"Dropped: {lacks}"])
    by = "".join(f"; {fusion.summary}" for fusion in flight.fusions)
    console_of().print(f"{output}: {size / 1e6:.3f} MB{by}")


def _read_state(modes: Sequence[str], margin_s: float, *, armed: bool) -> StateChoice | None:
    if not (armed or modes):
        if margin_s:
            refuse("--margin belongs to --armed and --from-mode")
        return None
    names = frozenset(mode.upper() for mode in modes)
    return StateChoice(armed=armed, modes=names, margin_s=margin_s)


def _read_anonymity(
    place: str | None, day: str | None, *, keep_unknown: bool, wanted: bool
) -> Anonymity | None:
    if not wanted:
        if place or day or keep_unknown:
            refuse("--place, --day and --keep-unknown belong to --anonymise")
        return None
    found = Anonymity(keep_unknown=keep_unknown)
    if day is not None:
        try:
            found = replace(found, day=date.fromisoformat(day))
        except ValueError:
            raise FlightError(f"--day {day}: write a date as 2020-01-31") from None
        if not FIRST_DAY <= found.day <= LAST_DAY:
            raise FlightError(f"--day {day}: from {FIRST_DAY} to {LAST_DAY}")
    if place is not None:
        try:
            lat_deg, lon_deg = map(float, place.split(","))
        except ValueError:
            raise FlightError(f"--place {place}: write LAT,LON in degrees") from None
        if not (abs(lat_deg) <= MAX_PLACE_DEG and abs(lon_deg) <= 180.0):
            raise FlightError(
                f"--place {place}: latitudes to {MAX_PLACE_DEG:g} and longitudes to 180"
            )
        found = replace(found, lat_deg=lat_deg, lon_deg=lon_deg)
    return found


def _print_edits(edits: Sequence[FrameEdit]) -> None:
    table = table_of("message", "field", "changed", "left out", left=2)
    changed = sum((edit.changed for edit in edits if isinstance(edit, Anonymiser)), Counter())
    left_out = sum((edit.left_out for edit in edits), Counter[tuple[str, str]]())
    for key in sorted({*changed, *left_out}):
        table.add_row(*key, *(str(counts[key] or "") for counts in (changed, left_out)))
    if table.row_count:
        console_of().print(table)


def _read_renames(texts: Sequence[str]) -> dict[int, int]:
    found: dict[int, int] = {}
    for text in texts:
        numbers = text.split(":")
        is_valid = len(numbers) == 2 and all(one.isascii() and one.isdigit() for one in numbers)
        old, new = map(int, numbers) if is_valid else (0, 0)
        if not (1 <= old <= LAST_ID and 1 <= new <= LAST_ID) or old in found:
            raise FlightError(f"--as {text}: write OLD:NEW once a system, ids from 1 to {LAST_ID}")
        found[old] = new
    return found


def _check_edits(edits: TlogEdits, output: Path, message: list[str], system: list[int]) -> None:
    if output.suffix == ".tlog":
        return
    if message and (
        output.suffix not in OF_ONE_MESSAGE or len(message) > 1 or len(edits.choice.messages) > 1
    ):
        refuse(f"--message is for .tlog, and one message for {', '.join(OF_ONE_MESSAGE)}")
    if message and not edits.frames:
        return
    choice = replace(edits.choice, systems=frozenset(), messages=frozenset())
    if replace(edits, choice=choice) != TlogEdits(edits.limits) or len(system) > 1:
        refuse(f"the options under {PANEL!r} in the help are for an output that ends in .tlog")


def _known_estimator(name: str | None) -> str | None:
    if name is not None and name not in ESTIMATORS:
        raise typer.BadParameter(f"unknown estimator {name!r}; choose {', '.join(ESTIMATORS)}")
    return name


@app.command("fuse")
def fuse_log(
    files: list[Path] = opt.FILES,
    *,
    output: Path = output_file("Output; its ending selects the format.", WRITERS, default=...),
    estimator: str | None = option(
        "--estimator", "Instead of the settings'.", callback=_known_estimator
    ),
    gps_latency_s: float | None = option(
        "--gps-latency", "Instead of the settings', s.", min=0.0, max=2.0
    ),
    fuse_with: SettingsChoice = opt.FUSE_WITH,
    position: Position = opt.PLACING,
    smooth: bool = opt.SMOOTH,
    both: bool = opt.BOTH_ESTIMATES,
    begin: str | None = opt.FROM,
    end: str | None = opt.TO,
    columns: Path | None = opt.COLUMNS,
    sensor: list[str] | None = opt.SENSOR,
    system: int | None = opt.SYSTEM,
    force: bool = opt.FORCE,
) -> None:
    """Re-run the estimator on recordings, and write them with the new states in any format.

    Reads mavgate's own recordings, autopilots' logs (tlog, ULog, DataFlash), and CSV files with
    the columns time_s, ax, ay, az, gx, gy, gz, mx, baro_alt_m, gps_time_s, gps_lat and so on, or
    others by a column map. With --from the estimator runs from the start, and what follows that
    time is written.
    Where the settings leave them at their defaults, gps_latency_s and declination_deg of such a
    file's # lines are used; a latency that is not given there either is estimated from its
    manoeuvres, or the default is assumed, with a message.
    """
    files = recorded_files(files, "tables")
    how = {
        "choice": fuse_with, "position": position, "system_id": system,
        "sensors": read_sensors(sensor),
    }  # fmt: skip
    fusing = Fusing(True, both, smooth, estimator, gps_latency_s)
    _write(files, output, columns, how, TlogEdits(read_range(begin, end)), fusing, force=force)
