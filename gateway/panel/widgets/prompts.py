"""Headings, uploads, and prompts: why a request failed, a question before it cannot be undone."""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement
from nicegui.events import GenericEventArguments

from gateway.live.control_socket import ControlError
from gateway.panel.playback import PlaybackError
from gateway.panel.recording_jobs import ExportError
from gateway.panel.uplink import CommandFailedError
from gateway.panel.view_context import WEB, NotAllowedError, ViewContext
from gateway.printable import printable
from gateway.recordings.index import RecordingError

FAILURES: Final = (
    ControlError, CommandFailedError, ExportError, NotAllowedError, PlaybackError, RecordingError,
    OSError,
)  # fmt: skip


def heading(text: str) -> TextElement:
    """Add the heading of a card."""
    return TextElement(tag="h2", text=text).classes("title")


class UploadButton(Element, component=WEB / "upload_button.js"):
    """Upload a file; emits `uploaded` with the result, which is also shown on the page.

    Parameters
    ----------
    context : ViewContext
        The page of an operator.
    path : str
        Path of the server below which files of this kind are put.
    accept : str
        Endings of their names.
    label, title : str
        Text of the button, and its name for screen readers.
    """

    def __init__(
        self, context: ViewContext, path: str, accept: str, *, label: str, title: str
    ) -> None:
        super().__init__()
        self._props |= {"path": path, "accept": accept, "label": label, "title": title}
        self._props["limit"] = context.parts.settings.upload_limit_mb * 1_000_000
        self.on("uploaded", _show_upload)


def _show_upload(event: GenericEventArguments) -> None:
    text = printable(str(event.args["text"]))
    ui.notify(text, type="positive" if event.args["ok"] else "negative")


@contextmanager
def notify_failure(context: ViewContext) -> Iterator[None]:
    """Show on the page why a request was not carried out."""
    try:
        yield
    except FAILURES as error:
        text = printable(str(error))
        if context.parts.uplink.is_local or not isinstance(error, ControlError):
            ui.notify(text, type="negative", multi_line=True)
        else:
            ui.notify(f"only a gateway on this machine can: {text}", type="negative")


def named_dialog(name: str) -> ui.dialog:
    """Create a dialog that a screen reader announces by its name."""
    dialog = ui.dialog()
    dialog.props["aria-label"] = name
    return dialog


def closing(dialog: ui.dialog, act: Callable[[], Awaitable[Any]]) -> Callable[[], Awaitable[None]]:
    """Return what closes a dialog and then acts, for a button in it.

    What it shows is shown on the page: the dialog is deleted before a slow link has answered.
    """
    page = ui.context.client

    async def run() -> None:
        dialog.close()
        with page:
            await act()

    return run


def confirm(question: str, word: str, act: Callable[[], Awaitable[Any]]) -> None:
    """Ask for confirmation, and act on a yes.

    Parameters
    ----------
    question : str
        The question.
    word : str
        Label of the confirming button: the verb.
    act : callable
        Called on a yes.
    """
    with named_dialog(question) as dialog, ui.card().classes("asks"):
        ui.label(printable(question)).classes("title")
        ui.button(word, on_click=closing(dialog, act)).props("no-caps color=negative")
        ui.button("Cancel", on_click=dialog.close).props("no-caps flat")
    dialog.on("hide", dialog.delete)
    dialog.open()
