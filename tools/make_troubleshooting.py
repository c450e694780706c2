"""Write docs/troubleshooting.md: every text and warning of mavgate with its cause and remedy.

usage: python -m tools.make_troubleshooting [--check]

The messages come from the source code: each `StatusText`, and each call of a logger at WARNING or
above. Causes and remedies come from docs/troubleshooting.toml, where the first entry whose `match`
is part of a message explains it. The command fails while a message has no explanation; with
`--check` also if the page is not up to date.
"""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "troubleshooting.md"
EXPLANATIONS: Final = ROOT / "docs" / "troubleshooting.toml"
LOG_LEVELS: Final = frozenset({"warning", "error", "critical", "exception"})
TEXT_CALLS: Final = {
    "StatusText": (1,),
    "status_text": (1, 2),
    "MAVLink_statustext_message": (1,),
    "ClientAlert": (1,),
}
"""Functions that create texts for ground stations, with the position of the text argument."""
HOLE: Final = "…"
"""Placeholder for a value that is known only at run time."""
MAX_DEPTH: Final = 4
"""Maximum number of calls followed back from a parameter to its value."""
LEAST_LETTERS: Final = 4
"""Least letters of a message; for a shorter pattern the values are searched."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, order=True, slots=True)
class Message:
    """A message that mavgate can emit."""

    kind: str
    """`text` for ground stations, or `log`."""
    pattern: str
    """Its text, with `…` for values."""
    source: str
    """File and line."""


@dataclass(frozen=True, slots=True)
class _Call:
    call: ast.Call
    caller: Function | None
    package: str


class Sources:
    """The syntax trees of the package in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._trees = {path: ast.parse(path.read_text()) for path in sorted(folder.rglob("*.py"))}
        self._calls = {path: list(_calls(tree)) for path, tree in self._trees.items()}

    def messages(self) -> list[Message]:
        """Return all messages, in the order of their texts."""
        found: set[Message] = set()
        for path, calls in self._calls.items():
            package = self._package_of(path)
            for call, function in calls:
                kind, expressions = _texts_of(call)
                source = f"{path.relative_to(self._folder.parent)}:{call.lineno}"
                for expression in expressions:
                    for pattern in self._patterns(expression, function, package, 0):
                        found.add(Message(kind, _tidied(pattern), source))
        # "Receiver: bus OK again" is covered by "…: bus OK again".
        general = {each.pattern for each in found if not _is_dynamic(each)}
        return sorted(
            each
            for each in found
            if each.pattern.startswith(HOLE)
            or f"{HOLE}: {each.pattern.partition(': ')[2]}" not in general
        )

    def _package_of(self, path: Path) -> str:
        return path.relative_to(self._folder).parts[0]

    @cached_property
    def _calls_by_name(self) -> dict[tuple[str, str], list["_Call"]]:
        """Return calls by package and name of the called function."""
        found: dict[tuple[str, str], list[_Call]] = {}
        for path, calls in self._calls.items():
            package = self._package_of(path)
            for call, function in calls:
                key = (package, _name_of(call.func))
                found.setdefault(key, []).append(_Call(call, function, package))
        return found

    @cached_property
    def _values(self) -> dict[str, ast.expr]:
        """Return annotated values at module level by name."""
        return {
            node.target.id: node.value
            for tree in self._trees.values()
            for node in tree.body
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value
        }

    @cached_property
    def _constants(self) -> dict[str, str]:
        """Return texts at module level by name."""
        return {
            name: value.value
            for name, value in self._values.items()
            if isinstance(value, ast.Constant) and isinstance(value.value, str)
        }

    def _patterns(
        self, node: ast.expr, function: Function | None, package: str, depth: int
    ) -> list[str]:
        """Return the texts that an expression may have."""
        match node:
            case ast.Constant(value=str(text)):
                return [text]
            case ast.IfExp():
                return self._patterns(node.body, function, package, depth) + self._patterns(
                    node.orelse, function, package, depth
                )
            case ast.JoinedStr():
                return self._joined(node.values, function, package, depth)
            case ast.BinOp(op=ast.Add()):
                return self._joined([node.left, node.right], function, package, depth)
            case (
                ast.Subscript(value=inner)
                | ast.Call(func=ast.Attribute(value=inner, attr="encode"))
                | ast.Call(func=ast.Name(id="utf8"), args=[inner, _])
            ):
                return self._patterns(inner, function, package, depth)
            case ast.Name(id=name):
                return self._named(name, function, package, depth) or [HOLE]
            case _:
                return [HOLE]

    def _joined(
        self, parts: list[ast.expr], function: Function | None, package: str, depth: int
    ) -> list[str]:
        found = [""]
        literal = "".join(str(part.value) for part in parts if isinstance(part, ast.Constant))
        for part in parts:
            values = [HOLE]
            if isinstance(part, ast.Constant):
                values = [str(part.value)]
            elif isinstance(part, ast.BinOp | ast.JoinedStr):
                values = self._patterns(part, function, package, depth)
            else:
                inner = part.value if isinstance(part, ast.FormattedValue) else part
                if isinstance(inner, ast.Name) and inner.id in self._constants:
                    values = [self._constants[inner.id]]
                elif len(re.findall(r"[A-Za-z]", literal)) < LEAST_LETTERS:
                    values = self._patterns(inner, function, package, depth)
            found = [before + value for before in found for value in values]
        return found

    def _named(self, name: str, function: Function | None, package: str, depth: int) -> list[str]:
        if name in self._constants:
            return [self._constants[name]]
        if function is None or depth >= MAX_DEPTH:
            return []
        assigned = [
            pattern
            for node in ast.walk(function)
            for value in self._assigned(node, name, function, package)
            for pattern in self._patterns(value, function, package, depth)
        ]
        return assigned or self._passed(name, function, package, depth)

    def _assigned(
        self, node: ast.AST, name: str, function: Function, package: str
    ) -> list[ast.expr]:
        """Return the values that a statement assigns to a name, directly or in a loop over rows."""
        match node:
            case ast.Assign(targets=[target], value=ast.expr() as value):
                rows = [value]
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                rows = [value]
            case ast.For(target=target, iter=ast.Name(id=table)):
                passed = [value for value, _ in self._arguments(table, function, package)]
                names = [table, *(value.id for value in passed if isinstance(value, ast.Name))]
                tables = [self._values[name] for name in names if name in self._values]
                rows = [row for each in tables for row in getattr(each, "elts", [])]
            case _:
                return []
        return [value for row in rows for value in _unpacked(target, row, name)]

    def _passed(self, name: str, function: Function, package: str, depth: int) -> list[str]:
        """Return the values of a parameter in all calls of its function."""
        return [
            pattern
            for value, caller in self._arguments(name, function, package)
            for pattern in self._patterns(value, caller, package, depth + 1)
        ]

    def _arguments(
        self, name: str, function: Function, package: str
    ) -> Iterator[tuple[ast.expr, Function | None]]:
        """Yield the argument of each call for a parameter, with the caller, without recursion."""
        parameters = [argument.arg for argument in function.args.args]
        if name not in parameters:
            return
        position = parameters.index(name) - (parameters[0] == "self")
        for one in self._calls_by_name.get((package, function.name), []):
            given = [word.value for word in one.call.keywords if word.arg == name]
            given += one.call.args[position : position + 1]
            if given and one.caller is not function:
                yield given[0], one.caller


def _calls(tree: ast.AST) -> Iterator[tuple[ast.Call, Function | None]]:
    """Yield each call with the function around it."""
    nodes: list[tuple[ast.AST, Function | None]] = [(tree, None)]
    while nodes:
        node, function = nodes.pop()
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Call):
                yield child, function
            inner = child if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) else function
            nodes.append((child, inner))


def _unpacked(target: ast.expr, value: ast.expr, name: str) -> list[ast.expr]:
    """Return the parts of a value that unpacking assigns to a name."""
    if isinstance(target, ast.Name):
        return [value] if target.id == name else []
    if isinstance(value, ast.IfExp):
        return _unpacked(target, value.body, name) + _unpacked(target, value.orelse, name)
    if not (isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)):
        return []
    pairs = zip(target.elts, value.elts, strict=False)
    return [part for inner, element in pairs for part in _unpacked(inner, element, name)]


def _name_of(function: ast.expr) -> str:
    return getattr(function, "id", getattr(function, "attr", ""))


def _texts_of(call: ast.Call) -> tuple[str, list[ast.expr]]:
    """Return the kind and the text expressions of a call that emits a message."""
    name = _name_of(call.func)
    owner = getattr(call.func, "value", None)
    if name in LOG_LEVELS and isinstance(owner, ast.Name) and owner.id == "log" and call.args:
        first = call.args[0]
        if isinstance(first, ast.Constant) and first.value == "%s" and len(call.args) > 1:
            first = call.args[1]
        return "log", [first]
    return "text", [call.args[at] for at in TEXT_CALLS.get(name, ()) if at < len(call.args)]


def _tidied(pattern: str) -> str:
    text = re.sub(r"%[-#0-9.]*[sdrfx]", HOLE, pattern)
    return re.sub(f"{HOLE}+", HOLE, " ".join(text.split()))


def _is_dynamic(message: Message) -> bool:
    """Return whether the text of a message is not in the call that emits it."""
    return len(re.findall(r"[A-Za-z]", message.pattern)) < LEAST_LETTERS


def with_dynamic(messages: list[Message], dynamic: list[dict[str, str]]) -> list[Message]:
    """Replace messages without a text in their call by the listed ones."""
    found = [message for message in messages if not _is_dynamic(message)]
    listed = [Message(entry["kind"], entry["text"], "several") for entry in dynamic]
    return sorted(found + listed)


def explained(messages: list[Message], entries: list[dict[str, str]]) -> tuple[str, list[str]]:
    """Return the tables of the page, and the messages without an explanation."""
    wrong: list[str] = []
    rows: dict[str, list[str]] = {"text": [], "log": []}
    shown: set[tuple[str, str]] = set()
    for message in messages:
        if (message.kind, message.pattern) in shown:
            continue
        shown.add((message.kind, message.pattern))
        entry = next((each for each in entries if each["match"] in message.pattern), None)
        if entry is None:
            wrong.append(f"no explanation of {message.pattern!r} ({message.source})")
            continue
        cells = (f"`{message.pattern}`", entry["cause"], entry["remedy"])
        rows[message.kind].append(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
        )
    head = "| message | cause | remedy |\n| --- | --- | --- |\n"
    texts, logs = ("\n".join(rows[kind]) for kind in ("text", "log"))
    page = (
        "## Texts in the ground station\n\n"
        f"`{HOLE}` stands for a value. A text that says again, back or OK reports the end of a "
        f"problem.\n\n{head}{texts}\n\n"
        f"## Warnings in the log\n\n{head}{logs}\n"
    )
    return page, wrong


def page_of(sources: Sources, explanations: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the whole page, and the messages without an explanation."""
    messages = with_dynamic(sources.messages(), explanations["dynamic"])
    tables, wrong = explained(messages, explanations["message"])
    note = "<!-- Written by `python -m tools.make_troubleshooting`; edit troubleshooting.toml. -->"
    return f"{note}\n\n{explanations['intro'].strip()}\n\n{tables}", wrong


def main() -> None:
    """Write the page, or check it."""
    page, wrong = page_of(Sources(ROOT / "gateway"), tomllib.loads(EXPLANATIONS.read_text()))
    if "--check" not in sys.argv:
        PAGE.write_text(page)
    elif PAGE.read_text() != page:
        wrong.append(f"{PAGE.name} is not up to date: run python -m tools.make_troubleshooting")
    for line in wrong:
        print(line)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
