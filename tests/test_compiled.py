import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from gateway.compiled import is_kept, record_at

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
    return module.read


@pytest.mark.io
def test_two_processes_compile_for_different_types_at_once(tmp_path: Path) -> None:
    """Both read the index before either has written; the first to name its file is the last to
    write it.
    """
    path = tmp_path / "raced.py"
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
    assert list(tmp_path.rglob("*.nbc"))
    after = process(path)
    assert after(FAR) == 2.0
    assert after(NEAR) == 1.0
    assert after.stats.cache_hits[after.signatures[0]] == 1


@pytest.mark.io
def test_every_process_takes_the_code_for_made_of_the_same() -> None:
    tell = (
        "from gateway.compiled import record_at as at; print(at._cache._cache_file._source_stamp)"
    )
    other = subprocess.run([sys.executable, "-c", tell], check=True, capture_output=True, text=True)
    here: Any = record_at
    assert other.stdout.strip() == here._cache._cache_file._source_stamp


@pytest.mark.io
def test_code_is_kept_until_the_source_changes(tmp_path: Path) -> None:
    path = tmp_path / "raced.py"
    path.write_text(SOURCE)
    assert not is_kept(process(path))
    process(path)(NEAR)
    assert is_kept(process(path))
    path.write_text(SOURCE + "    # Another source.\n")
    assert not is_kept(process(path))
    assert is_kept(len), "what is not compiled is never to be waited for"


CALLED = """
from gateway.compiled import compiled

FACTOR = {factor}

@compiled
def inner():
    return {inner}
"""
CALLING = """
from gateway.compiled import compiled
from called import FACTOR, inner

@compiled
def outer():
    return FACTOR * middle()

@compiled
def middle():
    return inner()
"""


@pytest.mark.io
@pytest.mark.parametrize(
    ("factor", "inner", "result"), [(2, "100", 200), (1, "3 + 4 * 5", 23), (1, "100", 100)]
)
def test_what_it_calls_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: int, inner: str, result: int
) -> None:
    """The machine code holds the constants and functions of other files, too."""
    monkeypatch.syspath_prepend(tmp_path)
    # Python itself takes a file of the same size and second for unchanged.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "calling.py").write_text(CALLING)
    for parts, expected in (((1, "100"), 100), ((factor, inner), result)):
        (tmp_path / "called.py").write_text(CALLED.format(factor=parts[0], inner=parts[1]))
        for name in ("called", "calling"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        calling = importlib.import_module("calling")
        assert calling.outer() == expected
    assert bool(calling.outer.stats.cache_hits) == (result == 100)


TEMPLATE = """
from gateway.compiled import compiled, compiled_with

def answer():
    return 0

def outer():
    return 10 + answer()

@compiled
def one():
    return 1

@compiled
def two():
    return {two}

COPIES = [compiled_with(outer, {{"answer": f}}, f.__name__) for f in (one, two)]
"""


@pytest.mark.io
def test_the_copies_of_a_template_keep_code_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In another process, too; and none runs on when what stands in it has changed."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for two, hits in ((2, [0, 0]), (2, [1, 1]), (34, [0, 0])):
        (tmp_path / "template.py").write_text(TEMPLATE.format(two=two))
        monkeypatch.delitem(sys.modules, "template", raising=False)
        importlib.invalidate_caches()
        copies = importlib.import_module("template").COPIES
        assert [copy() for copy in copies] == [11, 10 + two]
        assert [sum(copy.stats.cache_hits.values()) for copy in copies] == hits
