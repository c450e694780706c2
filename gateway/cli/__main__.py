"""`python -m gateway.cli` is `mavgate`."""

import gc
import os
import sys

INTERRUPTED = 128 + 2
"""Exit code of a program that Ctrl-C ended, as in shells."""


def main() -> None:
    """Run the command line; Ctrl-C ends it without a message at any time."""
    # Imports leave hardly any garbage, and collecting it takes a tenth of the start. `load_command`
    # enables the collector again.
    gc.disable()
    # For every Python process started from here, those of multiprocessing included: the current
    # folder, which may be one of unpacked recordings, must not be on its module path.
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        # Imported here, so that Ctrl-C works during half a second of imports.
        from gateway.cli.app import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    finally:
        _exit_without_hanging_threads()


def _exit_without_hanging_threads() -> None:
    """Exit here if a thread still waits for Zenoh: Python would wait for it too."""
    link = sys.modules.get("gateway.hub.transports.zenoh.session")
    if link is None or link.end_calls():
        return
    end = sys.exception()
    code = end.code if isinstance(end, SystemExit) else end
    if not isinstance(end, SystemExit) and end is not None:
        sys.excepthook(type(end), end, end.__traceback__)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))


if __name__ == "__main__":
    main()
