"""Every kind of source: any chunks give the same records, and damage costs only what it hits."""

import struct
from functools import cache
from itertools import islice
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.records import NodeId
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.source_bytes import SOURCE_BYTES
from gateway.sources.kinds import make_decoder
from gateway.sources.settings import parse_source
from gateway.wire.framing import Fault
from tests.kit.payloads import ltm

LTM = b"".join(
    ltm(b"A", struct.pack("<hhh", n, -n, 10 * n)) + ltm(b"S", struct.pack("<HHBBB", n, 0, 0, 0, 9))
    for n in range(30)
)
KINDS = st.sampled_from(["ltm", *sorted(SOURCE_BYTES)])
TAIL, LONGEST_FRAME = 200, 64
"""Zeros behind the data, and bytes that may seem to begin a frame that is not complete."""
MOST_LOST = 4
"""Records of the frames that a damaged one covers or seems to begin."""


@cache
def flight(kind: str) -> bytes:
    if kind == "ltm":
        return LTM
    pieces = SOURCE_BYTES[kind](SimulatorSettings(), 1_790_000_000_000_000)
    return b"".join(piece.data for piece in islice(pieces, 30))


def decoded(kind: str, *chunks: bytes) -> list[Any]:
    decoder = make_decoder(parse_source(f"{kind}:stdin"), NodeId(1, 8))
    return [event for chunk in chunks for event in decoder.feed(chunk, 1_000_000)]


@given(KINDS, st.integers(1, 100))
def test_any_chunks_give_the_same_records(kind: str, size: int) -> None:
    data = flight(kind)
    chunks = [data[at : at + size] for at in range(0, len(data), size)]
    assert [*map(repr, decoded(kind, *chunks))] == [*map(repr, decoded(kind, data))]


NOISE = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([b"$TA", b"\x7e\x98\x10" * 9, b"\xff" * 40, b"$GPGGA,1,2*00\r\n"]),
)
"""Any bytes, and those of other protocols."""


@given(KINDS, st.floats(0.0, 0.999), st.integers(0, 255), NOISE)
def test_damage_anywhere_costs_few_records(
    kind: str, where: float, flip: int, noise: bytes
) -> None:
    data = bytearray(flight(kind))
    at = int(where * len(data))
    data[at] ^= flip
    data[at:at] = noise
    events, whole = decoded(kind, bytes(data), bytes(TAIL)), decoded(kind, flight(kind))
    found = [each for each in events if not isinstance(each, Fault)]
    # A post of a phone has many records.
    most_lost = 0.3 * len(found) if kind == "phone" else MOST_LOST
    assert len(whole) - len(found) <= most_lost
    if kind in ("crsf", "ltm"):
        # One byte of a checksum may be right by chance.
        assert len({*map(repr, found)} - {*map(repr, whole)}) <= 1
        dropped = sum(each.size for each in events if isinstance(each, Fault))
        assert dropped >= len(noise) + TAIL - LONGEST_FRAME


@pytest.mark.parametrize("kind", ["crsf", "ltm"])
def test_flipped_bit_gives_no_false_record(kind: str) -> None:
    data, whole = flight(kind)[:300], {*map(repr, decoded(kind, flight(kind)))}
    for at in range(len(data)):
        damaged = data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]
        found = {repr(each) for each in decoded(kind, damaged) if not isinstance(each, Fault)}
        assert found <= whole, at
