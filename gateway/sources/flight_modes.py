"""Map names of flight modes to ArduPilot's numbers, with which ground stations name modes.

Flight controllers report the mode in a few letters; Betaflight, INAV and ArduPilot use different
ones. A suffix (`*`, `!`, `?`) means that the vehicle is not armed.
"""

from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.sources.settings import SourceUrl
from gateway.wire.flight_modes import mode_name

FIXED_WING: Final[int] = mavlink.MAV_TYPE_FIXED_WING
QUADROTOR: Final[int] = mavlink.MAV_TYPE_QUADROTOR

NUMBERS: Final[dict[str, tuple[int | None, int | None]]] = {
    "ACRO": (1, 4), "AIR": (1, 4), "ANGL": (0, 5), "HOR": (0, 2), "STAB": (0, 2),
    "ALTH": (2, 6), "AH": (2, 6), "A H": (2, 6), "POSH": (16, 12), "HOLD": (16, 12),
    "LOIT": (5, 12), "RTH": (6, 11), "RTL": (6, 11), "WP": (3, 10), "AUTO": (3, 10),
    "GUID": (4, 15), "CIRC": (7, 1), "LAND": (9, None), "MANU": (1, 0), "CRS": (None, 7),
    "3CRS": (None, 7), "CRUZ": (None, 7), "CRSH": (None, 7), "CRUI": (None, 7), "FBWA": (None, 5),
    "FBWB": (None, 6), "LNCH": (None, 13), "BRAK": (17, None), "DRIF": (11, None),
    "SPRT": (13, None), "TRAN": (None, 8), "QSTB": (None, 17), "QHOV": (None, 18),
    "QLOT": (None, 19), "QLND": (None, 20), "QRTL": (None, 21),
}  # fmt: skip
"""Mode numbers of copter and aeroplane, by the letters."""
OF_BETAFLIGHT: Final = frozenset({"ANGL", "HOR", "AIR", "RTH", "WAIT", "OK", "!ERR", "3CRS", "WP"})
"""Texts that Betaflight and INAV send, and ArduPilot never does."""
NOT_ARMED: Final = frozenset({"OK", "WAIT", "!ERR"})
FAILSAFE: Final = "!FS!"
MARKS: Final = "*!?"


def wanted_type(url: SourceUrl) -> int | None:
    """Return the MAV_TYPE in the option `type`; raises ValueError for an unknown one."""
    name = url.options.get("type")
    found: int | None = getattr(mavlink, f"MAV_TYPE_{name.upper()}", None) if name else None
    if name is not None and found is None:
        raise ValueError(f"source {url.name!r}: no MAV_TYPE {name!r}")
    return found


@dataclass(frozen=True, slots=True)
class TextMode:
    """A flight mode, decoded from its text."""

    name: str
    copter: int | None
    plane: int | None
    armed: bool | None
    """Whether the vehicle is armed; None if the text does not show it."""
    vehicle_type: int | None
    nose_down: bool
    """Whether the autopilot counts pitch as positive with the nose down."""


def mode_of_text(text: str) -> TextMode:
    """Decode the letters of a mode and the suffix."""
    whole = text in NOT_ARMED or text == FAILSAFE
    name = text if whole else text.rstrip(MARKS).strip()
    armed: bool | None = text not in NOT_ARMED and name == text
    if text == FAILSAFE:
        armed = None
    copter, plane = NUMBERS.get(name, (None, None))
    kind = None
    if (copter, plane) != (None, None):
        kind = FIXED_WING if copter is None else QUADROTOR
    return TextMode(name or "unknown", copter, plane, armed, kind, name in OF_BETAFLIGHT)


def ardupilot_mode(vehicle_type: int | None, number: int) -> str:
    """Return the name of an ArduPilot mode; its number if the vehicle type is unknown."""
    if vehicle_type is None:
        return f"MODE {number}"
    return mode_name(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, vehicle_type, number) or f"MODE {number}"
