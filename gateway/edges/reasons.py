"""What went wrong, in words for people."""

import os


def reason_of(error: Exception) -> str:
    """Say what went wrong, in the words of the operating system if it has some."""
    number = getattr(error, "errno", None) or 0
    return (
        os.strerror(number)
        if number > 0
        else getattr(error, "strerror", None) or str(error) or type(error).__name__
    )
