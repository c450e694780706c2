"""README and docs: links, shell blocks, and the site that is made of them."""

import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer

from gateway.cli.app import COMMANDS, app, load_command
from tests.conftest import ROOT

PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "firmware").glob("*.md")]
)
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
LINK = re.compile(r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)|^\[\d+\]: (\S+)$", re.MULTILINE)
SHELL = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
STUB = """#!/bin/sh
# Note the command and its arguments, each ended by a zero byte, and do nothing.
{ printf '%s\\0' "${0##*/}" "$@"; printf '\\n\\0'; } >> "$NOTED"
"""
STUBBED = (
    *("mavgate", "make", "python", "python3", "pio", "pipx", "uv"),
    *("sudo", "pip", "curl", "dask", "avrdude", "apt", "apt-get", "systemctl", "usermod", "gcloud"),
    "podman",
    *("mavproxy.py", "mkdocs", "pre-commit", "openssl"),
    *("mkdir", "sed", "chmod", "chgrp", "cp", "ln"),
)
"""Programs that must not really run here: they install, connect, write or take minutes."""


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchor_of(heading: str) -> str:
    """Return the anchor that GitHub and mkdocs make of a heading."""
    text = re.sub(r"[`*]|\]\([^)]*\)|\[", "", heading.strip().lower())
    return re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", text))


@pytest.mark.parametrize("name", NAMES)
def test_every_relative_link_has_its_file_and_anchor(name: str) -> None:
    page, wrong = ROOT / name, []
    for first, second in LINK.findall(without_code(page.read_text())):
        target = first or second
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists():
            wrong.append(target)
        elif anchor and file.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", without_code(file.read_text()), re.MULTILINE)
            if anchor not in map(anchor_of, headings):
                wrong.append(target)
    assert wrong == []


def parse(command: Any, name: str, words: list[str], parent: Any = None) -> None:
    """Parse a command line as the program does, without running it."""
    context = command.make_context(name, list(words), parent=parent)
    if not hasattr(command, "resolve_command"):
        return
    rest = [*getattr(context, "_protected_args", []), *context.args]
    if rest:
        found, inner, others = command.resolve_command(context, rest)
        parse(inner, found, others, context)


def check(command: list[str]) -> None:
    """Check the arguments of a noted command."""
    program, *words = command
    if program == "mavgate" and words != ["--install-completion"]:
        with suppress(typer.Exit):
            parse(typer.main.get_command(app), "mavgate", words)
    elif program == "make":
        folder = ROOT / words[words.index("-C") + 1] if "-C" in words else ROOT
        targets = [
            word
            for at, word in enumerate(words)
            if "=" not in word and not word.startswith("-") and words[at - 1] != "-C"
        ]
        text = (folder / "Makefile").read_text()
        for target in targets:
            pattern = rf"^({re.escape(target)}|[\w -]*\b{re.escape(target)}\b[\w -]*)( .*)?:"
            assert re.search(pattern, text, re.MULTILINE), target
    elif program.startswith("python") and words and words[0].endswith(".py"):
        assert (ROOT / words[0]).exists(), words[0]
    elif program.startswith("python") and words[:1] == ["-m"]:
        assert find_spec(words[1]) is not None, words[1]


CODE = re.compile(r"`mavgate ([^`\n]+)`")


@pytest.mark.parametrize("name", [*NAMES, "config/gateway.toml", "docs/troubleshooting.toml"])
def test_commands_in_the_text_exist(name: str) -> None:
    """The leading words of each are a command, or one with its subcommand."""
    for words in map(str.split, CODE.findall((ROOT / name).read_text())):
        if words[0][0] in "-…":
            continue
        assert words[0] in COMMANDS, words
        below = getattr(load_command(words[0]), "commands", {})
        second = words[1] if len(words) > 1 else "-"
        assert not below or second in below or second[0] in "-…", words


@pytest.mark.io
@pytest.mark.parametrize("name", NAMES)
def test_shell_blocks_run_with_valid_commands(name: str, tmp_path: Path) -> None:
    """Each block runs in bash; what would install, connect or write is a stub that notes it."""
    bash = shutil.which("bash")
    assert bash is not None
    blocks = SHELL.findall((ROOT / name).read_text())
    programs, noted = tmp_path / "bin", tmp_path / "noted"
    programs.mkdir()
    noted.touch()
    for program in STUBBED:
        (programs / program).write_text(STUB)
        (programs / program).chmod(0o755)
    home = tmp_path / "home"
    (home / ".config" / "mavgate").mkdir(parents=True)
    environment = {
        "PATH": f"{programs}:/usr/bin:/bin", "HOME": str(home), "USER": "operator",
        "NOTED": str(noted),
    }  # fmt: skip
    for block in blocks:
        # Paths of a virtual environment or of the system are the stubs too.
        text = re.sub(r"(?:\.venv|/opt/mavgate)/bin/(\w+)", r"\1", block)
        text = re.sub(r"cd (?:mavgate|config)", ":", text).replace("/etc/mavgate", str(tmp_path))
        done = subprocess.run(
            [bash, "-euc", text], env=environment, cwd=tmp_path, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{block}\n{done.stderr}"
    calls = [call.strip("\0").split("\0") for call in noted.read_text().split("\n\0") if call]
    for call in calls:
        check(call)
    assert not blocks or calls, "no command was noted"


def test_wrong_command_in_a_shell_block_is_found() -> None:
    check(["mavgate", "play", "--speed", "2", "x.tlog"])
    for line in ("mavgate flly", "mavgate play --sped 2 x.tlog", "make dmeo",
                 "python tools/none.py", "python -m tools.none"):  # fmt: skip
        with pytest.raises(Exception):  # noqa: B017, PT011 -- click's own errors, or an assertion
            check(line.split())


@pytest.mark.io
@pytest.mark.slow
def test_site_builds_strictly_with_search_and_no_remote_assets(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra docs)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    done = subprocess.run(
        [*command, "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    index = (tmp_path / "site" / "search" / "search_index.json").read_text()
    assert "Mutual TLS" in index
    for page in (tmp_path / "site").rglob("*.html"):
        tags = re.findall(r"<(?:script|link|img)[^>]*>", page.read_text())
        remote = [tag for tag in tags if re.search(r'(?:src|href)="?https?://', tag)]
        assert remote == [], page.name
