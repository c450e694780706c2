"""Map names of flight modes to ArduPilot's numbers, with which ground stations name modes.

Flight controllers report the mode in a few letters; Betaflight, INAV and ArduPilot use different
ones. Arming is derived from the same text:

| firmware   | not armed                               | armed                                     |
| ---------- | --------------------------------------- | ----------------------------------------- |
| Betaflight | a mode with the mark `*`, `!` or `?`    | a mode without a mark                     |
| INAV       | `OK`, `WAIT` or `!ERR`                  | a mode                                    |
| ArduPilot  | a mode with `*`, if RC_OPTIONS asks it  | a mode without `*`, if one had `*` before |
| PX4        | not indicated                           | not indicated                             |
"""

import re
from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.sources.settings import SourceUrl
from gateway.wire.vehicle_types import mode_name

FIXED_WING: Final[int] = mavlink.MAV_TYPE_FIXED_WING
QUADROTOR: Final[int] = mavlink.MAV_TYPE_QUADROTOR

NUMBERS: Final[dict[str, tuple[int | None, int | None]]] = {
    "ACRO": (1, 4), "AIR": (1, 4), "ANGL": (0, 5), "ANGH": (0, 5), "HOR": (0, 2), "STAB": (0, 2),
    "ALTH": (2, 6), "AH": (2, 6), "A H": (2, 6), "POSH": (16, 12), "HOLD": (16, 12),
    "LOIT": (5, 12), "LOTR": (None, 12), "RTH": (6, 11), "WRTH": (6, 11), "RTL": (6, 11),
    "WP": (3, 10), "AUTO": (3, 10), "PASS": (None, 0), "GUID": (4, 15), "CIRC": (7, 1),
    "LAND": (9, None), "MANU": (1, 0), "CRS": (None, 7),
    "3CRS": (None, 7), "CRUZ": (None, 7), "CRSH": (None, 7), "CRUI": (None, 7), "FBWA": (None, 5),
    "FBWB": (None, 6), "LNCH": (None, 13), "BRAK": (17, None), "DRIF": (11, None),
    "SPRT": (13, None), "TRAN": (None, 8), "QSTB": (None, 17), "QHOV": (None, 18),
    "QLOT": (None, 19), "QLND": (None, 20), "QRTL": (None, 21),
}  # fmt: skip
"""Mode numbers of copter and aeroplane, by the letters."""
OF_BETAFLIGHT: Final = frozenset(
    {"ANGL", "ANGH", "HOR", "AIR", "POSH", "CHIR", "PASS", "RTH", "WRTH", "WP", "AH", "A H", "TURT"}
    | {"CRS", "3CRS", "CRUZ", "CRSH", "LOTR", "GEO", "HRST", "WAIT", "OK", "!ERR"}
)
"""Names that Betaflight or INAV sends, and no other firmware."""
OF_OTHERS: Final = frozenset(
    {"LOIT", "RTL", "AUTO", "GUID", "BRAK", "DRIF", "SPRT", "PHLD", "SRTL", "FBWA", "FBWB", "CRUS"}
    | {"TKOF", "TRAN", "QSTB", "QHOV", "QLOT", "QLND", "QRTL"}
    | {"Manual", "Altitude", "Altitude Cruise", "Position", "Cruise", "Return", "Mission", "Auto"}
    | {"Acro", "Terminate", "Offboard", "Stabilized", "Rattitude", "Failure", "Unknown"}
)
"""Names that ArduPilot or PX4 sends, and neither Betaflight nor INAV."""
NOT_ARMED: Final = frozenset({"OK", "WAIT", "!ERR"})
FAILSAFE: Final = "!FS!"
TEXT: Final = re.compile(r"(!ERR|!FS!|.*?)([*!?]*)", re.DOTALL)
"""Name and suffix of a mode."""
OF_BETAFLIGHT_MARKS: Final = frozenset("!?")


def wanted_type(url: SourceUrl) -> int | None:
    """Return the MAV_TYPE in the option `type`; raises ValueError for an unknown one."""
    name = url.options.get("type")
    found: int | None = getattr(mavlink, f"MAV_TYPE_{name.upper()}", None) if name else None
    if name is not None and found is None:
        raise ValueError(f"source {url.name!r}: no MAV_TYPE {name!r}")
    return found


def wanted_sign(url: SourceUrl) -> bool | None:
    """Return whether the option `pitch` is `down`, None without it; raises ValueError."""
    sign = url.options.get("pitch")
    if sign not in (None, "up", "down"):
        raise ValueError(f"source {url.name!r}: pitch must be up or down, not {sign!r}")
    return None if sign is None else sign == "down"


@dataclass(frozen=True, slots=True)
class TextMode:
    """A flight mode, decoded from its text."""

    name: str
    copter: int | None
    plane: int | None
    armed: bool | None
    """False if the text is marked as not armed; None if it never has a mark."""
    vehicle_type: int | None
    is_betaflight: bool | None
    """Whether Betaflight or INAV has sent it; None if others use the same text."""


def mode_of_text(text: str) -> TextMode:
    """Decode the letters of a mode and the suffix."""
    found = TEXT.fullmatch(text)
    name, marks = (found[1].strip(), found[2]) if found else (text, "")
    armed: bool | None = not marks and name not in NOT_ARMED
    if name == FAILSAFE and armed:
        armed = None
    is_betaflight: bool | None = True
    if name not in OF_BETAFLIGHT and not set(marks) & OF_BETAFLIGHT_MARKS:
        is_betaflight = False if name in OF_OTHERS else None
    copter, plane = NUMBERS.get(name, (None, None))
    kind = None
    if (copter, plane) != (None, None):
        kind = FIXED_WING if copter is None else QUADROTOR
    return TextMode(name or "unknown", copter, plane, armed, kind, is_betaflight)


def ardupilot_mode(vehicle_type: int | None, number: int) -> str:
    """Return the name of an ArduPilot mode; its number if the vehicle type is unknown."""
    if vehicle_type is None:
        return f"MODE {number}"
    return mode_name(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, vehicle_type, number) or f"MODE {number}"
