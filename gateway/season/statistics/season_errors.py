"""The errors of a season's flights: by aircraft and estimator, and against another version."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.season.statistics.chance import Lead, lead_of

WORSE: Final = 1.05
WORSE_M: Final = 0.05
"""A flight counts as worse if its error grew by more than 5 % and 5 cm."""


@dataclass(frozen=True, slots=True)
class FlightErrors:
    """The errors of one flight."""

    place: str
    digest: str
    vehicle: int | None
    began: str | None
    held_m: Mapping[str, float]
    """At withheld fixes, by estimator."""

    @property
    def group(self) -> str:
        """Aircraft and day; a flight without a day is a group of its own."""
        return group_of(self.vehicle, self.began, self.digest)


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """The errors of one estimator on the flights of one aircraft."""

    vehicle: int | None
    """None for all aircraft together."""
    estimator: str
    flights: int
    median_m: float
    most_m: float
    """Nine flights in ten are better."""
    worst_m: float


@dataclass(frozen=True, slots=True)
class Change:
    """One flight, fused by two versions."""

    place: str
    estimator: str
    before_m: float
    after_m: float

    @property
    def is_worse(self) -> bool:
        """Whether it got worse by more than rounding and luck."""
        return self.after_m > self.before_m * WORSE and self.after_m > self.before_m + WORSE_M


@dataclass(frozen=True, slots=True)
class Versus:
    """A season against the same flights of another version."""

    leads: dict[str, Lead]
    """Of now over then, by estimator."""
    worse: list[Change]
    """The worst first."""
    compared: int
    """Flights that both have."""


def group_of(vehicle: int | None, began: str | None, digest: str) -> str:
    """Name the aircraft and day of a flight, which share weather and the state of the sensors."""
    return f"{vehicle} {began[:10] if began else digest}"


def errors_by_group(flights: Iterable[FlightErrors]) -> list[GroupErrors]:
    """Sum errors up: all aircraft together first, then each."""
    found: dict[tuple[int | None, str], list[float]] = defaultdict(list)
    vehicles: set[int | None] = set()
    for flight in flights:
        vehicles.add(flight.vehicle)
        for estimator, error_m in flight.held_m.items():
            found[flight.vehicle, estimator].append(error_m)
            if flight.vehicle is not None:
                found[None, estimator].append(error_m)
    if len(vehicles) == 1:
        found = {key: errors for key, errors in found.items() if key[0] is not None} or found
    return [
        GroupErrors(
            vehicle,
            estimator,
            len(errors),
            float(np.median(errors)),
            float(np.quantile(errors, 0.9)),
            max(errors),
        )
        for (vehicle, estimator), errors in sorted(
            found.items(), key=lambda entry: (entry[0][0] or 0, entry[0][1])
        )
    ]


def versus(now: Iterable[FlightErrors], then: Iterable[FlightErrors]) -> Versus:
    """Compare the flights that both have, by the digests of their files."""
    before = {flight.digest: flight for flight in then}
    both = [(flight, before[flight.digest]) for flight in now if flight.digest in before]
    leads: dict[str, Lead] = {}
    changes: list[Change] = []
    for estimator in sorted(
        {name for flight, old in both for name in flight.held_m if name in old.held_m}
    ):
        pairs = [(f, o) for f, o in both if estimator in f.held_m and estimator in o.held_m]
        after = np.array([flight.held_m[estimator] for flight, _ in pairs])
        old = np.array([flight.held_m[estimator] for _, flight in pairs])
        lead = lead_of(after, old, [flight.group for flight, _ in pairs])
        if lead is not None:
            leads[estimator] = lead
        changes += [
            Change(f.place, estimator, o.held_m[estimator], f.held_m[estimator]) for f, o in pairs
        ]
    worse = [change for change in changes if change.is_worse]
    return Versus(leads, sorted(worse, key=lambda c: c.before_m / c.after_m), len(both))
