"""Output of commands on the terminal: tables, warnings and errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer

from gateway.printable import UserError, printable, printable_json, reason_of

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.progress import Progress, ProgressColumn
    from rich.segment import Segment
    from rich.table import Table
    from rich.text import Text

UNLIMITED_WIDTH: Final = 1000
"""Width of output that is not to a terminal, so that paths and tables are not cut."""
NEGATIVE_NUMBERS: Final = {"ignore_unknown_options": True}
"""Context settings of commands whose arguments may begin with a minus sign."""
JsonOption = Annotated[bool, typer.Option("--json", help="For programs.")]
KINDS: Final = {"int": "write a whole number", "float": "write a number"}
BOUNDS: Final = {"less_than_equal": ("le", "at most"), "greater_than_equal": ("ge", "at least")}
"""Words for the errors of the option parser, by error type."""


def console_of(*, stderr: bool = False) -> Console:
    """Return a console that does not wrap long lines, and does not interpret texts.

    File names and texts of recordings are printed as they are: brackets and colons are not markup,
    and control characters do not reach the terminal.
    """
    # Imported late, because a service prints no tables.
    from rich.console import Console

    class PrintableConsole(Console):
        def render_str(self, text: str, **how: Any) -> Text:
            # Before the layout, so that columns stay aligned.
            return super().render_str(printable(text), **how)

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterator[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

    console = PrintableConsole(
        stderr=stderr, highlight=False, soft_wrap=True, markup=False, emoji=False
    )
    if not console.is_terminal:
        console.width = UNLIMITED_WIDTH
    return console


def print_json(value: object) -> None:
    """Print a value as one line of JSON, without control characters."""
    # Imported late, because a service prints no JSON.
    import msgspec

    print(printable_json(msgspec.json.encode(value).decode()))


def table_of(*columns: str, left: int = 1, rows: Iterable[Iterable[str]] = ()) -> Table:
    """Create a table; the first `left` columns are text, the others numbers.

    No frame and narrow padding, so that the table of clients fits in 80 columns.
    """
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def duration_text(seconds: float) -> str:
    """Write a duration as hours, minutes and whole seconds."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def progress_bar(*columns: ProgressColumn, auto_refresh: bool = False) -> Progress:
    """Create a progress bar on stderr; it is hidden if that is not a terminal.

    `auto_refresh` starts a thread, which is not allowed if processes are forked during the work.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = console_of(stderr=True)
    return Progress(
        TextColumn("{task.description}", markup=False), BarColumn(),
        *(columns or (MofNCompleteColumn(), TimeRemainingColumn())),
        console=console, transient=True, auto_refresh=auto_refresh,
        disable=not console.is_terminal,
    )  # fmt: skip


def refuse(text: str) -> NoReturn:
    """End the command with an error."""
    console_of(stderr=True).print(text, style="red")
    raise typer.Exit(2)


def in_words(error: typer.BadParameter) -> str:
    """Describe an option or argument that could not be parsed: its value, and the allowed ones."""
    errors: list[dict[str, Any]] = getattr(error.__cause__ or error.__context__, "errors", list)()
    if not errors:
        return error.message
    found = errors[0]
    kind, value = str(found["type"]), found["input"]
    if kind in BOUNDS:
        key, words = BOUNDS[kind]
        return f"{value!r}: must be {words} {found['ctx'][key]:g}"
    allowed = KINDS.get(kind.partition("_")[0], error.message.removeprefix("Value error, "))
    return allowed if str(value) in allowed else f"{value!r}: {allowed}"


@contextmanager
def refusing() -> Iterator[None]:
    """End the command with a clear error if the user or a file is at fault."""
    try:
        yield
    except UserError as error:
        refuse(str(error))
    except FileExistsError as error:
        refuse(f"{error.filename}: already exists; use --force to overwrite")
    except OSError as error:
        # An error without a file name is one of the output.
        if error.filename is None:
            raise
        refuse(f"{error.filename}: {error.strerror or reason_of(error)}")
