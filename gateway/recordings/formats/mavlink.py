"""Read a flight from any autopilot's MAVLink, so that it can be fused here.

The IMU samples come from the best of HIGHRES_IMU (floats), RAW_IMU as ArduPilot sends it (in the
units of SCALED_IMU) and SCALED_IMU; once one was received, inferior ones are left out. The axes are
body FRD by definition. Time is the vehicle's own (`time_usec`, `time_boot_ms`), minus the first one
received; see `VehicleClock`.

GPS_RAW_INT has no down velocity: that of GLOBAL_POSITION_INT is used, or it is unknown. It is not
derived from heights, because a receiver's height jumps by any amount when it gains or loses its
fix. Of the autopilot's own estimates (ATTITUDE, with the position known at that time) the last one
before each sample is kept.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import from_euler_array
from gateway.recordings.columns import BARO, COLUMNS, GPS, LARGEST_WHOLE, NAV, SI, FloatArray
from gateway.recordings.formats.csv import level_velocity
from gateway.recordings.recorded_clock import FIRST_CIVIL_US, VehicleClock
from gateway.records import NAN, GpsFixType, ImuFlags, NavFlags
from gateway.units import (
    DEG_PER_DEGE7,
    FIX_2D,
    PA_PER_HPA,
    STANDARD_GRAVITY_MPS2,
    US_PER_S,
    UT_PER_GAUSS,
)
from gateway.vehicle_state.positions import is_located
from gateway.vehicle_state.senders import Senders
from gateway.wire.mavlink_messages import layout_of
from gateway.wire.recorded_frames import Batch, IntArray, columns_of

MILLI: Final = 1e-3
CENTI: Final = 1e-2
DEG_PER_HDG_ACC: Final = 1e-5
UNKNOWN_U16: Final = 65535
UNKNOWN_U8: Final = 255
MAG_FIELDS: Final = 0b111 << 6
"""Bits of the magnetometer in `fields_updated` of HIGHRES_IMU."""
FIX_3D: Final = 3
GPS_NODE: Final = 1

Fields = NDArray[np.void]

_ATTITUDE_FLAGS: Final = int(NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID)
_POSITION_FLAGS: Final = int(
    NavFlags.POSITION_VALID | NavFlags.VELOCITY_VALID | NavFlags.ALTITUDE_VALID
)
VELOCITY_AGE_US: Final = US_PER_S // 2
"""Maximum age of a down velocity that is used."""
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
_POSITION_LAYOUT: Final = layout_of(POSITION)
_OWN_CLOCKS: Final = frozenset({FIX, PRESSURE, ATTITUDE})
"""Kinds of messages whose times may be from another clock than the IMU's."""
_BARO, _GPS, _IMU = 1, 2, 3
"""Order of the records in a row; a record out of this order begins a new row."""
_HEAD: Final = slice(0, 4)


def imu_cells(message_id: int, values: Fields, time_us: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the cells of `HEAD_COLUMNS` and `SI_COLUMNS` for one of the three IMU messages."""
    if message_id == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU:
        accel, gyro, mag = _vectors(values, 1.0, 1.0, UT_PER_GAUSS)
        temperature_degc = values["temperature"].astype(np.float64)
        may_be_new = (values["fields_updated"] & MAG_FIELDS) != 0
    else:
        g, mgauss = STANDARD_GRAVITY_MPS2 * MILLI, UT_PER_GAUSS * MILLI
        accel, gyro, mag = _vectors(values, g, MILLI, mgauss)
        temperature_degc = _unless_zero(values["temperature"], CENTI)
        may_be_new = np.ones(len(values), bool)
    is_new = may_be_new & (mag != 0.0).any(axis=1)
    mag[~is_new] = np.nan
    flags = np.where(is_new, float(ImuFlags.MAG_NEW), 0.0)
    nothing = np.full(len(values), np.nan)
    head = np.column_stack([time_us, np.zeros(len(values)), nothing, flags])
    return head, np.column_stack([accel, gyro, mag, temperature_degc])


def baro_cells(values: Fields, time_us: IntArray) -> FloatArray:
    """Return the cells of `BARO_COLUMNS` for SCALED_PRESSURE."""
    pressure_pa = values["press_abs"].astype(np.float64) * PA_PER_HPA
    temperature_degc = values["temperature"] * CENTI
    node = np.zeros(len(values))
    return np.column_stack([time_us, node, time_us, pressure_pa, temperature_degc])


def gps_cells(
    values: Fields, time_us: IntArray, positions: Fields, position_at: IntArray
) -> FloatArray:
    """Return the cells of GPS_RAW_INT; `position_at` is the index in `positions`, -1 for none."""
    reported = np.minimum(values["fix_type"], FIX_3D)
    fix_type = np.select(
        [reported == FIX_2D, reported == FIX_3D],
        [int(GpsFixType.FIX_2D), int(GpsFixType.FIX_3D)],
        int(GpsFixType.NONE),
    )
    has_fix = fix_type != int(GpsFixType.NONE)
    satellites = values["satellites_visible"]
    utc_us = values["time_usec"]
    is_civil = (utc_us > FIRST_CIVIL_US) & (utc_us <= LARGEST_WHOLE)
    down_mps = _of_position(positions, np.where(reported == FIX_3D, position_at, -1), "vz", CENTI)
    speed_mps = np.where(has_fix, _known(values["vel"], CENTI), np.nan)
    north_mps, east_mps = level_velocity(speed_mps, _known(values["cog"], CENTI))
    return np.column_stack(
        [
            time_us,
            np.full(len(values), GPS_NODE),
            time_us,
            np.zeros(len(values)),
            fix_type,
            has_fix,
            np.where(satellites == UNKNOWN_U8, 0, satellites),
            values["lat"],
            values["lon"],
            values["alt"] * MILLI,
            *(north_mps, east_mps, down_mps),
            _unless_zero(values["alt_ellipsoid"], MILLI),
            _unless_zero(values["h_acc"], MILLI),
            _unless_zero(values["v_acc"], MILLI),
            _unless_zero(values["vel_acc"], MILLI),
            _unless_zero(values["hdg_acc"], DEG_PER_HDG_ACC),
            _known(values["eph"], CENTI),
            np.where(is_civil, utc_us.astype(np.float64), np.nan),
        ]
    )


def nav_cells(
    values: Fields, time_us: IntArray, positions: Fields, position_at: IntArray
) -> FloatArray:
    """Return the cells of `NAV_COLUMNS` for ATTITUDE; the positions are as for `gps_cells`."""
    angles = [values[name].astype(np.float64) for name in ("roll", "pitch", "yaw")]
    rates = [values[name] for name in ("rollspeed", "pitchspeed", "yawspeed")]
    flags = np.where(position_at >= 0, _ATTITUDE_FLAGS | _POSITION_FLAGS, _ATTITUDE_FLAGS)
    return np.column_stack(
        [
            time_us,
            from_euler_array(np.column_stack(angles)),
            *rates,
            _of_position(positions, position_at, "lat", DEG_PER_DEGE7),
            _of_position(positions, position_at, "lon", DEG_PER_DEGE7),
            _of_position(positions, position_at, "alt", MILLI),
            *(_of_position(positions, position_at, name, CENTI) for name in ("vx", "vy", "vz")),
            np.full((len(values), 9), np.nan),
            flags,
        ]
    )


def _vectors(values: Fields, *scales: float) -> list[FloatArray]:
    """Return acceleration, angular rate and magnetic field, each multiplied by its scale."""
    return [
        np.column_stack([values[axis + name].astype(np.float64) for axis in "xyz"]) * scale
        for name, scale in zip(("acc", "gyro", "mag"), scales, strict=True)
    ]


def _known(values: NDArray[np.uint16], scale: float) -> FloatArray:
    return np.where(values == UNKNOWN_U16, NAN, values * scale)


def _unless_zero(values: NDArray[np.int32], scale: float) -> FloatArray:
    return np.where(values == 0, NAN, values * scale)


def _of_position(positions: Fields, position_at: IntArray, name: str, scale: float) -> FloatArray:
    """Return a field of the last position known at each time; NaN if there was none."""
    found = np.full(len(position_at), np.nan)
    known = position_at >= 0
    found[known] = positions[name][position_at[known]] * scale
    return found


class AutopilotReader:
    """Convert one vehicle's messages to rows of a table."""

    def __init__(self, system_id: int | None = None, senders: Senders | None = None) -> None:
        self.system_id = system_id
        self._senders = senders or Senders()
        self._rank = 0
        self._clock = VehicleClock()
        self._positions = np.empty(0, _POSITION_LAYOUT)
        self._positions_us = np.empty(0, np.int64)
        """The newest GLOBAL_POSITION_INT, if any, and its recorded time."""
        self._state = np.full((1, NAV.stop - NAV.start), np.nan)
        """The newest estimate of the autopilot; NaN once it is stored with a sample."""
        self._open = np.empty((0, len(COLUMNS)))
        """The row that is still without its sample, if any."""

    @property
    def unix_us_at_zero(self) -> int | None:
        """Civil time of the rows' time zero, from the recorded times."""
        return self._clock.unix_us_at_zero

    def feed(self, batch: Batch) -> FloatArray:
        """Process the next records of the recording; their checksums must have been verified."""
        taken = self._chosen(batch)
        message_ids, recorded_us = batch.message_ids[taken], batch.time_us[taken]
        fields = {
            int(one): columns_of(batch, taken[message_ids == one], int(one))
            for one in np.unique(message_ids)
        }
        time_us = self._times(message_ids, recorded_us, fields)
        positions = self._positions_at(message_ids, recorded_us, fields)
        states = self._states_at(message_ids, time_us, positions, fields)
        return self._rows(message_ids, time_us, positions, states, fields)

    def flush(self) -> FloatArray:
        """Return the row that is still without its sample, if any."""
        rows, self._open = self._open, self._open[:0]
        return rows

    def _chosen(self, batch: Batch) -> IntArray:
        """Choose the vehicle's messages; of each kind only the best type received so far."""
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
        own = batch.origins[wanted] == self._senders.vehicle(self.system_id).origin
        wanted, ranks = wanted[own], ranks[own]
        best = np.maximum.accumulate(np.concatenate([[self._rank], ranks]))
        self._rank = int(best[-1])
        taken: IntArray = wanted[(ranks == 0) | (ranks >= best[:-1])]
        return taken

    def _times(
        self, message_ids: IntArray, recorded_us: IntArray, fields: dict[int, NDArray[np.void]]
    ) -> IntArray:
        own_us = np.zeros(len(message_ids), np.int64)
        for message_id, values in fields.items():
            if "time_usec" in (values.dtype.names or ()):
                sent = values["time_usec"]
                own = np.where(sent > FIRST_CIVIL_US, 0, sent).astype(np.int64)
            else:
                own = values["time_boot_ms"].astype(np.int64) * 1000
            own_us[message_ids == message_id] = own
        time_us = np.zeros(len(message_ids), np.int64)
        columns = (message_ids.tolist(), own_us.tolist(), recorded_us.tolist())
        for k, (kind, *times_us) in enumerate(zip(*columns, strict=True)):
            if kind != POSITION:
                time_us[k] = self._clock.time_us(kind if kind in _OWN_CLOCKS else None, *times_us)
        return time_us

    def _positions_at(
        self, message_ids: IntArray, recorded_us: IntArray, fields: dict[int, NDArray[np.void]]
    ) -> tuple[NDArray[np.void], IntArray]:
        """Return all GLOBAL_POSITION_INT, and the last one before each message, -1 for none."""
        is_position = message_ids == POSITION
        known = len(self._positions)
        positions = np.concatenate(
            [self._positions, fields.get(POSITION, np.empty(0, _POSITION_LAYOUT))]
        )
        positions_us = np.concatenate([self._positions_us, recorded_us[is_position]])
        at = np.cumsum(is_position) - 1 + known
        if len(positions):
            is_old = np.abs(recorded_us - positions_us[at]) > VELOCITY_AGE_US
            is_known = is_located(positions["lat"][at], positions["lon"][at])
            at = np.where(is_old | ~is_known, -1, at)
        self._positions, self._positions_us = positions[-1:], positions_us[-1:]
        return positions, at

    def _states_at(
        self,
        message_ids: IntArray,
        time_us: IntArray,
        positions: tuple[NDArray[np.void], IntArray],
        fields: dict[int, NDArray[np.void]],
    ) -> FloatArray:
        """Return the estimate of the autopilot at each sample; NaN where there is none."""
        is_state, is_imu = message_ids == ATTITUDE, np.isin(message_ids, [*IMU_RANK])
        newest = np.cumsum(is_state)
        # Of several states in succession the last counts; the end of the batch acts as a sample.
        at = np.append(newest[is_imu], newest[-1:] if len(newest) else 0)
        before = np.concatenate([[0], at[:-1]])
        chosen = np.flatnonzero(is_state)[at[at > before] - 1]
        values = fields.get(ATTITUDE)
        states = np.full((len(at), NAV.stop - NAV.start), np.nan)
        if values is not None:
            values = values[at[at > before] - 1]
            states[at > before] = nav_cells(
                values, time_us[chosen], positions[0], positions[1][chosen]
            )
        if not at[0]:
            states[0] = self._state[0]
        self._state = states[-1:]
        return states[:-1]

    def _rows(
        self,
        message_ids: IntArray,
        time_us: IntArray,
        positions: tuple[NDArray[np.void], IntArray],
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
                rows[row, GPS] = gps_cells(values, now_us, positions[0], positions[1][here])
            elif message_id in IMU_RANK:
                rows[row, _HEAD], rows[row, SI] = imu_cells(message_id, values, now_us)
        rows[row_of[kinds == _IMU], NAV] = states
        has_sample = np.isin(np.arange(len(rows)), row_of[kinds == _IMU])
        newest_us = np.where(np.isnan(rows[:, GPS.start]), rows[:, BARO.start], rows[:, GPS.start])
        rows[~has_sample, 0] = newest_us[~has_sample]
        whole = len(rows) - (len(rows) > 0 and not has_sample[-1])
        self._open = rows[whole:]
        return rows[:whole]

    def _holds(self, group: slice) -> bool:
        return len(self._open) > 0 and not np.isnan(self._open[0, group.start])
