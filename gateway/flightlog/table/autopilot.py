"""Read a flight from any autopilot's MAVLink, so that it can be fused here.

The IMU comes from the best of HIGHRES_IMU (floats), RAW_IMU as ArduPilot sends it (the units of
SCALED_IMU) and SCALED_IMU; once one was seen, poorer ones are left out. The axes are body FRD by
definition. Time is the vehicle's own (`time_usec`, `time_boot_ms`), less the first one seen; it
never falls within a kind of message. The IMU keeps its own time whatever the others say: theirs may
be of another clock, as a GPS receiver's.

GPS_RAW_INT has no velocity down: it is GLOBAL_POSITION_INT's, or unknown. Heights do not tell it,
for that of a receiver that finds or loses its fix jumps by any amount. Of what the autopilot itself
believes (ATTITUDE, with the place known then) the last before each sample is kept.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.compiled.entry_point import dispatched
from gateway.flightlog.table.autopilot_cells import (
    UNIX_YEAR_2000_US,
    baro_cells,
    gps_cells,
    imu_cells,
    nav_cells,
)
from gateway.flightlog.table.cells import FloatArray
from gateway.flightlog.table.row import BARO, COLUMNS, GPS, NAV, SI
from gateway.flightlog.tlog.payload_columns import columns_of, layout_of
from gateway.flightlog.tlog.tlog import Batch
from gateway.flightlog.tlog.tlog_scan import IntArray
from gateway.units import US_PER_S

VELOCITY_AGE_US: Final = US_PER_S // 2
"""An older velocity down is not used."""

ATTITUDE: Final = mavlink.MAVLINK_MSG_ID_ATTITUDE
POSITION: Final = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
PRESSURE: Final = mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE
FIX: Final = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT
IMU_RANK: Final = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 3,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 2,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 1,
}
_WANTED: Final = np.array([*IMU_RANK, ATTITUDE, POSITION, PRESSURE, FIX])
_PLACE: Final = layout_of(mavlink.mavlink_map[POSITION])

_STREAMS: Final = {FIX: 1, PRESSURE: 2, ATTITUDE: 3}
"""What has a clock of its own besides the IMU, which is 0."""

_BARO, _GPS, _IMU = 1, 2, 3
"""The order of a row: what is not behind its predecessor in it begins a row."""
_HEAD: Final = slice(0, 4)


class AutopilotReader:
    """Turn one vehicle's messages into rows of a table.

    Parameters
    ----------
    system_id : int or None
        Whose; the first system that sends an IMU message by default.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self.system_id = system_id
        self.unix_us_at_zero: int | None = None
        """Civil time of the rows' time zero, by the times of the recording."""
        self._rank = 0
        self._zero_us = np.zeros(2, np.int64)
        """What the vehicle's own time, and that of the recording, were at the rows' zero."""
        self._newest_us = np.zeros(1 + len(_STREAMS), np.int64)
        """Of each stream, on the rows' clock."""
        self._sampled_us = np.zeros(1, np.int64)
        """When the newest IMU sample was recorded, or what was first."""
        self._places = np.empty(0, _PLACE)
        self._places_us = np.empty(0, np.int64)
        """The newest GLOBAL_POSITION_INT, if any, and when it was recorded."""
        self._state = np.full((1, NAV.stop - NAV.start), np.nan)
        """What the autopilot believed last; NaN once a sample has it."""
        self._open = np.empty((0, len(COLUMNS)))
        """The row that waits for its sample, if any."""

    def feed(self, batch: Batch) -> FloatArray:
        """Take the next records of the recording, of which every checksum was checked.

        Parameters
        ----------
        batch : Batch
            The one after the last.

        Returns
        -------
        ndarray, shape (n, len(COLUMNS))
            The rows that are complete now; see `gateway.flightlog.table.cells`.
        """
        taken = self._taken(batch)
        message_ids, recorded_us = batch.message_ids[taken], batch.time_us[taken]
        fields = {
            int(one): columns_of(batch, taken[message_ids == one], mavlink.mavlink_map[int(one)])
            for one in np.unique(message_ids)
        }
        time_us = self._times(message_ids, recorded_us, fields)
        places = self._places_at(message_ids, recorded_us, fields)
        states = self._states_at(message_ids, time_us, places, fields)
        return self._rows(message_ids, time_us, places, states, fields)

    def flush(self) -> FloatArray:
        """Return the row that still waits for a sample, if any, without one."""
        rows, self._open = self._open, self._open[:0]
        return rows

    def _taken(self, batch: Batch) -> IntArray:
        """Choose what is of the vehicle, and no poorer than others of its kind."""
        wanted = np.flatnonzero(np.isin(batch.message_ids, _WANTED))
        ranks = np.zeros(len(wanted), np.int64)
        for message_id, rank in IMU_RANK.items():
            ranks[batch.message_ids[wanted] == message_id] = rank
        if self.system_id is None:
            first = np.flatnonzero(ranks)[:1]
            if not len(first):
                return wanted[:0]
            self.system_id = int(batch.origins[wanted[first[0]]]) >> 8
            wanted, ranks = wanted[first[0] :], ranks[first[0] :]
        own = batch.origins[wanted] == self.system_id << 8 | 1
        wanted, ranks = wanted[own], ranks[own]
        best = np.maximum.accumulate(np.concatenate([[self._rank], ranks]))
        self._rank = int(best[-1])
        taken: IntArray = wanted[(ranks == 0) | (ranks >= best[:-1])]
        return taken

    def _times(
        self, message_ids: IntArray, recorded_us: IntArray, fields: dict[int, NDArray[np.void]]
    ) -> IntArray:
        """Put messages on the rows' clock."""
        own_us = np.zeros(len(message_ids), np.int64)
        for message_id, values in fields.items():
            if "time_usec" in (values.dtype.names or ()):
                told = values["time_usec"]
                own = np.where(told > UNIX_YEAR_2000_US, 0, told).astype(np.int64)
            else:
                own = values["time_boot_ms"].astype(np.int64) * 1000
            own_us[message_ids == message_id] = own
        clocked = message_ids != POSITION
        if self.unix_us_at_zero is None and clocked.any():
            first = int(np.argmax(clocked))
            self.unix_us_at_zero = int(recorded_us[first])
            self._zero_us[:] = own_us[first] or recorded_us[first], recorded_us[first]
            self._sampled_us[0] = recorded_us[first]
        own_us[~clocked] = -1
        streams = np.zeros(len(message_ids), np.int64)
        for message_id, stream in _STREAMS.items():
            streams[message_ids == message_id] = stream
        return _on_clock(
            streams, own_us, recorded_us, self._zero_us, self._newest_us, self._sampled_us
        )

    def _places_at(
        self, message_ids: IntArray, recorded_us: IntArray, fields: dict[int, NDArray[np.void]]
    ) -> tuple[NDArray[np.void], IntArray]:
        """Return all GLOBAL_POSITION_INT, and which was known at each message; -1 for none."""
        is_place = message_ids == POSITION
        known = len(self._places)
        places = np.concatenate([self._places, fields.get(POSITION, np.empty(0, _PLACE))])
        places_us = np.concatenate([self._places_us, recorded_us[is_place]])
        at = np.cumsum(is_place) - 1 + known
        if len(places):
            is_old = np.abs(recorded_us - places_us[at]) > VELOCITY_AGE_US
            at = np.where(is_old, -1, at)
        self._places, self._places_us = places[-1:], places_us[-1:]
        return places, at

    def _states_at(
        self,
        message_ids: IntArray,
        time_us: IntArray,
        places: tuple[NDArray[np.void], IntArray],
        fields: dict[int, NDArray[np.void]],
    ) -> FloatArray:
        """Return what the autopilot believed at each sample; NaN where it told nothing new."""
        is_state, is_imu = message_ids == ATTITUDE, np.isin(message_ids, [*IMU_RANK])
        newest = np.cumsum(is_state)
        # Of states that come one behind another the last counts; the end of all is a sample too.
        at = np.append(newest[is_imu], newest[-1:] if len(newest) else 0)
        before = np.concatenate([[0], at[:-1]])
        chosen = np.flatnonzero(is_state)[at[at > before] - 1]
        values = fields.get(ATTITUDE)
        states = np.full((len(at), NAV.stop - NAV.start), np.nan)
        if values is not None:
            values = values[at[at > before] - 1]
            states[at > before] = nav_cells(values, time_us[chosen], places[0], places[1][chosen])
        if not at[0]:
            states[0] = self._state[0]
        self._state = states[-1:]
        return states[:-1]

    def _rows(
        self,
        message_ids: IntArray,
        time_us: IntArray,
        places: tuple[NDArray[np.void], IntArray],
        states: FloatArray,
        fields: dict[int, NDArray[np.void]],
    ) -> FloatArray:
        kinds = np.select(
            [message_ids == PRESSURE, message_ids == FIX, np.isin(message_ids, [*IMU_RANK])],
            [_BARO, _GPS, _IMU],
        )
        waiting = [k for k, group in ((_BARO, BARO), (_GPS, GPS)) if self._holds(group)]
        order = np.concatenate([np.array(waiting, np.int64), kinds[kinds > 0]])
        numbers = np.cumsum(np.diff(order, prepend=_IMU) <= 0)
        row_of = np.full(len(message_ids), -1)
        row_of[kinds > 0] = numbers[len(waiting) :] - 1
        rows = np.full((numbers[-1] if len(numbers) else 0, len(COLUMNS)), np.nan)
        rows[: len(self._open)] = self._open
        for message_id, values in fields.items():
            here = message_ids == message_id
            row, now_us = row_of[here], time_us[here]
            if message_id == PRESSURE:
                rows[row, BARO] = baro_cells(values, now_us)
            elif message_id == FIX:
                rows[row, GPS] = gps_cells(values, now_us, places[0], places[1][here])
            elif message_id in IMU_RANK:
                rows[row, _HEAD], rows[row, SI] = imu_cells(message_id, values, now_us)
        rows[row_of[kinds == _IMU], NAV] = states
        has_sample = np.isin(np.arange(len(rows)), row_of[kinds == _IMU])
        told_us = np.where(np.isnan(rows[:, GPS.start]), rows[:, BARO.start], rows[:, GPS.start])
        rows[~has_sample, 0] = told_us[~has_sample]
        whole = len(rows) - (len(rows) > 0 and not has_sample[-1])
        self._open = rows[whole:]
        return rows[:whole]

    def _holds(self, group: slice) -> bool:
        return len(self._open) > 0 and not np.isnan(self._open[0, group.start])


@dispatched
def _on_clock(
    streams: IntArray,
    own_us: IntArray,
    recorded_us: IntArray,
    zero_us: IntArray,
    newest_us: IntArray,
    sampled_us: IntArray,
) -> IntArray:
    """Give each message its time since zero.

    Parameters
    ----------
    streams : ndarray, shape (n,)
        0 for the IMU, or of `_STREAMS`.
    own_us : ndarray, shape (n,)
        By the vehicle; 0 where it tells none, less for a message that has no time.
    recorded_us : ndarray, shape (n,)
    zero_us : ndarray, shape (2,)
        The vehicle's time at zero, and that of the recording.
    newest_us : ndarray, shape (4,)
        The newest time of each stream, which is changed.
    sampled_us : ndarray, shape (1,)
        When the newest IMU sample was recorded, which is changed.
    """
    found = np.empty_like(own_us)
    for i in range(len(own_us)):
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
    return found
