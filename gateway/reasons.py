"""Readable texts of errors and faulty states."""

import os
from typing import Final

FEW_BYTES: Final = 200
"""The end of a frame, or what an adapter still held."""


def reason_of(error: Exception) -> str:
    """Return the text of an error, the operating system's if there is one."""
    if hasattr(error, "library"):
        # Of TLS, whose numbers are not the operating system's.
        reason = getattr(error, "reason", None)
        return reason.replace("_", " ").lower() if reason else "no certificate and key in PEM"
    number = getattr(error, "errno", None) or 0
    return (
        os.strerror(number)
        if number > 0
        else getattr(error, "strerror", None) or str(error) or type(error).__name__
    )


def receiver_state(connected: bool, bytes_received: int, frames: int) -> str:
    """Describe the receiver's port: a wrong device or speed is open, too, and sends no frames."""
    if not connected:
        return "not connected"
    if frames:
        return "connected"
    if bytes_received < FEW_BYTES:
        return "connected, silent"
    return "connected, sends no frames: is it the receiver, at the speed serial.baud?"
