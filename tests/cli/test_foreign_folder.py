"""Python files in the current folder, as among unpacked recordings, are never imported."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.live.terminal import own_command

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("msgspec", "typer", "numpy", "pickle", "selectors", "multiprocessing", "gateway")
SPAWN = """
import multiprocessing, sys
from gateway.cli.__main__ import main

def work() -> None:
    import msgspec

if __name__ == "__main__":
    sys.argv[1:] = ["--version"]
    try:
        main()
    except SystemExit:
        pass
    process = multiprocessing.get_context("spawn").Process(target=work)
    process.start()
    process.join()
    sys.exit(process.exitcode)
"""

pytestmark = pytest.mark.io


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose modules leave a mark when they are imported."""
    folder = tmp_path / "flights"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'a').write('ran')\n")
    return folder


def run_in(folder: Path, *words: str) -> None:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert not (folder.parent / "mark").exists(), "a file of the current folder was executed"
    assert done.returncode == 0, done.stderr


def test_child_process_imports_nothing_from_the_current_folder(folder: Path) -> None:
    run_in(folder, *own_command("doctor"), "--template", "all")


def test_process_pool_imports_nothing_from_the_current_folder(folder: Path) -> None:
    """`multiprocessing` starts its processes as `python -c`."""
    script = folder.parent / "mavgate"
    script.write_text(SPAWN)
    run_in(folder, sys.executable, str(script))


def test_every_python_child_is_started_with_a_safe_module_path() -> None:
    unsafe = []
    texts = {path: path.read_text() for path in sorted((ROOT / "gateway").rglob("*.py"))}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text if "sys.executable" in text else "")):
            match getattr(node, "elts", None) or getattr(node, "args", None):
                case [ast.Attribute(value=ast.Name(id="sys"), attr="executable") as first, *rest]:
                    options = [each.value for each in rest[:1] if isinstance(each, ast.Constant)]
                    if options not in (["-P"], ["-I"]):
                        unsafe.append(f"{path.relative_to(ROOT)}:{first.lineno}")
    assert unsafe == []
