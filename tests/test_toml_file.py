"""TOML files of users: hostile ones are refused in a moment, and the message says why."""

import itertools
import os
import time
from pathlib import Path

import pytest

from gateway.config import MAX_ERRORS, ConfigError, load
from gateway.recordings.files import FlightError
from gateway.recordings.reading import read_column_map
from gateway.toml_file import MAX_BYTES, MAX_DEPTH, TomlError, read_toml

LIMIT_S = 5.0
DEEP = 50_000


@pytest.mark.parametrize(
    ("text", "why"),
    [
        pytest.param(".".join(["a"] * DEEP) + " = 1", "line 1: is nested", id="dotted key"),
        pytest.param("\n\n[" + ".".join(["a"] * DEEP) + "]", "line 3: is nested", id="section"),
        pytest.param('"a" . ' * DEEP + "b = 1", "nested", id="quoted parts"),
        pytest.param("x = " + "[" * DEEP, "nested", id="lists"),
        pytest.param("x = " + "{a=" * DEEP, "nested", id="tables"),
        pytest.param('x = """\n"""\ny = ' + "[" * DEEP, "line 3: is nested", id="after a text"),
        pytest.param("# " + "x" * MAX_BYTES, "more than 1 MB", id="large"),
        pytest.param("x = " + "1" * 100_000, "not valid TOML", id="long number"),
        pytest.param("[columns", "not valid TOML", id="cut"),
        pytest.param("\x80", "line 1: is not UTF-8 text; save it as UTF-8", id="not UTF-8"),
        pytest.param('x = "t"\n\xe4 = 1\n', "line 2: is not UTF-8 text", id="not UTF-8 below"),
    ],
)
def test_hostile_text_is_refused_in_a_moment(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "file.toml"
    file.write_text(text, encoding="latin-1")
    begin_s = time.process_time()
    with pytest.raises(TomlError, match=why):
        read_toml(file)
    with pytest.raises(ConfigError, match=why):
        load(file)
    with pytest.raises(FlightError, match=why):
        read_column_map(file)
    assert time.process_time() - begin_s < LIMIT_S


def test_pipes_and_devices_are_refused(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    for reader, path in itertools.product((load, read_column_map), (pipe, Path("/dev/zero"))):
        with pytest.raises((ConfigError, FlightError), match="is a pipe or a device"):
            reader(path)


def test_usual_nesting_and_texts_with_brackets_are_read(tmp_path: Path) -> None:
    file = tmp_path / "file.toml"
    for text in (
        "x = 'a.b.c.d.e.f.g.h.i.j.k'  # [[[[[[[[[[",
        'x = """\n[[[[[[[[[[\n{{{{{{{{{{\n"""',
        "x = " + "[" * MAX_DEPTH + "]" * MAX_DEPTH,
        ".".join(["a"] * MAX_DEPTH) + " = 1.5",
        "\n".join(f"a{n}.b.c = {n}.5" for n in range(1000)),
        "x = [1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5]",
    ):
        file.write_text(text)
        assert read_toml(file), text[:60]


def test_only_some_of_many_errors_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "file.toml"
    file.write_text("\n".join(f"unknown{n} = 1" for n in range(30_000)))
    begin_s = time.process_time()
    with pytest.raises(ConfigError) as refused:
        load(file)
    assert len(str(refused.value).splitlines()) == MAX_ERRORS + 1
    file.write_text("[columns]\n" + "\n".join(f"unknown{n} = 'x'" for n in range(30_000)))
    with pytest.raises(FlightError) as unmapped:
        read_column_map(file)
    assert len(str(unmapped.value)) < 1000
    assert time.process_time() - begin_s < LIMIT_S
