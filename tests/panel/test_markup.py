"""Texts of others never become markup, properties or code: checked in the source of the panel."""

import ast
from pathlib import Path

import pytest

PANEL = Path(__file__).resolve().parents[2] / "gateway" / "panel"
CONSTANT_ONLY = {"props", "style", "html", "add_head_html", "add_body_html", "run_javascript",
                 "set_content", "add_css", "markdown", "interactive_image", "run_layer_method",
                 "add_slot"}  # fmt: skip
"""NiceGUI parses or evaluates their strings."""
NO_FORMATTING = {"classes", "mark"}


def calls(source: str) -> list[tuple[str, ast.expr]]:
    """Return every argument of the calls above, with the name called."""
    return [
        (node.func.attr, argument)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        for argument in (*node.args, *(keyword.value for keyword in node.keywords))
    ]


def is_constant(value: ast.expr) -> bool:
    if isinstance(value, ast.IfExp):
        return is_constant(value.body) and is_constant(value.orelse)
    return isinstance(value, ast.Constant) or (isinstance(value, ast.Name) and value.id.isupper())


def is_formatted(value: ast.expr) -> bool:
    return any(
        isinstance(node, ast.JoinedStr | ast.BinOp)
        or (isinstance(node, ast.Attribute) and node.attr in ("format", "join"))
        for node in ast.walk(value)
    )


def violations(source: str) -> list[str]:
    return [
        f"{name}({ast.unparse(value)})"
        for name, value in calls(source)
        if (name in CONSTANT_ONLY and not is_constant(value))
        or (name in NO_FORMATTING and is_formatted(value))
    ]


@pytest.mark.parametrize(
    "path", sorted(PANEL.rglob("*.py")), ids=lambda path: str(path.relative_to(PANEL))
)
def test_no_data_is_formatted_into_properties_styles_classes_html_or_scripts(path: Path) -> None:
    assert violations(path.read_text()) == []


@pytest.mark.parametrize(
    "line",
    [
        'x.props(f"data-name={name}")',
        'x.props("data-name=" + name)',
        "x.props(text)",
        'x.style("color: {}".format(name))',
        'ui.html(f"<b>{name}</b>", sanitize=False)',
        'ui.run_javascript(f"mavgate.units = {units!r}")',
        'x.classes(f"chip {kind}")',
    ],
)
def test_formatted_text_is_found(line: str) -> None:
    assert len(violations(line)) == 1


@pytest.mark.parametrize("path", sorted((PANEL / "web").iterdir()), ids=lambda path: path.name)
def test_file_for_the_browser_states_its_licence_and_evaluates_nothing(path: Path) -> None:
    text = path.read_text()
    licence = "ISC" if path.name == "base_map.json" else "Apache-2.0"
    head = "".join(text.splitlines(keepends=True)[:3])
    assert f"SPDX-License-Identifier: {licence}" in head
    for word in ("innerHTML", "v-html", "eval(", "document.write", "insertAdjacentHTML"):
        assert word not in text
