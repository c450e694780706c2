"""Print the manual page of mavgate, made from the descriptions of its commands.

    python -m tools.make_man | man -l -

Its input is the typer commands themselves.
"""

import re
from collections.abc import Iterator
from typing import Any, Final

import typer

from gateway import __version__
from gateway.cli.app import GROUPS, HELP, app, load_command

HEAD: Final = f'.TH MAVGATE 1 "" "mavgate {__version__}" "User Commands"'
FILES: Final = {
    "/etc/mavgate/gateway.toml": "settings of the system service, with unit and meaning of each",
    "~/.config/mavgate/gateway.toml": "settings of a user",
    "/usr/share/doc/mavgate/": "guides and reference, as Markdown",
}


def main() -> None:
    """Print the page."""
    print("\n".join(page()))


def page() -> Iterator[str]:
    """Yield the lines of the page, as input of groff's package `man`."""
    root = typer.main.get_command(app)
    yield from (HEAD, ".SH NAME", rf"mavgate \- {escaped(str(root.help))}")
    yield from (".SH SYNOPSIS", r".B mavgate", r"[\fIOPTION\fR]... \fICOMMAND\fR [\fIWORD\fR]...")
    yield from (".SH OPTIONS", "These options may also follow a command.")
    yield from parameters(root)
    for heading, names in GROUPS.items():
        yield f".SH {escaped(heading).upper()}"
        for name in names:
            yield from described(load_command(name), f"mavgate {name}")
    yield ".SH FILES"
    for path, text in FILES.items():
        yield from (".TP", rf"\fI{escaped(path)}\fR", escaped(text))


def described(command: Any, words: str) -> Iterator[str]:
    """Yield the section of a command, then those of its subcommands."""
    context = command.context_class(command, info_name=words, **HELP)
    usage = " ".join(command.collect_usage_pieces(context))
    yield from (f".SS {escaped(words)} {escaped(usage)}", *paragraphs(command.help or ""))
    yield from parameters(command)
    for name, each in getattr(command, "commands", {}).items():
        yield from described(each, f"{words} {name}")


def parameters(command: Any) -> Iterator[str]:
    """Yield the arguments and options of a command."""
    context = command.context_class(command, **HELP)
    for parameter in command.get_params(context):
        if parameter.name == "help" or not (record := parameter.get_help_record(context)):
            continue
        names = re.sub(r"list\[(.*?)\]", r"\1", record[0])
        yield from (".TP", rf"\fB{escaped(names)}\fR", *paragraphs(record[1], ".IP"))


def paragraphs(text: str, separator: str = ".PP") -> Iterator[str]:
    """Yield the paragraphs of a help text, without the markup of the terminal."""
    for at, paragraph in enumerate(re.split(r"\n\s*\n", text)):
        if at:
            yield separator
        yield escaped(" ".join(paragraph.split()))


def escaped(text: str) -> str:
    """Return a text that groff prints as it is."""
    text = text.replace("\\", r"\e").replace("-", r"\-").replace("`", r"\(ga")
    text = "".join(c if c.isascii() else f"\\[u{ord(c):04X}]" for c in text)
    return rf"\&{text}" if text.startswith((".", "'")) else text


if __name__ == "__main__":
    main()
