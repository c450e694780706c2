"""GPS latency and declination of a flight, by one rule for every command that fuses it.

A latency that the user has set is used; else that of the log's comments; else it is estimated from
the motion; else the default is assumed, with a remark. mavgate's own recordings keep theirs.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from gateway.aircraft import AircraftSettings
from gateway.edges.disk.recording_streams import FileKind, encoding_of, kind_of, read_chunks
from gateway.estimation.alignment.latency_of_log import GpsLatency, estimate_latency
from gateway.estimation.kernel import SampleLog
from gateway.estimation.reference import ReferenceSettings
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, aircraft_of, is_table
from gateway.flights.smoothed import gather_samples, smoothed_latency_in_words

HEAD_LINES: Final = 20
DOUBTFUL_S: Final = 0.03
"""A position may be so much later than the velocity of the same fix, which alone is compared."""
_KEY_VALUE: Final = re.compile(r"(\w+)=(-?[\d.]+)")
USUAL: Final = ReferenceSettings()


def aircraft_for(
    files: Sequence[Path],
    table: RecordedTable,
    options: ReadOptions,
    given_s: float | None = None,
) -> AircraftSettings:
    """Choose the settings for a flight, and complete them from its log.

    Parameters
    ----------
    files : sequence of Path
        The parts of one flight.
    table : RecordedTable
        Their rows. Where the latency has to be estimated they are read here, and kept for the
        next reader; a remark tells what was found.
    options : ReadOptions
        Current settings that differ from the defaults take precedence over the log.
    given_s : float, optional
        The GPS latency as the user gives it, s.

    Returns
    -------
    AircraftSettings
        Those of `aircraft_of`. For a log of another program, `gps_latency_s` and
        `declination_deg` of its # lines are used, else the latency estimated from its manoeuvres.

    Raises
    ------
    FlightError
        If a value in a # line is out of range.
    """
    aircraft = aircraft_of(table, options)
    facts = {} if is_table(files[0]) else facts_of(files[0])
    aircraft = with_facts(aircraft, facts)
    if given_s is not None:
        return with_reference(aircraft, gps_latency_s=given_s)
    latency_s = aircraft.estimation.reference.gps_latency_s
    known = is_table(files[0]) or "gps_latency_s" in facts
    if known or latency_s != USUAL.gps_latency_s:
        return aircraft
    log = _samples_of(table, aircraft)
    if len(log.gps) == 0:
        return aircraft
    found = estimate_latency(log)
    if found is None:
        how = f"{latency_s:.2f} s is assumed, since no manoeuvre shows it"
    else:
        how = f"{_in_words(found)} is estimated from its manoeuvres"
        aircraft = with_reference(aircraft, gps_latency_s=found.latency_s)
    table.remarks.append(f"{files[0]}: gives no GPS latency; {how}; gps_latency_s sets it")
    return aircraft


def check_latency(file: Path, table: RecordedTable, aircraft: AircraftSettings) -> None:
    """Add a remark where the motion of a recording speaks against the latency that is set.

    Parameters
    ----------
    file : Path
        For the remark.
    table : RecordedTable
        One of mavgate's own; its rows are read here, and kept for the next reader.
    aircraft : AircraftSettings
        What it is fused with; it is not changed, since the setting is the user's.
    """
    set_s = aircraft.estimation.reference.gps_latency_s
    found = estimate_latency(_samples_of(table, aircraft))
    if found is not None and abs(found.latency_s - set_s) > max(DOUBTFUL_S, 3.0 * found.std_s):
        table.remarks.append(
            f"{file}: its manoeuvres show a GPS latency of {_in_words(found)}, "
            f"but gps_latency_s is {set_s:.2f} s"
        )


def note_smoothed_latency(
    file: Path, table: RecordedTable, aircraft: AircraftSettings, used_s: float
) -> AircraftSettings:
    """Return the settings that a flight was smoothed with; a remark tells a latency not set.

    Parameters
    ----------
    file : Path
        For the remark.
    table : RecordedTable
        Its remarks are added to.
    aircraft : AircraftSettings
        What the flight was to be smoothed with.
    used_s : float
        The GPS latency that it was smoothed with; see `smooth_blocks`.
    """
    set_s = aircraft.estimation.reference.gps_latency_s
    if used_s == set_s:
        return aircraft
    table.remarks.append(f"{file}: {smoothed_latency_in_words(used_s, set_s)}")
    return with_reference(aircraft, gps_latency_s=used_s)


def _samples_of(table: RecordedTable, aircraft: AircraftSettings) -> SampleLog:
    blocks = list(table.blocks)
    table.blocks = iter(blocks)
    return gather_samples(blocks, aircraft)[0]


def _in_words(latency: GpsLatency) -> str:
    return f"{latency.latency_s:.3f} s +- {latency.std_s:.3f} s"


def facts_of(file: Path) -> dict[str, float]:
    """Read `key=value` in the comments of another program's CSV; FlightError if no number."""
    facts: dict[str, float] = {}
    if kind_of(file) is not FileKind.CSV:
        return facts
    begin = next(read_chunks(file), b"")
    head = begin.decode(encoding_of(begin), errors="replace")
    for number, line in enumerate(head.split("\n", HEAD_LINES)[:HEAD_LINES], 1):
        for key, value in _KEY_VALUE.findall(line) if line.startswith("#") else ():
            try:
                facts[key] = float(value)
            except ValueError as error:
                raise FlightError(f"{file}: line {number}: {key}={value} is no number") from error
    return facts


def with_facts(aircraft: AircraftSettings, facts: dict[str, float]) -> AircraftSettings:
    """Replace default settings by values of a log; raises FlightError if one is out of range."""
    reference = aircraft.estimation.reference
    changes: dict[str, object] = {}
    if "gps_latency_s" in facts and reference.gps_latency_s == USUAL.gps_latency_s:
        changes["gps_latency_s"] = facts["gps_latency_s"]
    if "declination_deg" in facts and reference.declination == USUAL.declination:
        changes |= {"declination": "fixed", "declination_deg": facts["declination_deg"]}
    try:
        msgspec.convert(msgspec.to_builtins(reference) | changes, ReferenceSettings)
    except msgspec.ValidationError as error:
        raise FlightError(f"its # line has an invalid value: {error}") from error
    return with_reference(aircraft, **changes)


def with_reference(aircraft: AircraftSettings, **changes: object) -> AircraftSettings:
    """Replace settings of `ReferenceSettings`."""
    reference = msgspec.structs.replace(aircraft.estimation.reference, **changes)
    estimation = msgspec.structs.replace(aircraft.estimation, reference=reference)
    return msgspec.structs.replace(aircraft, estimation=estimation)
