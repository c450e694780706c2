"""GPS latency and declination of a foreign log: from its comments, else from its motion."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import msgspec

from gateway.aircraft import AircraftSettings
from gateway.edges.disk.recording_streams import FileKind, kind_of, read_chunks
from gateway.estimation.alignment.gps_latency import estimate_latency
from gateway.estimation.reference import ReferenceSettings
from gateway.flights.flight_terms import FlightError
from gateway.flights.joined import joined_tables
from gateway.flights.reading import (
    ReadOptions,
    RecordedTable,
    aircraft_of,
    is_table,
    open_rows,
)
from gateway.flights.smoothed import gather_samples

HEAD_LINES: Final = 20
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
        Their rows; not read here. A remark is added if the latency is estimated or assumed.
    options : ReadOptions
        Current settings that differ from the defaults take precedence over the log.
    given_s : float, optional
        The GPS latency as the user gives it; it is not estimated then.

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
    if is_table(files[0]):
        return aircraft
    facts = facts_of(files[0])
    aircraft = with_facts(aircraft, facts)
    latency_s = aircraft.estimation.reference.gps_latency_s
    known = given_s is not None or "gps_latency_s" in facts
    if known or latency_s != USUAL.gps_latency_s:
        return aircraft
    quiet = replace(options, progress=None)
    blocks = joined_tables([open_rows(file, quiet) for file in files]).blocks
    log, _ = gather_samples(blocks, aircraft)
    if len(log.gps) == 0:
        return aircraft
    found = estimate_latency(log)
    if found is None:
        how = f"{latency_s:.2f} s is assumed, since no manoeuvre shows it"
    else:
        estimate = f"{found.latency_s:.3f} s +- {found.std_s:.3f} s"
        how = f"{estimate} is estimated from its manoeuvres"
        aircraft = with_facts(aircraft, {"gps_latency_s": found.latency_s})
    table.remarks.append(f"{files[0]}: gives no GPS latency; {how}; gps_latency_s sets it")
    return aircraft


def facts_of(file: Path) -> dict[str, float]:
    """Read the `key=value` words of a foreign file's comments; raises FlightError for no number."""
    facts: dict[str, float] = {}
    if kind_of(file) is not FileKind.FOREIGN:
        return facts
    head = next(read_chunks(file), b"").decode("utf-8-sig", errors="replace")
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
    if "gps_latency_s" in facts and reference.gps_latency_s == USUAL.gps_latency_s:
        reference = msgspec.structs.replace(reference, gps_latency_s=facts["gps_latency_s"])
    if "declination_deg" in facts and reference.declination == USUAL.declination:
        reference = msgspec.structs.replace(
            reference, declination="fixed", declination_deg=facts["declination_deg"]
        )
    try:
        msgspec.convert(msgspec.to_builtins(reference), ReferenceSettings)
    except msgspec.ValidationError as error:
        raise FlightError(f"its # line has an invalid value: {error}") from error
    estimation = msgspec.structs.replace(aircraft.estimation, reference=reference)
    return msgspec.structs.replace(aircraft, estimation=estimation)
