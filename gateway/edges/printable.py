"""Text of others, from recordings and the network, as a terminal or a log may be given it."""

import logging
from typing import Final

_CONTROLS: Final = {
    code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"
}
"""A terminal obeys them: they move its cursor, rename its window, type for its user."""
LONGEST: Final = 2000
"""Letters of a log line; an address that a page is asked for may have 60,000."""


def printable(text: str) -> str:
    r"""Return a text with its control characters as `\xNN`; lines and tabs stay."""
    return text.translate(_CONTROLS)


class PrintableFormatter(logging.Formatter):
    """Formats log lines whose texts may come from others."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record; what others fill it with is cut off."""
        line = super().format(record)
        if len(line) > LONGEST and not record.exc_info:
            line = f"{line[:LONGEST]}…"
        return printable(line)
