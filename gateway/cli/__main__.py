"""`python -m gateway.cli` is `mavgate`."""

import sys

INTERRUPTED = 128 + 2
"""What a shell tells of a program that Ctrl-C ended."""


def main() -> None:
    """Run the command line; Ctrl-C ends it without a word at any time."""
    try:
        # Not above: half a second of imports is when people think again.
        from gateway.cli.app import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
