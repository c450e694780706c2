"""A kernel's state as bytes."""

from typing import Annotated

import numpy as np
import pytest

from gateway.estimation.record import FloatArray, filled_record, pack_record, unpack_record


class State:
    time_us: int
    bias: Annotated[FloatArray, (3,)]
    weight: float


class Renamed:
    time_us: int
    bias: Annotated[FloatArray, (3,)]
    gain: float


def test_unpacked_record_is_equal_bit_for_bit_and_writable() -> None:
    values = {"time_us": (1 << 62) + 1, "bias": [1 / 3, np.nan, -0.0], "weight": np.inf}
    record = filled_record(State, values)
    again = unpack_record(State, pack_record(record))
    assert pack_record(again) == pack_record(record)
    assert again.time_us == values["time_us"]
    again.weight = 1.0
    assert record.weight == np.inf


def test_bytes_of_another_layout_are_refused() -> None:
    mark, data = pack_record(filled_record(State, {"time_us": 1, "bias": 0.0, "weight": 2.0}))
    with pytest.raises(ValueError, match="another layout"):
        unpack_record(Renamed, (mark, data))
    with pytest.raises(ValueError, match="another layout"):
        unpack_record(State, (mark, data[:-8]))
