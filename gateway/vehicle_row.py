"""The row of one vehicle in status, live view and log; imports nothing that takes time to load."""

from dataclasses import dataclass
from typing import Final

from gateway.printable import UNKNOWN, figure, printable
from gateway.units import FIX_2D

VEHICLE_HEADS: Final = (
    *("vehicle", "type", "mode", "armed", "position", "AMSL m", "battery", "link", "age s"),
    "loss",
)
SILENT_S: Final = 5.0
"""Age of the newest message from which the log line states it."""


@dataclass(frozen=True, slots=True)
class VehicleRow:
    """Status of one vehicle of the hub, from its MAVLink; None and NaN are unknown."""

    system_id: int
    kind: str
    """Its MAV_TYPE in words."""
    mode: str
    """Name of its flight mode; empty if unknown."""
    armed: bool
    lat_deg: float | None
    lon_deg: float | None
    alt_amsl_m: float | None
    fix_type: int | None
    """A GPS_FIX_TYPE."""
    battery_v: float | None
    battery_percent: float | None
    link: str
    """The receiver, the sources, or the name of the client behind which it is."""
    age_s: float
    """Time since its newest message."""
    loss: float | None
    """Share of its frames that were lost on the way here; None for an own vehicle."""


def vehicle_cells(row: VehicleRow) -> tuple[str, ...]:
    """Return the cells of `VEHICLE_HEADS`."""
    position = "no fix" if row.fix_type is not None and row.fix_type < FIX_2D else UNKNOWN
    if row.lat_deg is not None and row.lon_deg is not None:
        position = f"{row.lat_deg:.6f}, {row.lon_deg:.6f}"
    battery = [figure(row.battery_v, ".1f", "V"), figure(row.battery_percent, ".0f", "%")]
    return (
        str(row.system_id),
        printable(row.kind).replace("_", " ") or UNKNOWN,
        printable(row.mode) or UNKNOWN,
        "armed" if row.armed else "no",
        position,
        figure(row.alt_amsl_m, ".0f"),
        " ".join(text for text in battery if text != UNKNOWN) or UNKNOWN,
        printable(row.link) or UNKNOWN,
        f"{row.age_s:.1f}",
        figure(row.loss, ".1%"),
    )


def vehicle_text(row: VehicleRow) -> str:
    """Describe a foreign vehicle for the log."""
    _, kind, mode, armed, position, *_, link, age, loss = vehicle_cells(row)
    words = [f"vehicle {row.system_id} ({kind})", mode, "armed" if armed == "armed" else "disarmed"]
    words += [f"at {position}" if row.lat_deg is not None else position, f"on {link}"]
    words += [f"silent for {age} s"] if row.age_s > SILENT_S else []
    words += [f"{loss} lost"] if row.loss else []
    return " ".join(word for word in words if word != UNKNOWN)
