"""A site's recordings as a fleet sees them: listed, read in pieces, and their digests.

Only files of recordings in the folder itself are read, and none that is a link to elsewhere.
"""

import hashlib
import os
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from gateway.edges.disk.recordings import is_file_name, list_recordings
from gateway.edges.hub.fleet_link.query_answers import RefusedQueryError

MAX_PIECE: Final = 128 << 10
"""Bytes of one answer."""
MAX_FILE: Final = 1 << 60
"""Bytes of a file, far beyond any disk and within what a seek takes."""
READ_SIZE: Final = 1 << 20
"""Bytes read at once for a digest."""


class RecordingQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What is asked; without a file, the list."""

    file: str = ""
    """Name of a file, as the list has it."""
    offset: int = 0
    size: int = 0
    """Bytes from the offset on; fewer come at the end of the file."""
    digest: bool = False
    """Not the bytes but their SHA-256."""


class RemoteFile(msgspec.Struct, frozen=True):
    """A file of a recording as it was listed; it may grow."""

    name: str
    size: int


class RemoteRecording(msgspec.Struct, frozen=True):
    """A recording of a site."""

    name: str
    files: list[RemoteFile]
    modified_s: float
    """When it was last written, in s since 1970."""


class RecordingAnswers:
    """Answer for a folder; everything here waits for the disk.

    Parameters
    ----------
    folder : Path
        Where the recordings are.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, asked: bytes) -> bytes:
        """Answer one query.

        Raises
        ------
        RefusedQueryError
            If it is none, or there is no such file.
        """
        try:
            query = msgspec.json.decode(asked or b"{}", type=RecordingQuery)
            if not query.file:
                return msgspec.json.encode(self._list())
            return self._digest(query) if query.digest else self._piece(query)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise RefusedQueryError(f"no query for recordings: {error}") from error
        except OSError as error:
            raise RefusedQueryError(f"{query.file}: {error.strerror}") from error

    def _list(self) -> list[RemoteRecording]:
        return [
            RemoteRecording(
                each.name,
                [
                    RemoteFile(path.name, path.stat().st_size)
                    for path in each.files
                    if not path.is_symlink()
                ],
                each.modified_s,
            )
            for each in list_recordings(self._folder)
        ]

    def _piece(self, query: RecordingQuery) -> bytes:
        if not 0 <= query.offset < MAX_FILE or not 0 < query.size <= MAX_PIECE:
            raise RefusedQueryError(f"a piece is 1 to {MAX_PIECE} bytes of a file")
        with self._open(query.file) as file:
            file.seek(query.offset)
            return file.read(query.size)

    def _digest(self, query: RecordingQuery) -> bytes:
        digest, left = hashlib.sha256(), query.size
        with self._open(query.file) as file:
            while left > 0 and (piece := file.read(min(left, READ_SIZE))):
                digest.update(piece)
                left -= len(piece)
        return digest.hexdigest().encode()

    def _open(self, name: str) -> BinaryIO:
        """Open a recording's file; a name that leaves the folder is none."""
        if not is_file_name(name):
            raise RefusedQueryError(f"{name!r} is no file of a recording")
        return os.fdopen(os.open(self._folder / name, os.O_RDONLY | os.O_NOFOLLOW), "rb")
