"""The architecture, enforced: import rules, purity, function length, no import cycles."""

import ast
import subprocess
from collections import Counter
from collections.abc import Iterable
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent / "gateway"

FOUNDATION = {"records", "units", "gps_time", "settings", "token_bucket", "compiled", "geometry"}
STAGES = {"wire", "sensing", "estimation", "vehicle", "simulator"}
JOINED = {"aircraft", "pipeline"}
BELOW = FOUNDATION | STAGES | JOINED | {"vehicle_state"}
COLUMN_CODEC = {"recordings.columns", "recordings.rows", "recordings.formats"}
EDGES = {"hub", "live", "clock", "printable"}

MAY_IMPORT: dict[str, set[str]] = {
    "records": set(),
    "units": set(),
    "gps_time": {"units"},
    "settings": set(),
    "token_bucket": {"units"},
    "compiled": set(),
    "output": set(),
    "toml_file": set(),
    "geometry": {"records", "compiled"},
    "wire": FOUNDATION,
    "sensing": FOUNDATION,
    "estimation": FOUNDATION,
    "vehicle": FOUNDATION | {"sensing", "wire"},
    "clock": set(),
    "printable": set(),
    "extras": {"printable"},
    "hub": FOUNDATION | {"wire", "printable", "extras", "answers", "recordings.index"},
    "simulator": FOUNDATION | {"wire"},
    "sources": FOUNDATION | {"wire", "printable", "hub.endpoint", *COLUMN_CODEC},
    "aircraft": FOUNDATION | {"wire", "sensing", "estimation", "vehicle"},
    "pipeline": FOUNDATION | {"wire", "vehicle", "aircraft", "sources"},
    "vehicle_row": {"printable", "units"},
    "status": FOUNDATION | {"hub", "vehicle", "aircraft", "printable", "vehicle_row"},
    "vehicle_state": FOUNDATION | {"wire"},
    "answers": FOUNDATION | {"wire", "vehicle", "vehicle_state"},
    "recordings": BELOW | {"answers", "output", "printable", "extras", "toml_file"},
    "analysis": BELOW | {"recordings", "output", "printable"},
    "batch": BELOW | EDGES | {"answers", "recordings", "analysis", "extensions", "output"},
    "panel": BELOW - JOINED | EDGES | {"status", "recordings", "analysis", "batch"},
    "fleet": FOUNDATION | STAGES | {"output", "recordings"} | EDGES,
    "config": BELOW | EDGES | {"panel", "fleet", "output", "toml_file", "sources"},
    "flashing": FOUNDATION | {"wire", "live"},
    "live": BELOW
    | EDGES
    | {"status", "vehicle_row", "config", "recordings", "output", "extras", "sources"},
    "extensions": {"printable"},
    "outputs": FOUNDATION | {"wire", "vehicle_state", "extras"} | EDGES,
    "player": BELOW | EDGES | {"answers", "recordings", "config"},
    "cli": BELOW
    | EDGES
    | {
        "status",
        "vehicle_row",
        "answers",
        "recordings",
        "config",
        "player",
        "analysis",
        "output",
        "sources",
    }
    | {"extensions", "extras", "panel", "fleet", "flashing", "batch"},
}
"""The law: a package may import itself and these packages, or modules of packages; `gateway` itself
(the version) is free to all."""

PURE = (
    FOUNDATION - {"compiled"}
    | STAGES
    | JOINED
    | {"status", "vehicle_row", "hub", "sources"}
    | {"vehicle_state", "answers"}
)
IMPURE_PARTS = {
    *("hub/forwarding.py", "hub/forwarding_step.py", "hub/hub.py", "hub/router.py"),
    *("hub/transports", "hub/transports/zenoh"),
}
"""Impure parts of pure packages."""
PURE_FOLDERS = {"panel/state"}
PURE_FILES = {"batch/facts.py"} | {
    f"recordings/{name}.py"
    for name in (
        *("columns", "rows", "table_lines", "table", "tlog", "tlog_scan", "moment"),
        *("play", "formats/csv", "formats/maps", "formats/mavlink"),
    )
}
"""Pure parts of packages that are not."""

IMPURE_MODULES = {
    "asyncio", "fcntl", "glob", "io", "logging", "multiprocessing", "os", "pathlib", "pty",
    "random", "secrets", "select", "selectors", "serial", "shutil", "signal", "socket",
    "subprocess", "sys", "tempfile", "termios", "threading", "time", "tty",
}  # fmt: skip
"""I/O, threads, clocks, logs and unseeded chance: none of them in a pure package."""

MAX_FUNCTION_LINES = 40

SOURCES = sorted(ROOT.rglob("*.py"))


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(tree_of(path)))


def package_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@cache
def imported_modules(path: Path) -> set[str]:
    found: set[str] = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            if node.module == "gateway":
                found |= {f"gateway.{alias.name}" for alias in node.names}
            elif node.module.startswith("gateway."):
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def names_of(paths: Iterable[Path]) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in paths]


def test_imports_are_those_that_may_import_allows() -> None:
    wrong: dict[str, set[str]] = {}
    for path in SOURCES:
        package = package_of(path)
        if package == "__init__":
            continue
        allowed = MAY_IMPORT[package] | {"__version__", package}
        imported = {
            (parts[1], ".".join(parts[1:3]))
            for module in imported_modules(path)
            if (parts := module.split("."))[0] == "gateway" and len(parts) > 1
        }
        if beyond := {module for name, module in imported if not {name, module} & allowed}:
            wrong[str(path.relative_to(ROOT))] = beyond
    assert wrong == {}


def test_pure_packages_do_no_io() -> None:
    wrong: dict[str, set[str]] = {}
    for path in SOURCES:
        name = path.relative_to(ROOT)
        is_pure = package_of(path) in PURE or str(name.parent) in PURE_FOLDERS
        if not is_pure and str(name) not in PURE_FILES:
            continue
        if {str(name), str(name.parent)} & IMPURE_PARTS:
            continue
        tops = {module.split(".")[0] for module in imported_modules(path)}
        calls = {
            node.func.id
            for node in nodes_of(path)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        if found := tops & IMPURE_MODULES | calls & {"open", "print", "input"}:
            wrong[str(name)] = found
    assert wrong == {}


def test_mavutil_is_not_imported() -> None:
    users = [path for path in SOURCES if "pymavlink.mavutil" in imported_modules(path)]
    assert names_of(users) == []


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function's body, without its docstring."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def late_constants(tree: ast.Module) -> list[str]:
    """Return the constants below a definition that use no name bound since the first one."""
    bound: set[str] = set()
    found: list[str] = []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif bound and isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = [part for target in targets for part in ast.walk(target)]
            names = [part.id for part in parts if isinstance(part, ast.Name)]
            # The body of a lambda is evaluated later.
            bodies = [each.body for each in ast.walk(node) if isinstance(each, ast.Lambda)]
            later = {id(part) for body in bodies for part in ast.walk(body)}
            read = [part for part in ast.walk(node) if isinstance(part, ast.Name)]
            used = {part.id for part in read if id(part) not in later}
            if bound & used or any(isinstance(part, ast.Attribute) for part in parts):
                bound.update(names)
            else:
                found += names
    return found


def test_constants_stand_at_the_head_of_a_file() -> None:
    late = {names_of([path])[0]: late_constants(tree_of(path)) for path in SOURCES}
    assert {path: names for path, names in late.items() if names} == {}


def test_functions_have_at_most_40_lines() -> None:
    long = {
        f"{path.relative_to(ROOT)}: {node.name}": lines_of(node)
        for path in SOURCES
        for node in nodes_of(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and lines_of(node) > MAX_FUNCTION_LINES
    }
    assert long == {}


def test_stages_import_no_edge() -> None:
    """Only the root, the command line and the settings file (for the edges' keys) do."""
    knowing = {
        package_of(path)
        for path in SOURCES
        for module in imported_modules(path)
        if module.startswith(("gateway.live", "gateway.hub.transports"))
    }
    edges = {"cli", "config", "flashing", "fleet", "hub", "live", "panel", "player", "outputs"}
    assert knowing <= edges | {"batch"}


def test_no_two_public_classes_share_a_name() -> None:
    names = Counter(
        node.name
        for path in SOURCES
        for node in tree_of(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_imports_form_no_cycle() -> None:
    """Imports for type checkers alone count too: they are knowledge all the same."""
    modules = {
        ".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path for path in SOURCES
    }
    graph = {
        name: imported_modules(path) & modules.keys() - {name} for name, path in modules.items()
    }
    TopologicalSorter(graph).prepare()


def test_repository_contains_no_ignored_file() -> None:
    """A checkout would put it in the place of what is there, such as a virtual environment."""
    ask = ["git", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    try:
        asked = subprocess.run(ask, cwd=ROOT.parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no repository here: {error}")
    assert asked.stdout == ""
