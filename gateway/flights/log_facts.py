"""What a log of another program tells of its GPS and compass, or else its motion."""

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
    told_s: float | None = None,
) -> AircraftSettings:
    """Choose the settings for a flight, and complete them by what its log tells.

    Parameters
    ----------
    files : sequence of Path
        The parts of one flight.
    table : RecordedTable
        Their rows; not read here. Its remarks tell a latency that was estimated or assumed.
    options : ReadOptions
        Settings of today that are not the usual ones go before the log's word.
    told_s : float, optional
        The GPS latency as the user tells it; it is not looked for then.

    Returns
    -------
    AircraftSettings
        Those of `aircraft_of`. For a log of another program, `gps_latency_s` and
        `declination_deg` of its # lines count, else the latency that its manoeuvres tell.

    Raises
    ------
    FlightError
        If a # line tells what cannot be.
    """
    aircraft = aircraft_of(table, options)
    if is_table(files[0]):
        return aircraft
    facts = facts_of(files[0])
    aircraft = with_facts(aircraft, facts)
    latency_s = aircraft.estimation.reference.gps_latency_s
    known = told_s is not None or "gps_latency_s" in facts
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
        told = f"{found.latency_s:.3f} s +- {found.std_s:.3f} s"
        how = f"{told} is estimated from its manoeuvres"
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
    """Put what a log tells in place of the usual settings; raises FlightError if it cannot be."""
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
