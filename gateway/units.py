"""Physical constants, factors between external units and SI, and numbers with a noun."""

from typing import Final

STANDARD_GRAVITY_MPS2: Final = 9.80665
"""Conventional standard gravity (ISO 80000-3)."""

RAD_PER_DEG: Final = 0.017453292519943295
US_PER_S: Final = 1_000_000
NS_PER_US: Final = 1000
MV_PER_V: Final = 1000
DEGE7_PER_DEG: Final = 1e7
DEG_PER_CDEG: Final = 1e-2
DEG_PER_DEGE7: Final = 1 / DEGE7_PER_DEG
UT_PER_GAUSS: Final = 100.0
M_PER_MM: Final = 1e-3
M_PER_CM: Final = 1e-2
PA_PER_HPA: Final = 100.0
KNOTS_PER_MPS: Final = 3600 / 1852
KMH_PER_MPS: Final = 3.6
FEET_PER_M: Final = 1 / 0.3048
BITS_PER_BYTE: Final = 10
"""Bits that a serial line transfers for a byte: 8 data bits, no parity, a start and a stop bit."""
FIX_2D: Final = 2
"""Least GPS_FIX_TYPE with a position; DataFlash and ULog use the same numbers."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 line`, `2 lines`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
