"""An autopilot's messages read one by one: what the reader of whole batches is compared with."""

import math
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import common as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.recordings.columns import Imported
from gateway.records import (
    NAN,
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    NavFlags,
    NavState,
    NodeId,
    Vec3,
)
from gateway.units import DEG_PER_DEGE7, PA_PER_HPA, STANDARD_GRAVITY_MPS2, US_PER_S
from gateway.wire.mavlink_splitter import message_id_of, origin_of

UT_PER_GAUSS: Final = 100.0
MILLI: Final = 1e-3
CENTI: Final = 1e-2
UNKNOWN_U16: Final = 65535
IMU: Final = "IMU"
MAG_FIELDS: Final = 0b111 << 6
"""HIGHRES_IMU's bits of what is new."""
UNIX_YEAR_2000_US: Final = 946_684_800 * US_PER_S
"""Later times are civil time, earlier ones count from the start of the autopilot."""
VELOCITY_AGE_US: Final = US_PER_S // 2
"""A velocity down that is older is another one by now."""

_FIX_TYPES: Final = {2: GpsFixType.FIX_2D, 3: GpsFixType.FIX_3D}
_IMU_RANK: Final = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 3,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 2,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 1,
}


class SingleReader:
    """Turn one vehicle's frames into records.

    Parameters
    ----------
    system_id : int or None
        Whose frames; the first system that sends an IMU message by default.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self.system_id = system_id
        self.unix_us_at_zero: int | None = None
        """Civil time of the records' time zero, by the times of the recording."""
        self.undecoded = 0
        self._decoder = mavlink.MAVLink(None)
        self._zero_us: int | None = None
        self._rank = 0
        self._newest_us: dict[str, int] = {}
        self._sampled_us = 0
        self._place: Any = None
        """The newest GLOBAL_POSITION_INT, and when it was recorded."""
        self._place_us = 0
        self._handlers: dict[int, Callable[[Any, int], list[Imported]]] = {
            mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: self._highres_imu,
            mavlink.MAVLINK_MSG_ID_RAW_IMU: self._milli_imu,
            mavlink.MAVLINK_MSG_ID_SCALED_IMU: self._milli_imu,
            mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: self._pressure,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._position,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps,
        }

    def feed(self, frame: bytes, time_us: int) -> list[Imported]:
        """Take the next frame of the recording.

        Parameters
        ----------
        frame : bytes
            A complete frame.
        time_us : int
            When it was recorded, µs since 1970.

        Returns
        -------
        list of Imported
            What it holds; nothing for most frames. Never raises on data.
        """
        message_id = message_id_of(frame)
        handler = self._handlers.get(message_id)
        if handler is None:
            return []
        if not self._takes(message_id, *origin_of(frame)):
            return []
        try:
            message = self._decoder.decode(bytearray(frame))
        except mavlink.MAVError:
            self.undecoded += 1
            return []
        return handler(message, time_us)

    def _takes(self, message_id: int, system_id: int, component_id: int) -> bool:
        """Tell whether a message is of the vehicle, and no poorer than others of its kind."""
        rank = _IMU_RANK.get(message_id, 0)
        if self.system_id is None and rank:
            self.system_id = system_id
        if system_id != self.system_id or component_id != 1 or (rank and rank < self._rank):
            return False
        self._rank = max(rank, self._rank)
        return True

    def _time(self, message: Any, recorded_us: int) -> int:
        """Put a message on the records' clock, which never falls within a kind of message."""
        if hasattr(message, "time_usec"):
            own_us = int(message.time_usec)
        else:
            own_us = int(message.time_boot_ms) * 1000
        if own_us == 0 or own_us > UNIX_YEAR_2000_US:
            own_us = recorded_us
        if self._zero_us is None:
            self._zero_us = own_us
            self.unix_us_at_zero = self._sampled_us = recorded_us
        elapsed_us = own_us - self._zero_us
        is_imu = message.get_msgId() in _IMU_RANK
        kind = IMU if is_imu else message.get_type()
        sample_us = self._newest_us.get(IMU, 0)
        if not 0 <= elapsed_us - sample_us <= US_PER_S:
            # Another clock than the IMU's, or a restart: what was recorded then is true.
            if is_imu:
                elapsed_us = recorded_us - (self.unix_us_at_zero or 0)
            else:
                elapsed_us = sample_us + max(recorded_us - self._sampled_us, 0)
        if is_imu:
            self._sampled_us = recorded_us
        self._newest_us[kind] = max(self._newest_us.get(kind, 0), elapsed_us)
        return self._newest_us[kind]

    def _highres_imu(self, m: Any, recorded_us: int) -> list[Imported]:
        time_us = self._time(m, recorded_us)
        mag: Vec3 = (m.xmag * UT_PER_GAUSS, m.ymag * UT_PER_GAUSS, m.zmag * UT_PER_GAUSS)
        new_mag = bool(m.fields_updated & MAG_FIELDS) and any(mag)
        return [
            self._imu(
                time_us,
                (m.xacc, m.yacc, m.zacc),
                (m.xgyro, m.ygyro, m.zgyro),
                mag if new_mag else None,
                m.temperature,
            )
        ]

    def _milli_imu(self, m: Any, recorded_us: int) -> list[Imported]:
        g, mgauss = STANDARD_GRAVITY_MPS2 * MILLI, UT_PER_GAUSS * MILLI
        mag: Vec3 = (m.xmag * mgauss, m.ymag * mgauss, m.zmag * mgauss)
        return [
            self._imu(
                self._time(m, recorded_us),
                (m.xacc * g, m.yacc * g, m.zacc * g),
                (m.xgyro * MILLI, m.ygyro * MILLI, m.zgyro * MILLI),
                mag if any(mag) else None,
                m.temperature * CENTI if getattr(m, "temperature", 0) else NAN,
            )
        ]

    def _imu(
        self, time_us: int, accel: Vec3, gyro: Vec3, mag: Vec3 | None, temperature_degc: float
    ) -> ImuCalibrated:
        flags = ImuFlags.MAG_NEW if mag else ImuFlags(0)
        node = NodeId(self.system_id or 1, 0)
        return ImuCalibrated(time_us, node, accel, gyro, mag, temperature_degc, flags)

    def _pressure(self, m: Any, recorded_us: int) -> list[Imported]:
        time_us, node = self._time(m, recorded_us), NodeId(self.system_id or 1, 0)
        return [BaroRaw(time_us, node, time_us, m.press_abs * PA_PER_HPA, m.temperature * CENTI)]

    def _position(self, m: Any, recorded_us: int) -> list[Imported]:
        self._place, self._place_us = m, recorded_us
        return []

    def _newest_place(self, recorded_us: int) -> Any:
        """Return the newest GLOBAL_POSITION_INT, unless it is of long ago."""
        return self._place if abs(recorded_us - self._place_us) <= VELOCITY_AGE_US else None

    def _attitude(self, m: Any, recorded_us: int) -> list[Imported]:
        """Take what the autopilot itself believes, to be compared with."""
        place = self._newest_place(recorded_us)
        return [_own_state(m, self._time(m, recorded_us), place)]

    def _gps(self, m: Any, recorded_us: int) -> list[Imported]:
        time_us = self._time(m, recorded_us)
        fix_type = _FIX_TYPES.get(min(m.fix_type, 3), GpsFixType.NONE)
        return [
            GpsFix(
                time_us=time_us,
                node=NodeId(self.system_id or 1, 1),
                node_time_us=time_us,
                itow_ms=0,
                fix_type=fix_type,
                fix_ok=fix_type is not GpsFixType.NONE,
                satellites=0 if m.satellites_visible == 255 else m.satellites_visible,
                lat_dege7=m.lat,
                lon_dege7=m.lon,
                alt_amsl_m=m.alt * MILLI,
                vel_n_mps=self._velocity(m, fix_type, recorded_us),
                alt_ellipsoid_m=m.alt_ellipsoid * MILLI if m.alt_ellipsoid else NAN,
                h_acc_m=m.h_acc * MILLI or NAN,
                v_acc_m=m.v_acc * MILLI or NAN,
                speed_acc_mps=m.vel_acc * MILLI or NAN,
                course_acc_deg=m.hdg_acc * 1e-5 or NAN,
                pdop=_known(m.eph, CENTI),
                utc_us=m.time_usec if m.time_usec > UNIX_YEAR_2000_US else None,
            )
        ]

    def _velocity(self, m: Any, fix_type: GpsFixType, recorded_us: int) -> Vec3:
        """Join speed and course of a fix with the velocity down of just before."""
        if fix_type is GpsFixType.NONE:
            return (NAN, NAN, NAN)
        speed, course_rad = _known(m.vel, CENTI), math.radians(_known(m.cog, CENTI))
        place = self._newest_place(recorded_us)
        climbs = place is not None and fix_type is GpsFixType.FIX_3D
        down = place.vz * CENTI if climbs else NAN
        return (speed * math.cos(course_rad), speed * math.sin(course_rad), down)


def _known(value: int, scale: float) -> float:
    return NAN if value == UNKNOWN_U16 else value * scale


def _own_state(m: Any, time_us: int, place: Any) -> NavState:
    """Make a state of ATTITUDE and of GLOBAL_POSITION_INT, which may be None."""
    flags = NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID
    if place is not None:
        flags |= NavFlags.POSITION_VALID | NavFlags.VELOCITY_VALID | NavFlags.ALTITUDE_VALID
    vel = (NAN,) * 3 if place is None else (place.vx, place.vy, place.vz)
    unknown: Vec3 = (NAN, NAN, NAN)
    return NavState(
        time_us=time_us,
        q_nb=from_euler(m.roll, m.pitch, m.yaw),
        rate_b_radps=(m.rollspeed, m.pitchspeed, m.yawspeed),
        lat_deg=NAN if place is None else place.lat * DEG_PER_DEGE7,
        lon_deg=NAN if place is None else place.lon * DEG_PER_DEGE7,
        alt_amsl_m=NAN if place is None else place.alt * MILLI,
        vel_n_mps=(vel[0] * CENTI, vel[1] * CENTI, vel[2] * CENTI),
        attitude_std_rad=unknown,
        vel_std_mps=unknown,
        pos_std_m=unknown,
        flags=flags,
    )
