"""The chain of edits between the files that are read and the tlog that is written."""

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.recordings.files import FlightError
from gateway.recordings.tlog import encode_record
from gateway.recordings.tlog_source import TlogSource
from gateway.recordings.workshop.selection import (
    NOTHING_WITHIN,
    ChosenState,
    FrameChoice,
    Limits,
    StateChoice,
    while_in_state,
    within,
)
from gateway.units import counted
from gateway.vehicle_state.senders import Senders
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import MESSAGE_NAMES, ids_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from gateway.wire.recorded_frames import Batch, fields_of
from gateway.wire.system_ids import FIELDS, LAST_ID, rename_systems

BoolArray = NDArray[np.bool_]

NOTHING_LEFT: Final = "no record matches all of these options"
PARAMETER_IDS: Final = ids_of("PARAM_VALUE", "PARAM_SET")
ID_PARAMETERS: Final = frozenset({
    "SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID", "SYSID_MYGCS", "MAV_GCS_SYSID", "FOLL_SYSID",
})  # fmt: skip
"""Parameters of ArduPilot and PX4 that are system ids."""


class FrameEdit:
    """One link of a chain of edits."""

    def __init__(self) -> None:
        self.left_out: Counter[tuple[str, str]] = Counter()
        """Number of frames left out, by message and by the reason within the message."""

    def prepare(self, sources: Sequence[TlogSource], choice: FrameChoice) -> None:
        """Read the files, of which a choice is edited, before the first frame."""

    def retimed(self, batch: Batch) -> Batch:
        """Return the next batch with the times that its records shall have."""
        return batch

    def affects(self, batch: Batch) -> BoolArray:
        """Return which frames may change."""
        raise NotImplementedError

    def edit(self, frame: bytes) -> bytes | None:
        """Return the edited frame; None if it must be left out."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class TlogEdits:
    """The links of a chain; the memory needed does not depend on the size of the files."""

    limits: Limits = (None, None)
    choice: FrameChoice = field(default_factory=FrameChoice)
    state: StateChoice | None = None
    """If given, keep only the time while a vehicle is in a state."""
    merge: bool | None = None
    """Leave out copies of frames that are in several files; default: if the files overlap."""
    frames: tuple[FrameEdit, ...] = ()
    """Edits of each frame, in their order."""

    @property
    def are_none(self) -> bool:
        """Whether the records are not edited, but perhaps cut."""
        return self == TlogEdits(self.limits, merge=self.merge)

    @property
    def left_out(self) -> int:
        """Number of frames that the edits have left out so far."""
        return sum(edit.left_out.total() for edit in self.frames)

    def chosen(
        self,
        batches: Iterable[Batch],
        senders: Senders,
        remark: Callable[[str], None],
        counted_id: int | None = None,
    ) -> Iterator[Batch]:
        """Yield the selected records, not edited; raises FlightError if no record is left.

        The remark on their number counts those of one message if it is given.
        """
        total = kept = of_message = 0

        def all_records() -> Iterator[Batch]:
            nonlocal total
            for batch in batches:
                total += len(batch)
                yield batch

        cut: Iterable[Batch] = within(all_records(), self.limits)
        state = None
        if self.state is not None:
            state = ChosenState(senders, self.state, self.choice.systems)
            cut = while_in_state(cut, state)
        for batch in map(self.choice.apply, cut):
            kept += len(batch)
            of_message += int(np.count_nonzero(batch.message_ids == counted_id))
            yield batch
        unknown = "" if state is None else state.unknown
        if not kept:
            is_cut = self.limits != (None, None) and self.are_none
            raise FlightError(unknown or (NOTHING_WITHIN if is_cut else NOTHING_LEFT))
        if unknown:
            remark(unknown)
        if not self.are_none:
            kept = kept - self.left_out if counted_id is None else of_message
            remark(f"kept {kept} of {counted(total, 'record')}")

    def edited(self, batch: Batch) -> bytes:
        """Return the records of a batch after all edits of frames; others keep their bytes."""
        affected = [edit.affects(batch) for edit in self.frames]
        for edit in self.frames:
            batch = edit.retimed(batch)
        if not len(batch) or not np.any(affected):
            return batch.encoded()
        pieces = []
        is_affected = np.any(affected, axis=0).tolist()
        for record, may_change in zip(batch.records(), is_affected, strict=True):
            frame: bytes | None = record.frame
            for edit in self.frames if may_change else ():
                frame = None if frame is None else edit.edit(frame)
            if frame is not None:
                pieces.append(encode_record(record.time_us, frame))
        return b"".join(pieces)


class Renumbering(FrameEdit):
    """Change system ids in headers, and in all fields and parameters that contain one.

    `merge` allows that two systems of the recording get the same id.
    """

    def __init__(self, system_ids: Mapping[int, int], *, merge: bool = False) -> None:
        super().__init__()
        self._system_ids, self._merge = system_ids, merge

    def prepare(self, sources: Sequence[TlogSource], choice: FrameChoice) -> None:
        """Raise FlightError if two systems would get the same id."""
        systems = {origin >> 8 for source in sources for origin in source.senders.origins}
        systems &= choice.systems or systems
        given: dict[int, int] = {}
        for system in sorted(systems):
            new = self._system_ids.get(system, system)
            if new in given and not self._merge:
                raise FlightError(
                    f"--as: systems {given[new]} and {system} of the recording would both be "
                    f"system {new}; give one of them another id, or use --merge-systems"
                )
            given[new] = system

    def affects(self, batch: Batch) -> BoolArray:
        """Return which records may contain a system id that changes."""
        is_from: BoolArray = np.isin(batch.origins >> 8, [*self._system_ids])
        return is_from | np.isin(batch.message_ids, [*FIELDS, *PARAMETER_IDS])

    def edit(self, frame: bytes) -> bytes | None:
        """Return a frame with changed ids; None for an unknown message, as its CRC is unknown."""
        read = frame_of(frame)
        sender = self._renamed(read.origin[0])
        found = rename_systems(read, sender, self._renamed, drop_signature=True)
        if found is None:
            unknown = f"unknown message {read.message_id}"
            self.left_out[MESSAGE_NAMES.get(read.message_id, unknown), ""] += 1
            return None
        return self._with_parameter(found) if read.message_id in PARAMETER_IDS else found.data

    def _with_parameter(self, frame: MavFrame) -> bytes:
        """Return a frame whose parameter follows, if it is a system id."""
        fields = fields_of(frame.data)
        value = fields["param_value"]
        if text_of(fields["param_id"]) not in ID_PARAMETERS:
            return frame.data
        # PX4 sends integers as their bytes.
        (whole,) = struct.unpack("<i", struct.pack("<f", value))
        new = float(self._renamed(int(value))) if value in range(LAST_ID + 1) else value
        if whole in range(1, LAST_ID + 1):
            (new,) = struct.unpack("<f", struct.pack("<i", self._renamed(whole)))
        edited = edit_frame(frame, fields={"param_value": new})
        return frame.data if edited is None else edited.data

    def _renamed(self, system_id: int) -> int:
        return self._system_ids.get(system_id, system_id)
