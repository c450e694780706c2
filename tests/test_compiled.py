"""Machine code: the same results as Python, kept for what it was made of, and loaded alone."""

import importlib
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from gateway.compiled import address_of, array_at, compiled, compiled_with, digest_of
from gateway.compiled.compiler import compile_dispatcher, compile_entry
from gateway.compiled.entry_point import (
    EntryPoint,
    NotCompiledError,
    dispatched,
    nothing_compiled,
)
from gateway.compiled.machine_code import (
    ONCE,
    OTHERS_KEPT,
    MachineCode,
    compiling,
    keep_code,
    kept_code,
)
from gateway.estimation.complementary.complementary_kernels import KERNELS

FLOAT = np.dtype(np.float64)
FACTOR = 3.0


@compiled
def scaled(x: float) -> float:
    return FACTOR * x


def scale(values: int, count: int, offset: float) -> None:
    numbers = array_at(values, (count,), FLOAT)
    for k in range(count):
        numbers[k] = scaled(numbers[k]) + offset


def allocate(count: int) -> None:
    np.zeros(count)[0] = 1.0


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def kept_in(folder: Path) -> list[Path]:
    return list(folder.glob("*.code"))


def use(entry: Callable[[int, int, float], None]) -> list[float]:
    numbers = np.array([1.0, 2.5])
    entry(address_of(numbers), 2, 0.25)
    return numbers.tolist()


@pytest.mark.io
def test_an_entry_point_does_what_its_function_does_and_is_kept(folder: Path) -> None:
    assert use(scale) == [3.25, 7.75]
    first = EntryPoint(scale)
    assert not first.is_kept
    assert use(first) == [3.25, 7.75]
    assert first.is_kept
    assert use(EntryPoint(scale)) == [3.25, 7.75]
    assert len(kept_in(folder)) == 1


@pytest.mark.io
def test_a_running_gateway_compiles_nothing(folder: Path) -> None:
    with nothing_compiled():
        with pytest.raises(NotCompiledError):
            use(EntryPoint(scale))
        with pytest.raises(NotCompiledError):
            dispatched(scale)(0, 0, 0.0)
    assert not kept_in(folder)
    use(EntryPoint(scale))
    with nothing_compiled():
        assert use(EntryPoint(scale)) == [3.25, 7.75], "what is kept is loaded"


@pytest.mark.io
@pytest.mark.parametrize(
    "damage", [lambda data: b"", lambda data: data[:-1], lambda data: data[:-50] + bytes(50)]
)
def test_damaged_code_is_made_anew(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    use(EntryPoint(scale))
    [file] = kept_in(folder)
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    assert not EntryPoint(scale).is_kept
    assert use(EntryPoint(scale)) == [3.25, 7.75]
    assert EntryPoint(scale).is_kept


@pytest.mark.io
def test_code_of_an_earlier_source_goes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(EntryPoint(scale))
    monkeypatch.setitem(globals(), "FACTOR", 5.0)
    assert not EntryPoint(scale).is_kept
    # The compiler of this process has bound the constant already.
    monkeypatch.setitem(globals(), "scaled", compiled(lambda x: 5.0 * x))
    assert use(EntryPoint(scale)) == [5.25, 12.75]
    assert len(kept_in(folder)) == 1


@pytest.mark.io
def test_installations_leave_each_other_their_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_by(installation: str) -> None:
        monkeypatch.setattr("gateway.compiled.machine_code._made_for", lambda: installation)

    def keep(digest: str, time_s: int) -> None:
        before = kept_in(folder)
        keep_code("f", digest, MachineCode(digest.encode(), None))
        [new] = set(kept_in(folder)).difference(before)
        os.utime(new, (time_s, time_s))

    run_by("Debian's")
    keep("first source", 1)
    run_by("another")
    assert kept_code("f", "first source") is None
    keep("first source", 2)
    keep("second source", 3)
    assert kept_code("f", "first source") is None
    run_by("Debian's")
    assert kept_code("f", "first source") == MachineCode(b"first source", None)
    for time_s in range(4, 9):
        run_by(f"one of {time_s}")
        keep("second source", time_s)
    assert len(kept_in(folder)) == 1 + OTHERS_KEPT
    run_by("one of 5")
    assert kept_code("f", "second source") is not None
    run_by("Debian's")
    assert kept_code("f", "first source") is None


@pytest.mark.io
def test_that_something_is_compiled_is_told_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(folder))
    monkeypatch.setattr("gateway.compiled.machine_code._HAS_TOLD", told := bytearray(1))
    path = folder / "raced.py"
    path.write_text(SOURCE)
    with caplog.at_level(logging.INFO):
        use(EntryPoint(scale))
        assert caplog.messages == [ONCE]
        process(path)(NEAR)
        assert caplog.messages == [ONCE]
        told[0] = 0
        use(EntryPoint(scale))
        process(path)(NEAR)
        assert caplog.messages == [ONCE], "what is kept is not compiled"
        process(path)(FAR)
        assert caplog.messages == [ONCE, ONCE]


@pytest.mark.io
def test_where_nothing_can_be_kept_it_works_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    entry = EntryPoint(scale)
    assert use(entry) == [3.25, 7.75]
    assert not entry.is_kept


@pytest.mark.io
def test_what_another_process_compiles_is_waited_for(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread stands for the process: a lock of files keeps them apart as well."""
    code, name, digest = compile_entry(compiled(scale)), f"{__name__}.scale", digest_of(scale)

    def fail(_: object) -> None:
        raise AssertionError("compiled twice")

    monkeypatch.setattr("gateway.compiled.compiler.compile_entry", fail)
    with ThreadPoolExecutor() as pool:
        with compiling(name):
            found = pool.submit(EntryPoint(scale).code)
            keep_code(name, digest, code)
        assert found.result() == code


@pytest.mark.io
def test_an_entry_point_may_not_allocate(folder: Path) -> None:
    with pytest.raises(TypeError, match="allocate"):
        EntryPoint(allocate)(3)
    assert not kept_in(folder)


@pytest.mark.io
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no linker")
def test_what_is_kept_is_loaded_without_numba_and_llvm() -> None:
    for entry in KERNELS.live:
        entry.prepare()
    tell = (
        "import sys; from gateway.estimation.select import EstimationSettings, make_estimator;"
        "make_estimator(EstimationSettings(estimator='complementary'));"
        "print({'numba', 'llvmlite'} & {*sys.modules})"
    )
    other = subprocess.run([sys.executable, "-c", tell], check=True, capture_output=True, text=True)
    assert other.stdout == "set()\n"


@pytest.mark.io
@pytest.mark.parametrize("linker", [None, "/bin/false"])
def test_what_cannot_be_linked_is_loaded_by_llvm(
    folder: Path, monkeypatch: pytest.MonkeyPatch, linker: str | None
) -> None:
    monkeypatch.setattr("shutil.which", lambda _: linker)
    assert compile_entry(compiled(scale)).shared is None
    assert use(EntryPoint(scale)) == [3.25, 7.75]
    assert use(EntryPoint(scale)) == [3.25, 7.75]


@pytest.mark.io
def test_what_the_system_does_not_load_is_loaded_by_llvm(folder: Path) -> None:
    use(EntryPoint(scale))
    kept = compile_entry(compiled(scale))
    name, digest = f"{__name__}.scale", digest_of(scale)
    keep_code(name, digest, kept._replace(shared=b"no library"))
    assert use(EntryPoint(scale)) == [3.25, 7.75]


@pytest.mark.io
def test_every_process_takes_the_code_for_made_of_the_same() -> None:
    tell = (
        "from gateway.estimation.complementary.complementary_kernels import KERNELS;"
        "from gateway.compiled import digest_of; print(digest_of(KERNELS.imus.__wrapped__))"
    )
    other = subprocess.run([sys.executable, "-c", tell], check=True, capture_output=True, text=True)
    entry: Any = KERNELS.imus
    assert other.stdout.strip() == digest_of(entry.__wrapped__)


CALLED = """
from gateway.compiled import compiled

FACTOR = {factor}
{comment}
@compiled
def inner():
    return {inner}
"""
CALLING = """
import called
from gateway.compiled import compiled
from called import inner

@compiled
def outer():
    return called.FACTOR * middle()

@compiled
def middle():
    return inner()
"""


@pytest.mark.io
@pytest.mark.parametrize(
    ("factor", "inner", "comment", "same"),
    [
        (2, "100", "", False),
        (1, "3 + 4 * five()", "", False),
        (1, "100", "\n\n# The next function.", True),
    ],
)
def test_what_it_calls_has_changed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    factor: int,
    inner: str,
    comment: str,
    same: bool,
) -> None:
    """Machine code holds the constants and functions of other files, too."""
    monkeypatch.syspath_prepend(tmp_path)
    # Python itself takes a file of the same size and second for unchanged.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "calling.py").write_text(CALLING)
    digests = []
    for parts in ((1, "100", ""), (factor, inner, comment)):
        text = CALLED.format(factor=parts[0], inner=parts[1], comment=parts[2])
        (tmp_path / "called.py").write_text(text)
        for name in ("called", "calling"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        digests.append(digest_of(importlib.import_module("calling").outer))
    assert (digests[0] == digests[1]) == same


def test_the_copies_of_a_template_are_made_of_their_own() -> None:
    one, two = (compiled_with(scaled, {"FACTOR": f}, f"by_{f}") for f in (1.0, 2.0))
    assert [one(7.0), two(7.0), scaled(7.0)] == [7.0, 14.0, 21.0]
    assert len({digest_of(f) for f in (one, two, scaled)}) == 3


SOURCE = """
from gateway.compiled import compiled

@compiled
def read(record):
    return record.x
"""
NEAR = np.zeros(1, [("x", "f8"), ("y", "f8")])[0]
FAR = np.zeros(1, [("y", "f8"), ("x", "f8")])[0]


def process(path: Path) -> Any:
    """The function as another process would have it: nothing compiled, the same files."""
    spec = importlib.util.spec_from_file_location("raced", path)
    assert spec
    assert spec.loader
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return compile_dispatcher(module.read)


@pytest.mark.io
def test_two_processes_compile_for_different_types_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no lock can be had. Both read the index before either has written; the first to name
    its file is the last to write it.
    """
    monkeypatch.setattr("gateway.compiled.compiler.compiling", lambda _: nullcontext())
    # Numba has read the environment before.
    monkeypatch.setattr("numba.config.CACHE_DIR", str(folder))
    path = folder / "raced.py"
    path.write_text(SOURCE)
    NEAR["x"], FAR["x"] = 1.0, 2.0
    first, second = process(path), process(path)
    files, others = first._cache._cache_file, second._cache._cache_file
    write = files._save_data

    def late(name: str, data: object) -> None:
        others._load_index = dict
        assert second(FAR) == 2.0
        write(name, data)

    files._save_data = late
    assert first(NEAR) == 1.0
    assert list(folder.rglob("*.nbc"))
    after = process(path)
    assert after(FAR) == 2.0
    assert after(NEAR) == 1.0
    assert after.stats.cache_hits[after.signatures[0]] == 1
