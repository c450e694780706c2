"""Physical constants and the factors between external units and SI."""

from typing import Final

STANDARD_GRAVITY_MPS2: Final = 9.80665
"""Conventional standard gravity (ISO 80000-3)."""

RAD_PER_DEG: Final = 0.017453292519943295
US_PER_S: Final = 1_000_000
DEG_PER_DEGE7: Final = 1e-7
M_PER_MM: Final = 1e-3
M_PER_CM: Final = 1e-2
PA_PER_HPA: Final = 100.0
