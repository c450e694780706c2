"""Readable texts of errors."""

import os


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
