"""What a page does around an order: tells that it failed, and asks before what cannot be undone."""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from nicegui import ui

from gateway.edges.disk.recordings import RecordingError
from gateway.edges.operator.control_socket import ControlError
from gateway.panel.recording_player import PlaybackError
from gateway.panel.uplink import CommandFailedError
from gateway.panel.view_context import NotAllowedError, ViewContext

FAILURES: Final = (
    ControlError, CommandFailedError, NotAllowedError, PlaybackError, RecordingError, OSError,
)  # fmt: skip


@contextmanager
def notify_failure(context: ViewContext) -> Iterator[None]:
    """Tell on the page why an order was not carried out."""
    try:
        yield
    except FAILURES as error:
        text = str(error)
        if context.parts.uplink.is_local or not isinstance(error, ControlError):
            ui.notify(text, type="negative", multi_line=True)
        else:
            ui.notify(f"only a gateway on this machine can: {text}", type="negative")


def confirm(question: str, word: str, act: Callable[[], Awaitable[Any]]) -> None:
    """Ask, and do it on a yes.

    Parameters
    ----------
    question : str
        What would happen.
    word : str
        What the yes is called: the verb.
    act : callable
        Does it.
    """
    with ui.dialog() as dialog, ui.card().classes("asks"):
        ui.label(question).classes("title")

        async def run() -> None:
            dialog.close()
            await act()

        ui.button(word, on_click=run).props("color=negative")
        ui.button("Cancel", on_click=dialog.close).props("flat")
    dialog.on("hide", dialog.delete)
    dialog.open()
