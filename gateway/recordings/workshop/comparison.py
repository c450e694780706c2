"""Compare two recordings or parameter files: parameters, missions, figures, texts."""

import codecs
import html
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gateway.answers.log_answers import AUTOPILOT_VERSION_ID
from gateway.printable import printable
from gateway.recordings.files import FlightError
from gateway.recordings.flight_facts import FlightFacts
from gateway.recordings.tallies import MessageTally
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.extracts import RecordedPlan, parameter_text
from gateway.vehicle.plan import KINDS, Item

MAX_PARAM_FILE: Final = 4 << 20
"""Maximum size, bytes; a vehicle has about 1,500 parameters of 30 bytes each."""
FIXED_DECIMALS: Final = 6
"""Decimals of all values in MAVProxy's parameter files."""
FLOAT_STEP: Final = 2.0**-23
"""Relative difference of two consecutive single-precision floats."""
QGC_CELLS: Final = ("vehicle", "component", "name", "value", "type")
SECTIONS: Final = {"parameters": "parameter", "plans": "item", "figures": "figure", "texts": "text"}
"""Sections of a comparison, and the heading of their first column."""


@dataclass(slots=True)
class Contents:
    """The compared content of one side; a parameter file has parameters only."""

    name: str
    parameters: dict[str, str] = field(default_factory=dict)
    plans: dict[str, list[str]] = field(default_factory=dict)
    """Items as text, by kind of plan."""
    figures: dict[str, str] = field(default_factory=dict)
    texts: set[str] = field(default_factory=set)
    is_flight: bool = False
    rounded: dict[str, int] = field(default_factory=dict)
    """Number of decimals to which the value of a parameter may be rounded."""
    defaults: dict[str, str] = field(default_factory=dict)
    """Default values of parameters, where they are known."""
    meanings: dict[str, str] = field(default_factory=dict)

    def add_known(self, facts: Mapping[str, tuple[float, str]]) -> None:
        """Add the default and the meaning of parameters."""
        self.defaults |= {name: parameter_text(value) for name, (value, _) in facts.items()}
        self.meanings |= {name: meaning for name, (_, meaning) in facts.items()}


@dataclass(frozen=True, slots=True)
class Comparison:
    """The differences: the value on each side by name; empty if that side has none."""

    names: tuple[str, str]
    parameters: dict[str, tuple[str, str]]
    plans: dict[str, tuple[str, str]]
    figures: dict[str, tuple[str, str]]
    """All figures, including equal ones."""
    texts: dict[str, tuple[str, str]]
    """Texts that only one side has."""
    known: dict[str, tuple[str, str]]
    """Default and meaning of the differing parameters, where either is known."""


def compare(first: Contents, second: Contents) -> Comparison:
    """Compare two sides; sections that one side cannot have are left out."""
    plans: dict[str, tuple[str, str]] = {}
    for kind in first.plans.keys() & second.plans.keys():
        items = (dict(enumerate(side.plans[kind])) for side in (first, second))
        numbered = ({f"{kind} {number}": text for number, text in one.items()} for one in items)
        plans |= _differences(*numbered)
    are_flights = first.is_flight and second.is_flight
    figures = {
        name: (first.figures.get(name, ""), second.figures.get(name, ""))
        for name in first.figures | second.figures
        if are_flights or (name in first.figures and name in second.figures)
    }
    only = (first.texts - second.texts, second.texts - first.texts)
    texts = {text: (text, "") for text in sorted(only[0])}
    texts |= {text: ("", text) for text in sorted(only[1])}
    rounded = first.rounded | second.rounded
    parameters = {
        name: pair
        for name, pair in _differences(first.parameters, second.parameters).items()
        if not (all(pair) and name in rounded and _is_rounded(*pair, rounded[name]))
    }
    defaults, meanings = first.defaults | second.defaults, first.meanings | second.meanings
    known = {name: (defaults.get(name, ""), meanings.get(name, "")) for name in parameters}
    return Comparison(
        (first.name, second.name),
        parameters,
        plans,
        figures,
        texts if are_flights else {},
        {name: pair for name, pair in known.items() if any(pair)},
    )


def _differences(first: Mapping[str, str], second: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    return {
        name: pair
        for name in sorted(first.keys() | second.keys())
        if (pair := (first.get(name, ""), second.get(name, "")))[0] != pair[1]
    }


def _is_rounded(first: str, second: str, decimals: int) -> bool:
    """Return whether two values are equal as floats that were rounded to some decimals."""
    one, other = float(first), float(second)
    return abs(one - other) <= 0.5 * 10.0**-decimals + FLOAT_STEP * abs(one)


def read_param_file(path: Path) -> Contents:
    """Read a parameter file of Mission Planner, MAVProxy or QGroundControl.

    Raises FlightError if it has no parameters, OSError if it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(MAX_PARAM_FILE)
    encoding = (
        "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    )
    lines = data.decode(encoding, "replace").splitlines()
    found = Contents(str(path))
    for line in lines:
        cells = line.split("#")[0].replace(",", " ").split()
        name, text = cells[2:4] if len(cells) == len(QGC_CELLS) else (*cells[:2], "", "")[:2]
        try:
            value = float(text)
        except ValueError:
            continue
        found.parameters[name] = parameter_text(value)
        if len(decimals := text.partition(".")[2]) >= FIXED_DECIMALS and decimals.isdigit():
            found.rounded[name] = len(decimals)
    if not found.parameters:
        raise FlightError(f"{path}: contains no parameters")
    return found


def read_recording(name: str, flight: FlightToWrite) -> Contents:
    """Read the compared content of a recording; raises FlightError if it has no vehicle."""
    vehicle_id = flight.vehicle_id  # first, as the senders of a table are those of its fusion
    tallies = MessageTally(flight.senders, vehicle_id)
    tallies.add_all(flight.answered())
    tally = tallies.vehicles[vehicle_id]
    found = contents_of(name, flight.plan)
    found.figures |= figures_of(tally.facts())
    found.texts, found.is_flight = {text for _, _, text in tally.texts}, True
    defaults = flight.defaults.items()
    found.defaults = {name: parameter_text(value) for name, value in defaults}
    return found


def figures_of(facts: FlightFacts) -> dict[str, str]:
    """Return the known figures of a flight as text."""
    found = {"duration": f"{facts.duration_s:.1f} s"}
    above = f"highest above {facts.height_above}"
    for name, value, form in (
        ("in the air", facts.airborne_s, ".1f s"),
        ("armed", facts.armed_s, ".1f s"),
        ("distance", facts.distance_m, ".0f m"),
        (above, facts.highest_m, ".1f m"),
        ("fastest", facts.fastest_mps, ".1f m/s"),
        *((f"charge used, battery {n}", mah, "d mAh") for n, mah in sorted(facts.used_mah.items())),
        ("greatest vibration", facts.vibration_mps2, ".1f m/s2"),
        ("fewest satellites", facts.satellites, "d"),
    ):
        number_form, _, unit = form.partition(" ")
        if value is not None:
            found[name] = f"{value:{number_form}} {unit}".rstrip()
    if facts.frames_received:
        share = facts.frames_lost / (facts.frames_lost + facts.frames_received)
        found["lost frames"] = f"{facts.frames_lost} ({share:.2%})"
    found["errors"] = str(facts.errors)
    return found


def contents_of(name: str, plan: RecordedPlan) -> Contents:
    """Return the compared content of a vehicle's answers."""
    return Contents(
        name,
        {each.name: parameter_text(each.value) for each in plan.parameters()},
        {name: [_item_text(item) for item in plan.items(kind)] for kind, name in KINDS.items()},
        _versions(plan),
    )


def _item_text(item: Item) -> str:
    numbers = " ".join(f"{value:.7f}".rstrip("0").rstrip(".") for value in item.numbers)
    return f"command {item.command}, frame {item.frame}: {numbers}"


def _versions(plan: RecordedPlan) -> dict[str, str]:
    fields: Mapping[str, Any] | None = plan.fields(AUTOPILOT_VERSION_ID)
    if fields is None:
        return {}
    version = fields["flight_sw_version"]
    return {
        "firmware": f"{version >> 24}.{version >> 16 & 0xFF}.{version >> 8 & 0xFF}",
        "hardware": f"{fields['vendor_id']}:{fields['product_id']}, {fields['board_version']}",
    }


def rows_of(found: Comparison, section: str) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the headings and the rows of one section."""
    rows: dict[str, tuple[str, str]] = getattr(found, section)
    heads = (SECTIONS[section], *found.names)
    if section != "parameters" or not found.known:
        return heads, [(name, *pair) for name, pair in rows.items()]
    more = ((name, *pair, *found.known.get(name, ("", ""))) for name, pair in rows.items())
    return (*heads, "default", "meaning"), list(more)


def as_html(found: Comparison) -> Iterator[str]:
    """Write a comparison as one self-contained page."""
    title = _escaped(" and ".join(found.names))
    yield f'<!doctype html><meta charset="utf-8"><title>{title}</title>'
    yield "<style>body{font-family:sans-serif}td,th{text-align:left;padding:2px 12px}</style>"
    for section in SECTIONS:
        yield f"<h2>{section.capitalize()}</h2>"
        yield from _html_table(*rows_of(found, section))


def _html_table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    yield f"<table><tr>{''.join(f'<th>{_escaped(head)}</th>' for head in heads)}</tr>\n"
    for row in rows:
        yield f"<tr>{''.join(f'<td>{_escaped(cell)}</td>' for cell in row)}</tr>\n"
    yield "</table>\n"


def _escaped(text: str) -> str:
    return html.escape(printable(text))
