"""Ctrl-C while the command line starts."""

import os
import signal
import subprocess
import sys
import textwrap

import pytest

from gateway.cli.__main__ import INTERRUPTED
from tests.kit.process import python

pytestmark = pytest.mark.io

PROGRAM = """
    import os, signal, sys

    class Interrupt:
        '''Presses Ctrl-C when a module is looked for.'''

        def __init__(self, wanted):
            self.wanted = wanted

        def find_spec(self, name, path=None, target=None):
            if name == self.wanted:
                os.kill(os.getpid(), signal.SIGINT)

    from gateway.cli.__main__ import main
    # A shell's background job begins with Ctrl-C ignored, and so would this program.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.meta_path.insert(0, Interrupt(sys.argv.pop()))
    sys.argv.append("doctor")
    main()
"""


def run(program: str, module: str) -> subprocess.CompletedProcess[str]:
    path = {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = ("-c", textwrap.dedent(program), module)
    return python(*words, timeout=240, env=os.environ | path, check=False)


@pytest.mark.parametrize("module", ["typer", "gateway.live.daemon"])
def test_sigterm_at_any_import_ends_a_background_job(module: str) -> None:
    """Such a job ignores Ctrl-C from the start on; the signal of `kill` ends it at once."""
    program = PROGRAM.replace("SIGINT)", "SIGTERM)")
    program = program.replace("signal.default_int_handler", "signal.SIG_IGN")
    found = run(program.replace('"doctor"', '"demo"'), module)
    assert (found.returncode, found.stdout, found.stderr) == (-signal.SIGTERM, "", "")


@pytest.mark.parametrize("module", ["gateway.cli.app", "typer", "numpy", "gateway.config"])
def test_ctrl_c_at_any_import_ends_without_a_traceback(module: str) -> None:
    found = run(PROGRAM, module)
    assert found.returncode == INTERRUPTED, found
    assert "Traceback" not in found.stderr
