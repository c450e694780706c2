"""What commands say of flights before they read one; it imports nothing that takes time."""

from typing import Final, Literal

Position = Literal["causal", "interpolated"]
SettingsChoice = Literal["recorded", "current"]

NO_RECORDING: Final = "is no recording: it holds neither MAVLink nor a table of mavgate's"


class FlightError(Exception):
    """A file without the data that a command needs; the text says what and where."""
