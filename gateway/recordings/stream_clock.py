"""The clock of a table that is read from an autopilot's messages.

Each kind of message is a stream that may have a clock of its own: the autopilot's, civil time, or
none. The IMU's stream sets the clock of the table, and the other streams are put on it.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import address_of, array_at
from gateway.compiled.entry_point import EntryPoint
from gateway.units import US_PER_S

IntArray = NDArray[np.int64]

STREAMS: Final = 4
"""The IMU, which is stream 0, and three others."""
_INT: Final = np.dtype(np.int64)


def times_on_clock(
    streams: IntArray,
    own_us: IntArray,
    recorded_us: IntArray,
    zero_us: IntArray,
    newest_us: IntArray,
    sampled_us: IntArray,
) -> IntArray:
    """Return the time of each message since the table's time zero; it grows within a stream.

    An `own_us` of 0 means that the message contains no time, less that its kind has none. `zero_us`
    is the vehicle's time at zero, and that of the recording; the newest time of each stream, and
    when the newest IMU sample was recorded, are changed.
    """
    found = np.empty_like(own_us)
    inputs = [np.ascontiguousarray(part, np.int64) for part in (streams, own_us, recorded_us)]
    places = [address_of(part) for part in (*inputs, zero_us, newest_us, sampled_us, found)]
    _times_on_clock(len(found), *places)
    return found


@EntryPoint
def _times_on_clock(
    count: int,
    streams_at: int,
    own_at: int,
    recorded_at: int,
    zero_at: int,
    newest_at: int,
    sampled_at: int,
    found_at: int,
) -> None:
    streams = array_at(streams_at, (count,), _INT)
    own_us = array_at(own_at, (count,), _INT)
    recorded_us = array_at(recorded_at, (count,), _INT)
    zero_us, newest_us = array_at(zero_at, (2,), _INT), array_at(newest_at, (STREAMS,), _INT)
    sampled_us, found = array_at(sampled_at, (1,), _INT), array_at(found_at, (count,), _INT)
    for i in range(count):
        stream = streams[i]
        if own_us[i] >= 0:
            told_us = recorded_us[i] if own_us[i] == 0 else own_us[i]
            elapsed_us = told_us - zero_us[0]
            if not 0 <= elapsed_us - newest_us[0] <= US_PER_S:
                # Another clock than the IMU's, or a restart: use the time of recording.
                if stream == 0:
                    elapsed_us = recorded_us[i] - zero_us[1]
                else:
                    # The two clocks drift apart, so only since the newest sample.
                    elapsed_us = newest_us[0] + max(recorded_us[i] - sampled_us[0], 0)
            newest_us[stream] = max(newest_us[stream], elapsed_us)
            if stream == 0:
                sampled_us[0] = recorded_us[i]
        found[i] = newest_us[stream]
