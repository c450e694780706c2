"""Run `mavgate` by `python -m gateway.cli`."""

import gc
import os
import sys

INTERRUPTED = 128 + 2


def main() -> None:
    """Run the command line; Ctrl-C at any time ends it without a message."""
    # Imports produce hardly any garbage, and collecting it takes a tenth of the start-up time.
    # `load_command` enables the collector again.
    gc.disable()
    # For all Python processes started from here, including those of multiprocessing: the current
    # folder, which may contain unpacked recordings, must not be on their module path.
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
    """Exit immediately if a thread still waits for Zenoh, since Python would wait for it too."""
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
