"""Queries that a site answers over Zenoh: the round trip, and its recordings.

Each key has a thread of its own, so that the event loop never waits for a disk or a link. Only
regular files of recordings directly in the folder are read, never through a symbolic link.
"""

import hashlib
import logging
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import msgspec

from gateway.recordings.index import is_file_name, list_recordings

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MAX_QUERIES: Final = 64
"""Maximum waiting queries of one key; beyond, the oldest is not answered."""
MAX_QUERY: Final = 4096
"""Maximum bytes of a query; ours have at most some hundred."""
JOIN_S: Final = 1.0
"""Longest wait for the present answer when queries end; a digest of gigabytes takes longer."""
MAX_PIECE: Final = 128 << 10
"""Maximum bytes of a recording in one answer."""
MAX_LIST: Final = 256 << 10
"""Maximum bytes of a list of recordings, some 2500; beyond, the oldest are left out."""
MAX_FILE: Final = 1 << 60
"""Maximum bytes of a file: far beyond any disk, and within the range of a seek."""
DIGEST_TIMEOUT_S: Final = 300.0
"""Timeout of a digest, of gigabytes on a slow card: no client waits longer."""
READ_SIZE: Final = 1 << 20
"""Bytes read at once for a digest."""


class RefusedQueryError(Exception):
    """A query that cannot be answered; the text gives the reason."""


class RecordingQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A query for recordings; without a file, for their list."""

    file: str = ""
    """Name of a file, as in the list."""
    offset: int = 0
    size: int = 0
    """Bytes from the offset on; the answer is shorter at the end of the file."""
    digest: bool = False
    """Return the SHA-256 of the first `size` bytes instead of bytes."""


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


class QueryAnswers:
    """Answer the queries of one key, one after another, on a thread.

    `answer` turns a query's payload into the answer's, or raises RefusedQueryError.
    """

    def __init__(
        self, session: "zenoh.Session", key: str, answer: Callable[[bytes], bytes]
    ) -> None:
        import zenoh

        self._key = key
        self._answer = answer
        self._failure = zenoh.ZError
        waiting: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_QUERIES)
        self._queryable: Any = session.declare_queryable(key, waiting)
        self._thread = threading.Thread(target=self._serve, name=key, daemon=True)
        self._thread.start()

    def undeclare(self) -> None:
        """Stop answering and join the thread, with a timeout."""
        self._queryable.undeclare()
        self._thread.join(JOIN_S)

    def _serve(self) -> None:
        for query in self._queryable:
            try:
                with query:
                    self._reply(query)
            except self._failure as error:
                log.debug("query not answered: %s", error)

    def _reply(self, query: "zenoh.Query") -> None:
        try:
            answer = self._answer(self._payload_of(query))
        except RefusedQueryError as error:
            query.reply_err(str(error).encode())
        else:
            query.reply(self._key, answer)

    @staticmethod
    def _payload_of(query: "zenoh.Query") -> bytes:
        if query.payload is None:
            return b""
        if len(query.payload) > MAX_QUERY:
            raise RefusedQueryError(f"a query has at most {MAX_QUERY} bytes")
        return query.payload.to_bytes()


class RecordingAnswers:
    """Answer queries for the recordings in a folder; every call waits for the disk."""

    def __init__(self, folder: Path, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._clock_s = clock_s

    def __call__(self, asked: bytes) -> bytes:
        """Answer one query.

        Raises RefusedQueryError if the query is malformed, or there is no such file.
        """
        try:
            query = msgspec.json.decode(asked or b"{}", type=RecordingQuery)
            if not query.file:
                return self._list()
            return self._digest(query) if query.digest else self._piece(query)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise RefusedQueryError(f"no query for recordings: {error}") from error
        except OSError as error:
            raise RefusedQueryError(f"{query.file}: {error.strerror}") from error

    def _list(self) -> bytes:
        """Encode the list, newest last, without the oldest that do not fit into an answer."""
        fitting: list[bytes] = []
        room = MAX_LIST
        for each in reversed(list_recordings(self._folder)):
            files = [
                RemoteFile(path.name, found.st_size)
                for path in each.files
                if stat.S_ISREG((found := path.lstat()).st_mode)
            ]
            item = msgspec.json.encode(RemoteRecording(each.name, files, each.modified_s))
            room -= len(item) + 1
            if room < 1:
                break
            fitting.append(item)
        return b"[" + b",".join(reversed(fitting)) + b"]"

    def _piece(self, query: RecordingQuery) -> bytes:
        if not 0 <= query.offset < MAX_FILE or not 0 < query.size <= MAX_PIECE:
            raise RefusedQueryError(f"a piece is 1 to {MAX_PIECE} bytes of a file")
        with self._open(query.file) as file:
            file.seek(query.offset)
            return file.read(query.size)

    def _digest(self, query: RecordingQuery) -> bytes:
        digest, left = hashlib.sha256(), query.size
        until_s = self._clock_s() + DIGEST_TIMEOUT_S
        with self._open(query.file) as file:
            while left > 0 and (piece := file.read(min(left, READ_SIZE))):
                if self._clock_s() > until_s:
                    text = f"no digest within {DIGEST_TIMEOUT_S:.0f} s"
                    raise RefusedQueryError(f"{query.file}: {text}")
                digest.update(piece)
                left -= len(piece)
        return digest.hexdigest().encode()

    def _open(self, name: str) -> BinaryIO:
        """Open a regular file of a recording in the folder itself."""
        if not is_file_name(name):
            raise RefusedQueryError(f"{name!r} is not a file of a recording")
        # Without O_NONBLOCK, opening a FIFO would wait for its writer.
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(self._folder / name, flags)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise RefusedQueryError(f"{name!r} is not a regular file")
        return os.fdopen(descriptor, "rb")
