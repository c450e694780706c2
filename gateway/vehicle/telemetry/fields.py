"""Physical values to the numbers of MAVLink fields: scaled, saturated, and never raising.

A MAVLink integer field often reserves its greatest value for "unknown". Each function here takes
the value to send in that case, and saturates one below it, so that a too large value is never read
as "not known".
"""

import math
from typing import Final

INT16_MAX: Final = 2**15 - 1
INT32_MAX: Final = 2**31 - 1
UINT8_MAX: Final = 2**8 - 1
UINT16_MAX: Final = 2**16 - 1
UINT32_MAX: Final = 2**32 - 1
FLOAT32_MAX: Final = 3.402_823_4e38


def whole(value: float, low: int, high: int, unknown: int) -> int:
    """Round to an integer field.

    Parameters
    ----------
    value : float
        In the field's unit; NaN is not known, an infinity is saturated.
    low, high : int
        Ends of the field, `unknown` excluded.
    unknown : int
        What the message definition specifies for an unknown value.

    Returns
    -------
    int
    """
    if math.isnan(value):
        return unknown
    if value <= low:
        return low
    if value >= high:
        return high
    return round(value)


def uint8(value: float, unknown: int = UINT8_MAX) -> int:
    """Fit an unsigned byte whose 255 may mean unknown."""
    return whole(value, 0, UINT8_MAX - (unknown == UINT8_MAX), unknown)


def uint16(value: float, unknown: int = UINT16_MAX) -> int:
    """Fit an unsigned 16-bit field whose 65535 may mean unknown."""
    return whole(value, 0, UINT16_MAX - (unknown == UINT16_MAX), unknown)


def int16(value: float) -> int:
    """Fit a signed 16-bit field, which has no value for unknown; it gets 0."""
    return whole(value, -INT16_MAX - 1, INT16_MAX, 0)


def int32(value: float) -> int:
    """Fit a signed 32-bit field, which has no value for unknown; it gets 0."""
    return whole(value, -INT32_MAX - 1, INT32_MAX, 0)


def uint32(value: float) -> int:
    """Fit an unsigned 32-bit field; as an extension field its 0 means unknown."""
    return whole(value, 0, UINT32_MAX, 0)


def compass_cdeg(angle_rad: float) -> int:
    """Turn an angle from north into 0 to 35999 hundredths of a degree, 65535 if not known."""
    if not math.isfinite(angle_rad):
        return UINT16_MAX
    return round(math.degrees(angle_rad) * 100.0) % 36000


def compass_deg(angle_rad: float) -> int:
    """Turn an angle from north into 0 to 359 whole degrees; an unknown angle must not come here."""
    return round(math.degrees(angle_rad)) % 360
