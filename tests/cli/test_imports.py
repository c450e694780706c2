"""What a command may import: to list, to ask and to run must not cost what others need."""

import json
import os
import re
from pathlib import Path

import pytest

from tests.kit.process import Process, python

pytestmark = pytest.mark.io

NEVER = {"IPython", "bokeh", "dask", "fsspec", "matplotlib", "mcap", "nicegui", "pandas", "pyarrow"}
HEAVY = {"asyncio", "llvmlite", "numba", "numpy", "pymavlink", "scipy"}
"""What no small command needs; the gateway itself is made of some of it."""
RUN_MAY_NOT = {
    "gateway.fleet.server",
    "gateway.panel.panel_server",
    "numba",
    "prometheus_client",
    "rich",
    "scipy",
    "wsproto",
    "zenoh",
}


def imported_by(*modules: str) -> set[str]:
    code = f"import json, sys, {', '.join(modules)}; print(json.dumps([*sys.modules]))"
    return set(json.loads(python("-c", code).stdout))


@pytest.mark.parametrize("module", ["gateway.cli.app", "gateway.cli.live.clients"])
def test_small_commands_import_little(module: str) -> None:
    assert imported_by(module) & (NEVER | HEAVY | {"importlib.metadata"}) == set()


def test_status_with_vehicles_imports_little() -> None:
    code = "from gateway.cli.live.clients import _vehicles; _vehicles([]);"
    code += "import json, sys; print(json.dumps([*sys.modules]))"
    assert set(json.loads(python("-c", code).stdout)) & (NEVER | HEAVY) == set()


def test_gateway_imports_no_optional_part() -> None:
    found = imported_by("gateway.cli.app", "gateway.cli.live.run")
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


@pytest.mark.parametrize(
    "module",
    ["live.first_start", "live.calibrate", "live.demo", "recorded.convert",
     "recorded.play", "recorded.report", "recorded.sweep"],
)  # fmt: skip
def test_analysis_libraries_are_imported_only_where_they_are_used(module: str) -> None:
    found = imported_by("gateway.cli.app", f"gateway.cli.{module}")
    assert found & (NEVER | {"scipy"}) == set()


def test_recording_summary_imports_neither_settings_nor_stages() -> None:
    found = imported_by("gateway.cli.app", "gateway.cli.recorded.info")
    assert found & (NEVER | {"numba", "scipy"}) == set()
    assert not {"gateway.config", "gateway.aircraft", "gateway.recordings.reading"} & found


def test_list_of_commands_loads_no_extension() -> None:
    code = "from gateway.cli.app import app; app(['--help'], standalone_mode=False)"
    code = f"import sys; {code}; print('gateway.extensions' in sys.modules, 'numpy' in sys.modules)"
    assert python("-c", code).stdout.splitlines()[-1] == "False False"
