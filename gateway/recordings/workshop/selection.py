"""Select records of a tlog by sender, message, time, and state of a vehicle.

All functions take batches and return batches with fewer records; frames are not changed.
"""

import difflib
import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.files import FlightError
from gateway.recordings.moment import Moment, time_us_of
from gateway.vehicle_state.newest import HEARTBEAT_TIMEOUT_US
from gateway.vehicle_state.senders import Senders
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS
from gateway.wire.recorded_frames import Batch, columns_of
from gateway.wire.vehicle_types import mode_name

BoolArray = NDArray[np.bool_]

Limits = tuple[Moment | None, Moment | None]
NOTHING_WITHIN: Final = (
    "there is nothing between that begin and end; `mavgate info` shows the length"
)
MAX_MARGIN_S: Final = 600.0
"""Maximum margin before arming; its records are held in memory: about 30 MB at 50 kB/s."""
_LONG_AGO_US: Final = -(1 << 62)
_NEVER_US: Final = 1 << 62


@dataclass(frozen=True, slots=True)
class FrameChoice:
    """Selection of frames by sender and message; an empty set does not restrict."""

    systems: frozenset[int] = frozenset()
    components: frozenset[int] = frozenset()
    messages: frozenset[int] = frozenset()
    without: frozenset[int] = frozenset()
    """Ids of messages that are left out."""

    def apply(self, batch: Batch) -> Batch:
        """Return the batch with the selected frames only."""
        wanted = np.ones(len(batch), np.bool_)
        for values, chosen in (
            (batch.origins >> 8, self.systems),
            (batch.origins & 0xFF, self.components),
            (batch.message_ids, self.messages),
        ):
            if chosen:
                wanted &= np.isin(values, [*chosen])
        if self.without:
            wanted &= ~np.isin(batch.message_ids, [*self.without])
        return batch.chosen(wanted)


def message_ids_of(patterns: Iterable[str]) -> frozenset[int]:
    """Return the ids of messages given by id, name, or a pattern such as `CAMERA_*`.

    Raises FlightError if a pattern matches no message.
    """
    found: set[int] = set()
    for pattern in patterns:
        if pattern.isascii() and pattern.isdigit():
            found.add(int(pattern))
            continue
        name = pattern.upper()
        ids = {key for known, key in MESSAGE_IDS.items() if fnmatchcase(known, name)}
        if not ids:
            near = difflib.get_close_matches(name, MESSAGE_IDS, 1)
            hint = f"; did you mean {near[0]}?" if near else "; give its id if it is a vendor's"
            raise FlightError(f"no MAVLink message is named {pattern}{hint}")
        found |= ids
    return frozenset(found)


def within(batches: Iterable[Batch], limits: Limits) -> Iterator[Batch]:
    """Yield the records between two moments, both included."""
    begin, end = limits
    begin_us, end_us = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    first_us: int | None = None
    for batch in batches:
        if first_us is None and len(batch):
            first_us = int(batch.time_us[0])
            begin_us = begin_us if begin is None else time_us_of(begin, first_us)
            end_us = end_us if end is None else time_us_of(end, first_us)
        yield batch.chosen((batch.time_us >= begin_us) & (batch.time_us <= end_us))


@dataclass(frozen=True, slots=True)
class StateChoice:
    """Selection of the time while a vehicle is armed or in certain modes, with margins."""

    armed: bool = False
    modes: frozenset[str] = frozenset()
    """Names in upper case, or numbers as text; an empty set does not restrict."""
    margin_s: float = 0.0

    def includes(self, beat: Any, mode: tuple[str, str]) -> bool:
        """Return whether the time after a heartbeat with a mode of this name and number is kept."""
        is_armed = bool(beat["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        is_in_mode = not self.modes or not self.modes.isdisjoint(mode)
        return (is_armed or not self.armed) and is_in_mode


class ChosenState:
    """Whether any vehicle is in the selected state, from the heartbeats of the autopilots.

    A state ends `HEARTBEAT_TIMEOUT_US` after the last heartbeat. `systems` restricts it to these
    vehicles; if it is empty, to none.
    """

    def __init__(
        self, senders: Senders, choice: StateChoice, systems: frozenset[int] = frozenset()
    ) -> None:
        self.choice = choice
        self.modes: set[str] = set()
        """Modes that occurred, by name, or as a number without one."""
        self._senders, self._systems = senders, systems
        self._until_us: dict[int, int] = {}
        """End of the selected state, by sender."""

    @property
    def unknown(self) -> str:
        """Text about selected modes that did not occur; empty if there are none."""
        names = {part for mode in self.modes for part in mode.split()}
        missing = ", ".join(sorted(self.choice.modes - names))
        listed = ", ".join(sorted(self.modes))
        return missing and f"no vehicle was in mode {missing}; the modes are {listed or 'unknown'}"

    def during(self, batch: Batch) -> BoolArray:
        """Return for each record whether a vehicle is in the state at that time."""
        found = np.empty(len(batch), np.bool_)
        rows = np.flatnonzero(batch.message_ids == HEARTBEAT_ID)
        at = 0
        for row, beat in zip(rows.tolist(), columns_of(batch, rows, HEARTBEAT_ID), strict=True):
            origin = int(batch.origins[row])
            is_chosen = not self._systems or origin >> 8 in self._systems
            vehicle = self._senders.vehicle(origin >> 8)
            if not is_chosen or origin != vehicle.origin:
                continue
            found[at:row] = batch.time_us[at:row] <= self._end_us
            at = row
            number = int(beat["custom_mode"])
            name = mode_name(int(beat["autopilot"]), int(beat["type"]), number)
            mode = (name or vehicle.modes.get(number, ""), str(number))
            self.modes.add(" ".join(mode).strip())
            if self.choice.includes(beat, mode):
                self._until_us[origin] = int(batch.time_us[row]) + HEARTBEAT_TIMEOUT_US
            else:
                self._until_us.pop(origin, None)
        found[at:] = batch.time_us[at:] <= self._end_us
        return found

    @property
    def _end_us(self) -> int:
        return max(self._until_us.values(), default=_LONG_AGO_US)


def while_in_state(batches: Iterable[Batch], state: ChosenState) -> Iterator[Batch]:
    """Yield the records while a vehicle is in a state, with a margin before and after.

    Batches are held until their records are older than the margin.
    """
    margin_us = math.ceil(state.choice.margin_s * 1e6)
    held: deque[tuple[Batch, BoolArray]] = deque()
    newest_us = _LONG_AGO_US
    for batch in batches:
        if not len(batch):
            yield batch
            continue
        times, chosen = batch.time_us, state.during(batch)
        before = np.maximum.accumulate(np.where(chosen, times, newest_us))
        after = np.minimum.accumulate(np.where(chosen, times, _NEVER_US)[::-1])[::-1]
        newest_us = int(before[-1])
        first_us = int(after[0])
        for earlier, wanted in held:
            wanted |= earlier.time_us >= first_us - margin_us
        held.append((batch, (before >= times - margin_us) | (after <= times + margin_us)))
        while held and held[0][0].time_us[-1] < times[-1] - margin_us:
            earlier, wanted = held.popleft()
            yield earlier.chosen(wanted)
    for earlier, wanted in held:
        yield earlier.chosen(wanted)
