"""What a command may import: to list, to ask and to run must not cost what others need."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from tests.kit.process import Process, python

pytestmark = pytest.mark.io

NEVER = {"IPython", "bokeh", "dask", "fsspec", "matplotlib", "mcap", "nicegui", "pandas", "pyarrow"}
LARGE = {*NEVER, "llvmlite", "numba", "numpy", "pymavlink", "pyulog", "scipy"}
"""What no small command needs; the gateway itself is made of some of it."""
RUN_MAY_NOT = {
    *("gateway.fleet.server", "gateway.panel.panel_server", "numba", "prometheus_client", "rich"),
    *("scipy", "wsproto", "zenoh"),
}
SMALL = ("--help", "status", "clients list", "clients mark 1 2", "record status", "nonsense")
"""Commands that mostly send requests to a gateway."""
PROGRAM = f"""
import json, sys
from gateway.cli.app import main
found = {{}}
for words in {SMALL!r}:
    sys.argv = ["mavgate", *words.split()]
    try:
        main()
    except SystemExit:
        found[words] = [*sys.modules]
from gateway.cli.live.clients import _vehicles
_vehicles([])
found["vehicles"] = [*sys.modules]
print(json.dumps(found), file=sys.stderr)
"""


def imported_by(*modules: str) -> set[str]:
    names = ", ".join(f"gateway.cli.{module}" for module in ("app", *modules))
    code = f"import json, sys, {names}; print(json.dumps([*sys.modules]))"
    return set(json.loads(python("-c", code).stdout))


def test_small_commands_import_nothing_large(tmp_path: Path) -> None:
    env = {"HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = python("-c", PROGRAM, env=env)
    found: dict[str, Any] = json.loads(done.stderr.splitlines()[-1])
    assert found.keys() == {*SMALL, "vehicles"}
    assert [words for words, modules in found.items() if LARGE & set(modules)] == []
    # What parses options takes as long as all else that the list needs.
    late = {"asyncio", "importlib.metadata", "pydantic", "gateway.extensions"}
    assert late & set(found["--help"]) == set()


def test_gateway_imports_no_optional_part() -> None:
    found = imported_by("live.run")
    assert found & (NEVER | RUN_MAY_NOT) == set()
    assert {name for name in found if name.startswith("gateway.simulator")} <= {
        "gateway.simulator",
        "gateway.simulator.simulator_settings",
        "gateway.simulator.timed_frame",
    }


@pytest.mark.slow
def test_running_gateway_has_loaded_no_library_of_analysis(tmp_path: Path) -> None:
    config = '[serial]\nport = "none"\n[recording]\nmode = "always"\nfolder = "."\n'
    source = "lines:udp:127.0.0.1:0"
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPROFILEIMPORTTIME": "1"}
    words = ("run", "--plain", "--source", source, "--endpoint", "udp-listen:127.0.0.1:0")
    with Process(tmp_path, *words, config=config, env=environment, cwd=tmp_path) as process:
        process.until(r"INFO source .* is open")
        assert process.end() == 0
    loaded = set(re.findall(r"^import time:.*\| +(\w+)", process.log.read_text(), re.MULTILINE))
    assert "gateway" in loaded
    assert loaded & {*NEVER, "scipy", "numba"} == set()


def test_analysis_libraries_are_imported_only_where_they_are_used() -> None:
    live = ("live.first_start", "live.calibrate", "live.demo")
    recorded = ("recorded.convert", "recorded.play", "recorded.report", "recorded.sweep")
    assert imported_by(*live, *recorded) & (NEVER | {"scipy"}) == set()


def test_recording_summary_imports_neither_settings_nor_stages() -> None:
    found = imported_by("recorded.info")
    assert found & (NEVER | {"numba", "scipy"}) == set()
    assert not {"gateway.config", "gateway.aircraft", "gateway.recordings.reading"} & found
