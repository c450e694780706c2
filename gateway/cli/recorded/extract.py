"""`mavgate extract`: parameters, plans, texts, subtitles and geotags out of a recording."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from gateway.cli.support.options import output_file
from gateway.cli.support.recording_options import (
    ForceOption,
    SystemOption,
    print_remarks,
    progress_of,
    recorded_files,
)
from gateway.cli.support.terminal import console_of, refuse
from gateway.output import check_output, write_new
from gateway.recordings.answers import LogAnswers
from gateway.recordings.extracts import (
    FENCE,
    MISSION,
    RALLY,
    RecordedPlan,
    param_file,
    qgc_params,
    qgc_plan,
    waypoints,
)
from gateway.recordings.files import TLOG, FlightError, Progress, TlogSource, format_of, open_tlog
from gateway.recordings.moment import parse_moment, time_us_of
from gateway.recordings.senders import Senders
from gateway.recordings.timed_extracts import (
    MAX_RATE_HZ,
    SUBTITLE_FIELDS,
    WANTED,
    ass,
    events,
    images,
    moment_text,
    srt,
    subtitles,
    texts,
)
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.units import US_PER_S

app = typer.Typer()

ITEMS: Final = (".waypoints", ".plan")
VIDEO_TIME: Final = re.compile(r"(20\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)")
"""A time of begin in the name of a video, as cameras write it."""
NAMES: Final = {MISSION: "mission", FENCE: "fence", RALLY: "rally points"}


@dataclass(slots=True)
class _Recording:
    """The tlogs of a recording, and the vehicle that is read."""

    sources: list[TlogSource]
    senders: Senders
    system_id: int
    progress: Progress

    def messages(self) -> Iterator[VehicleMessage]:
        """Yield the messages of the vehicle."""
        reader = VehicleReader(self.senders, WANTED, self.system_id, with_attitude=False)
        for source in self.sources:
            for batch in source.batches(self.progress):
                yield from reader.feed_batch(batch)
        yield from reader.flush()

    def plan(self) -> RecordedPlan:
        """Return its parameters and plans at the end."""
        answers = LogAnswers()
        for source in self.sources:
            for batch in source.batches(self.progress):
                answers.add(batch, self.senders)
        return RecordedPlan(answers, self.senders.vehicle(self.system_id))

    def first_us(self) -> int:
        """Return the time of the first record."""
        batches = (batch for source in self.sources for batch in source.batches())
        return next((int(batch.time_us[0]) for batch in batches if len(batch)), 0)


def _open(files: list[Path], system: int | None, progress: Progress) -> _Recording:
    for file in files:
        if format_of(file) != TLOG:
            raise FlightError(f"{file}: is no tlog; `mavgate convert` makes one of it")
    sources, senders = [open_tlog(file) for file in files], Senders()
    for source in sources:
        senders.merge(source.senders)
    systems = senders.systems()
    if system is None and len(systems) > 1:
        raise FlightError(
            f"several vehicles; choose one with --system: {', '.join(map(str, systems))}"
        )
    if not systems or (system is not None and system not in systems):
        raise FlightError(f"{files[0]}: no vehicle{'' if system is None else f' {system}'} in it")
    return _Recording(sources, senders, system or systems[0], progress)


def _out(name: str, text: str, endings: tuple[str, ...]) -> Any:
    return output_file(f"{text} ({', '.join(endings)}).", endings, name)


@app.command()
def extract(
    file: Annotated[Path, typer.Argument(help="Recording, by name or tlog.", show_default=False)],
    *,
    params: Annotated[
        Path | None, _out("--params", "Parameters", (".param", ".params"))
    ] = None,
    mission: Annotated[
        Path | None, _out("--mission", "Mission; a .plan also has fence and rally points", ITEMS)
    ] = None,
    fence: Annotated[Path | None, _out("--fence", "Fence", ITEMS)] = None,
    rally: Annotated[Path | None, _out("--rally", "Rally points", ITEMS)] = None,
    text: Annotated[Path | None, _out("--texts", "Texts with times", (".csv",))] = None,
    event: Annotated[
        Path | None, _out("--events", "Changes of mode, arming, landing, mission", (".csv",))
    ] = None,
    image: Annotated[Path | None, _out("--images", "Locations of images", (".csv",))] = None,
    subtitle: Annotated[
        Path | None, _out("--subtitles", "Subtitles for a video", (".srt", ".ass"))
    ] = None,
    fields: Annotated[
        str, typer.Option("--fields", help="Of the subtitles, separated by commas.")
    ] = ",".join(SUBTITLE_FIELDS),
    rate_hz: Annotated[
        float, typer.Option("--rate", min=0.1, max=MAX_RATE_HZ, help="Of the subtitles, Hz.")
    ] = 5.0,
    offset: Annotated[
        str | None,
        typer.Option(
            "--offset", help="Where in the recording the video begins: 80, 1:20 or a time in UTC."
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option("--video", help="The video: it begins at the time (UTC) in its name, or else "
                     "at that of the file."),
    ] = None,
    system: SystemOption = None,
    force: ForceOption = False,
) -> None:  # fmt: skip
    """Extract parameters, missions, texts, subtitles and geotags from a recording."""
    files = recorded_files([file], "tlogs")
    targets = (params, mission, fence, rally, text, event, image, subtitle)
    wanted = [path for path in targets if path is not None]
    if not wanted or len(set(wanted)) < len(wanted):
        refuse("give at least one file to write, each under a name of its own; --help lists them")
    for path in wanted:
        check_output(path, files, overwrite=force)
    chosen = _read_fields(fields)
    with progress_of(files) as advance:
        recording = _open(files, system, advance)
        print_remarks(
            f"{one.path}: {remark}" for one in recording.sources for remark in one.remarks
        )
        timed = ((text, texts), (event, events), (image, images))
        made: list[tuple[Path, Iterable[str]]] = [
            (path, make(recording.messages())) for path, make in timed if path is not None
        ]
        if any((params, mission, fence, rally)):
            made += _plans(recording.plan(), params, (mission, fence, rally))
        if subtitle is not None:
            begin_us = _video_begin_us(recording.first_us(), offset, video)
            shown = subtitles(recording.messages(), begin_us, chosen, rate_hz)
            made.append((subtitle, srt(shown) if subtitle.suffix == ".srt" else ass(shown)))
        for path, pieces in made:
            encoded = (piece.encode() for piece in pieces)
            write_new(path, encoded, overwrite=force, inputs=files)
            console_of().print(str(path))


def _plans(
    plan: RecordedPlan, params: Path | None, items: Iterable[Path | None]
) -> Iterator[tuple[Path, Iterable[str]]]:
    """Yield the files of parameters, mission, fence and rally points that are wanted."""
    if params is not None:
        yield params, _params(params, plan)
    for kind, path in enumerate(items):
        if path is not None:
            yield path, _items(path, plan, kind)


def _params(path: Path, plan: RecordedPlan) -> Iterable[str]:
    parameters = plan.parameters()
    if not parameters:
        raise FlightError("the recording has no parameters of this vehicle")
    if path.suffix == ".params":
        return qgc_params(parameters, plan)
    return param_file(parameters)


def _items(path: Path, plan: RecordedPlan, kind: int) -> Iterable[str]:
    items = plan.items(kind)
    if not items:
        raise FlightError(f"the recording has no {NAMES[kind]} of this vehicle")
    return [qgc_plan(plan)] if path.suffix == ".plan" else waypoints(items)


def _read_fields(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if wrong := [name for name in names if name not in SUBTITLE_FIELDS]:
        raise FlightError(f"--fields {wrong[0]}: choose {', '.join(SUBTITLE_FIELDS)}")
    return names


def _video_begin_us(first_us: int, offset: str | None, video: Path | None) -> int:
    """Return when the video begins, on the clock of the recording; the offset is added."""
    if video is not None:
        first_us = _video_time_us(video)
        print_remarks([f"{video}: begins at {moment_text(first_us)}"])
    if offset is None:
        return first_us
    try:
        return time_us_of(parse_moment(offset), first_us)
    except ValueError as error:
        raise FlightError(f"--offset: {error}") from error


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
