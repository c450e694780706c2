"""Columns out of payload bytes, field by field as pymavlink decodes each frame."""

import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.mavlink_messages import layout_of
from gateway.wire.recorded_frames import Batch, columns_of
from tests.kit.mavlink import frame_with
from tests.kit.recordings import batch_of, records_of

KINDS = sorted(mavlink.mavlink_map.items())
FRAMES = 3


def some_frames(message_id: int, kind: Any, chance: random.Random) -> list[bytes]:
    """Make frames whose payloads are whole or cut off, of both versions where there are two."""
    size = layout_of(kind.id).itemsize
    frames = []
    for _ in range(FRAMES):
        length = chance.choice((size, chance.randint(1, size)))
        version = chance.choice((1, 2)) if message_id < 256 else 2
        frames.append(frame_with(message_id, chance.randbytes(length), version=version))
    return frames


def scanned(frames: list[bytes]) -> Batch:
    batch = batch_of(records_of(frames))
    assert len(batch) == len(frames)
    return batch


@settings(max_examples=8)
@given(st.integers(0, 1 << 32))
def test_columns_of_every_message_match_pymavlink(seed: int) -> None:
    chance = random.Random(seed)
    link = mavlink.MAVLink(None)
    for message_id, kind in KINDS:
        frames = some_frames(message_id, kind, chance)
        rows = columns_of(scanned(frames), np.arange(FRAMES), kind.id)
        for frame, row in zip(frames, rows, strict=True):
            message = link.decode(bytearray(frame))
            for name in kind.ordered_fieldnames:
                if row[name].dtype.kind == "S":
                    text = getattr(message, f"_{name}_raw", None) or getattr(message, name)
                    expected = text.encode("latin-1") if isinstance(text, str) else text
                    assert row[name] == expected.rstrip(b"\0"), (kind.msgname, name)
                else:
                    expected = getattr(message, name)
                    same = np.array_equal(row[name].tolist(), expected, equal_nan=True)
                    assert same, (kind.msgname, name)


def test_only_requested_frames_are_read() -> None:
    kind = mavlink.MAVLink_heartbeat_message
    frames = [frame_with(0, bytes([n, 0, 0, 0, 6])) for n in range(4)]
    rows = columns_of(scanned(frames), np.array([1, 3]), kind.id)
    assert rows["custom_mode"].tolist() == [1, 3]
    assert rows["mavlink_version"].tolist() == [0, 0]
    assert len(columns_of(scanned(frames), np.array([], np.int64), kind.id)) == 0


@pytest.mark.parametrize("message_id", [0, 30, 331])
def test_extra_fields_at_the_end_are_ignored(message_id: int) -> None:
    """A later dialect may have added fields at the end."""
    kind = mavlink.mavlink_map[message_id]
    payload = bytes(range(1, layout_of(kind.id).itemsize + 1))
    rows = columns_of(scanned([frame_with(message_id, payload + b"\7\7")]), np.array([0]), kind.id)
    assert rows.tobytes() == payload
