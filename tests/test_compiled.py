"""The library of compiled kernels: the results of Python, current with its sources, no compiler."""

import ast
import json
import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from gateway.compiled import address_of, array_at, compiled, entry_point
from gateway.compiled.entry_point import (
    BUILD_COMMAND,
    ENTRY_POINTS,
    ROOT,
    EntryPoint,
    changed_source,
    open_library,
    stamp_in,
    stamp_of,
)
from gateway.geometry.quaternion import _from_euler_array
from tests.kit.process import python
from tools.build_kernels import (
    KERNEL_MODULES,
    MAX_CACHED,
    build_library,
    cached_object,
    compiled_again,
    is_current,
)

pytestmark = pytest.mark.io

FLOAT = np.dtype(np.float64)
FACTOR = 3.0


@compiled
def scaled(x: float) -> float:
    return FACTOR * x


def scale(values: int, count: int, offset: float) -> None:
    numbers = array_at(values, (count,), FLOAT)
    for k in range(count):
        numbers[k] = scaled(numbers[k]) / offset + offset


def allocate(count: int) -> None:
    np.zeros(count)[0] = 1.0


Scaling = EntryPoint[[int, int, float]]


@pytest.fixture
def scaling() -> Scaling:
    """An entry point that the installed library lacks."""
    point = EntryPoint(scale)
    ENTRY_POINTS.remove(point)
    return point


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the machine code of some sources is kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return path_of("1")


def path_of(version: str) -> Path:
    path = cached_object(f"gateway/units.py {version}")
    assert path is not None
    return path


def use(function: Scaling, offset: float = 0.25) -> list[float]:
    numbers = np.array([1.0, 2.5])
    function(address_of(numbers), 2, offset)
    return numbers.tolist()


def test_machine_code_gives_results_of_python(scaling: Scaling, tmp_path: Path) -> None:
    build_library(path := tmp_path / "kernels.so", [scaling])
    scaling.load(path)
    assert use(scaling) == use(scale) == [12.25, 30.25]
    assert use(scaling, 0.0) == [np.inf, np.inf], "Python would raise"
    assert [*tmp_path.iterdir()] == [path]


def test_cached_machine_code_is_not_compiled_again_and_oldest_is_removed(
    scaling: Scaling, cached: Path, tmp_path: Path
) -> None:
    others = [path_of(f"1 {k}") for k in range(MAX_CACHED)]
    cached.parent.mkdir(parents=True)
    for age, path in enumerate(others):
        path.touch()
        os.utime(path, ns=(age, age))
    build_library(tmp_path / "first.so", [scaling], cached=cached)
    assert {*cached.parent.iterdir()} == {*others[1:], cached}
    build_library(path := tmp_path / "second.so", [], cached=cached)
    scaling.load(path)
    assert use(scaling) == [12.25, 30.25]


def swap(cached: Path) -> None:
    other = path_of("2")
    cached.unlink()
    build_library(cached.with_suffix(".so"), [], cached=other)
    cached.symlink_to(other)


CHANGES: dict[str, Callable[[Path], object]] = {
    "writable by others": lambda cached: cached.chmod(0o666),
    "damaged": lambda cached: cached.write_bytes(cached.read_bytes()[:-1]),
    "folder": lambda cached: (cached.unlink(), cached.mkdir()),
    "link to another": swap,
}


@pytest.mark.parametrize("change", CHANGES)
def test_cached_machine_code_that_is_damaged_or_another_users_is_compiled_again(
    scaling: Scaling, cached: Path, tmp_path: Path, change: str
) -> None:
    build_library(tmp_path / "first.so", [], cached=cached)
    CHANGES[change](cached)
    build_library(path := tmp_path / "second.so", [scaling], cached=cached)
    scaling.load(path)
    assert use(scaling) == [12.25, 30.25]


def test_link_in_the_place_of_the_cache_or_a_missing_home_gets_no_file(
    scaling: Scaling, cached: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (target := tmp_path / "documents").mkdir()
    cached.parent.parent.mkdir()
    cached.parent.symlink_to(target)
    build_library(tmp_path / "first.so", [scaling], cached=cached)
    assert [*target.iterdir()] == []
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError))
    assert cached_object("gateway/units.py 1") is None


def test_experiment_compiles_patched_constants_until_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight, before = _from_euler_array, from_euler(_from_euler_array)
    monkeypatch.setattr("gateway.geometry.quaternion.from_euler", compiled(lambda *_: (7.0,) * 4))
    assert from_euler(flight) == before
    with compiled_again([flight]):
        assert from_euler(flight) == [7.0] * 4
    assert from_euler(flight) == before


def from_euler(point: EntryPoint[[int, int, int]]) -> list[float]:
    angles, found = np.array([0.1, 0.2, 0.3]), np.empty(4)
    point(1, address_of(angles), address_of(found))
    return found.tolist()


def test_kernel_that_allocates_is_rejected(tmp_path: Path) -> None:
    point = EntryPoint(allocate)
    ENTRY_POINTS.remove(point)
    with pytest.raises(TypeError, match="allocates"):
        build_library(tmp_path / "kernels.so", [point])


def test_only_a_change_of_code_makes_a_library_stale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(entry_point, "ROOT", tmp_path)
    file = tmp_path / "kernel.py"
    file.write_text("x = 3.0\ndef f():\n    return 2 * x\n")
    stamp = stamp_of(file)
    assert changed_source(stamp) is None
    file.write_text('"""Text."""\nx = 3.0  # m\n\n\ndef f():\n    """More."""\n    return 2 * x\n')
    assert changed_source(stamp) is None
    for source in ("x = 3.0\ndef f():\n    return 3 * x\n", "x = 3.5\ndef f():\n    return 2 * x\n",
                   "x = 3.0\ndef f(:\n"):  # fmt: skip
        file.write_text(source)
        assert changed_source(stamp) == "kernel.py", source
    file.unlink()
    assert changed_source(stamp) == "kernel.py"


def test_library_records_versions_of_its_sources(scaling: Scaling, tmp_path: Path) -> None:
    build_library(path := tmp_path / "kernels.so", [scaling], stamp='gateway/units.py 1 2\n"\\\0x')
    assert stamp_in(open_library(path)) == 'gateway/units.py 1 2\n"\\'
    assert changed_source(stamp_in(open_library(path))) == "gateway/units.py"


@pytest.mark.parametrize("content", [None, b"", b"x"], ids=["missing", "empty", "no library"])
def test_error_for_missing_library_names_build_command(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "kernels.so"
    if content is not None:
        path.write_bytes(content)
    code = (
        "import sys; from pathlib import Path; import gateway.compiled.entry_point as e;"
        f"e.LIBRARY = Path({str(path)!r}); sys.argv[1:] = ['demo', '--no-panel'];"
        "from gateway.cli.__main__ import main; main()"
    )
    done = python("-c", code, check=False)
    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert line.startswith(f"{path}: the library of compiled kernels ")
    assert f"`{BUILD_COMMAND}`" in line


def test_installed_library_is_current_and_needs_no_compiler_at_run_time() -> None:
    assert is_current()
    code = (
        "import sys; sys.modules |= dict.fromkeys(['numba', 'llvmlite', 'ziglang']);"
        "from gateway.compiled.entry_point import load_entry_points;"
        f"import {', '.join(KERNEL_MODULES)}; load_entry_points();"
        "from gateway.estimation.select import *;"
        "[make_estimator(EstimationSettings(estimator=name)) for name in ESTIMATORS]"
    )
    python("-c", code)


def test_entry_points_import_only_build_requirements() -> None:
    code = (
        f"import json, sys, {', '.join(KERNEL_MODULES)};"
        "print(json.dumps({n: getattr(m, '__file__', None) for n, m in sys.modules.items()}))"
    )
    files: dict[str, str | None] = json.loads(python("-c", code).stdout)
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    for path in (ROOT / "gateway").rglob("*.py"):
        text = path.read_text()
        if "EntryPoint" not in text or path.parent.name == "compiled":
            continue
        if "EntryPoint" in {n.id for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Name)}:
            assert str(path) in files.values(), f"{path} is missing in KERNEL_MODULES"
    packages = {
        name.partition(".")[0] for name, file in files.items() if "site-packages" in str(file)
    }
    for package in packages - {"gateway", "typing_extensions", "_distutils_hack"}:
        if not package.startswith("__editable__"):
            assert any(one.startswith(package) for one in required), package
