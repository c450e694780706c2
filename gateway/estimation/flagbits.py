"""The navigation flags as plain integers, which is what compiled code can use."""

from typing import Final

from gateway.records import NavFlags

ATTITUDE_VALID: Final = int(NavFlags.ATTITUDE_VALID)
HEADING_VALID: Final = int(NavFlags.HEADING_VALID)
POSITION_VALID: Final = int(NavFlags.POSITION_VALID)
VELOCITY_VALID: Final = int(NavFlags.VELOCITY_VALID)
ALTITUDE_VALID: Final = int(NavFlags.ALTITUDE_VALID)
AT_REST: Final = int(NavFlags.AT_REST)
USING_GPS: Final = int(NavFlags.USING_GPS)
USING_MAG: Final = int(NavFlags.USING_MAG)
USING_BARO: Final = int(NavFlags.USING_BARO)
MAG_DISTURBED: Final = int(NavFlags.MAG_DISTURBED)
GPS_REJECTED: Final = int(NavFlags.GPS_REJECTED)
DEAD_RECKONING: Final = int(NavFlags.DEAD_RECKONING)
SENSOR_FAULT: Final = int(NavFlags.SENSOR_FAULT)
DEGRADED: Final = int(NavFlags.DEGRADED)
