"""`mavgate extract`: extract parameters, plans, texts, subtitles and geotags from a recording."""

import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import typer

from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import argument, option, output_file, read_options, read_settings
from gateway.cli.support.recordings import print_remarks, progress_of, recorded_files
from gateway.cli.support.terminal import console_of, refuse
from gateway.output import check_output, write_new
from gateway.recordings.files import FlightError
from gateway.recordings.moment import Moment, iso_time, parse_moment, time_us_of
from gateway.recordings.recording import open_recordings
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.extracts import param_file, qgc_params, qgc_plan, waypoints
from gateway.recordings.workshop.timed_extracts import (
    MAX_RATE_HZ,
    SUBTITLE_FIELDS,
    WANTED,
    ass,
    events,
    images,
    srt,
    subtitles,
    texts,
)
from gateway.units import US_PER_S
from gateway.vehicle.plan import KINDS, RALLY

app = typer.Typer()

ITEMS: Final = (".waypoints", ".plan")
CONTENTS: Final = ((None, "parameters"), *(KINDS | {RALLY: "rally points"}).items())
"""Names of the kinds of plan items, and of the parameters."""
VIDEO_TIME: Final = re.compile(r"(20\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)")
"""Start time in the file name of a video, as cameras write it."""


def _out(name: str, text: str, endings: tuple[str, ...]) -> Any:
    return output_file(f"{text} ({', '.join(endings)}).", endings, name)


@app.command()
def extract(
    file: Path = argument("Recording, by name or file.", ..., show_default=False),
    *,
    params: Path | None = _out("--params", "Parameters", (".param", ".params")),
    mission: Path | None = _out(
        "--mission", "Mission; a .plan also has fence and rally points", ITEMS
    ),
    fence: Path | None = _out("--fence", "Fence", ITEMS),
    rally: Path | None = _out("--rally", "Rally points", ITEMS),
    text: Path | None = _out("--texts", "Texts with times", (".csv",)),
    event: Path | None = _out("--events", "Changes of mode, arming, landing, mission", (".csv",)),
    image: Path | None = _out("--images", "Locations of images", (".csv",)),
    subtitle: Path | None = _out("--subtitles", "Subtitles for a video", (".srt", ".ass")),
    fields: str = option(
        "--fields", "Fields of the subtitles, separated by commas.", ",".join(SUBTITLE_FIELDS)
    ),
    rate_hz: float = option("--rate", "Rate of the subtitles, Hz.", 5.0, min=0.1, max=MAX_RATE_HZ),
    offset: str | None = option(
        "--offset", "Start of the video in the recording: 80, 1:20 or a time in UTC."
    ),
    video: Path | None = option(
        "--video",
        "The video: it begins at the time (UTC) in its name, or else at that of the file.",
    ),
    system: int | None = opt.SYSTEM,
    force: bool = opt.FORCE,
) -> None:
    """Extract parameters, missions, texts, subtitles and geotags from a recording.

    The exit code is 1 if the recording has only some of them.
    """
    files = recorded_files([file], "tlogs")
    targets = (params, mission, fence, rally, text, event, image, subtitle)
    wanted = [path for path in targets if path is not None]
    if not wanted or len(set(wanted)) < len(wanted):
        refuse("give at least one file to write, each under a name of its own; --help lists them")
    for path in wanted:
        check_output(path, files, overwrite=force)
    chosen = _read_fields(fields)
    with progress_of(files) as advance:
        options = read_options(read_settings(), system_id=system, progress=advance)
        flight = FlightToWrite(open_recordings(files), options)
        timed = ((text, texts), (event, events), (image, images))
        made: list[tuple[Path, Iterable[str]]] = [
            (path, [make(flight.messages_of_vehicle(WANTED))])
            for path, make in timed
            if path is not None
        ]
        missing = list[str]()
        made += _plans(flight, (params, mission, fence, rally), missing, is_read=bool(made))
        if subtitle is not None:
            begin = _video_begin(offset, video)
            shown = subtitles(
                flight.messages_of_vehicle(WANTED),
                lambda: time_us_of(begin, flight.first_us), chosen, rate_hz,
            )  # fmt: skip
            made.append((subtitle, srt(shown) if subtitle.suffix == ".srt" else ass(shown)))
        for path, pieces in made:
            encoded = (piece.encode() for piece in pieces)
            write_new(path, encoded, overwrite=force, inputs=files)
            console_of().print(str(path))
    print_remarks(dict.fromkeys([*flight.remarks, *missing]))
    if missing:
        raise typer.Exit(1 if made else 2)


def _plans(
    flight: FlightToWrite,
    paths: Sequence[Path | None],
    missing: list[str],
    *,
    is_read: bool,
) -> Iterator[tuple[Path, Iterable[str]]]:
    """Yield the wanted files of parameters, mission, fence and rally points; list missing ones."""
    if not any(paths):
        return
    if not is_read:
        deque(flight.answered(), maxlen=0)
    plan = flight.plan
    for (kind, name), path in zip(CONTENTS, paths, strict=True):
        if path is None:
            continue
        if kind is None and (parameters := plan.parameters()):
            is_qgc = path.suffix == ".params"
            yield path, qgc_params(parameters, plan) if is_qgc else param_file(parameters)
        elif kind is not None and (items := plan.items(kind)):
            yield path, [qgc_plan(plan)] if path.suffix == ".plan" else waypoints(items)
        else:
            missing.append(f"the recording has no {name} of this vehicle; {path} is not written")


def _read_fields(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if wrong := [name for name in names if name not in SUBTITLE_FIELDS]:
        raise FlightError(f"--fields {wrong[0]}: choose {', '.join(SUBTITLE_FIELDS)}")
    return names


def _video_begin(offset: str | None, video: Path | None) -> Moment:
    """Return the start of the video, within the recording or in UTC, with the offset added."""
    try:
        begin = Moment(0.0) if offset is None else parse_moment(offset)
    except ValueError as error:
        raise FlightError(f"--offset: {error}") from error
    if video is None or begin.time_us is not None:
        return begin
    video_us = _video_time_us(video)
    print_remarks([f"{video}: begins at {iso_time(video_us)}"])
    return Moment(time_us=time_us_of(begin, video_us))


def _video_time_us(video: Path) -> int:
    if (found := VIDEO_TIME.search(video.stem)) is not None:
        try:
            numbers = [int(number) for number in found.groups()]
            moment = datetime(*numbers, tzinfo=UTC)  # type: ignore[arg-type, misc]
        except ValueError:
            pass
        else:
            return round(moment.timestamp() * US_PER_S)
    return video.stat().st_mtime_ns // 1000
