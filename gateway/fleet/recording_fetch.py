"""Fetch a recording of a site in pieces, through the running fleet.

A partial file is stored next to the target as `.NAME.part` until it is complete and its SHA-256 is
that of the site's file, so an incomplete file never looks complete. An existing partial file is
continued if it is the beginning of the site's file.
"""

import base64
import fcntl
import hashlib
import os
import shutil
import time
from collections.abc import Callable
from io import BufferedRandom
from pathlib import Path
from typing import Any, Final

from gateway.output import sync_folder
from gateway.recordings.index import is_file_name

SMALLEST: Final = 4 << 10
LARGEST: Final = 128 << 10
"""Largest piece in one answer, bytes."""
FAST_S: Final = 0.05
SLOW_S: Final = 0.2
RETRY_S: Final = 1.0
SITE_TIMEOUT_S: Final = 60.0
"""Timeout of a disconnected site."""
DIGEST_WAIT_S: Final = 330.0
PIECE_WAIT_S: Final = 20.0

Ask = Callable[[str, dict[str, Any], float], Any]
"""Sends a request to a fleet: verb, parameters, and timeout in seconds."""


class FetchError(Exception):
    """A file cannot be fetched; the text gives the reason and the remedy."""


class RecordingFetch:
    """Fetch files of one site into a folder."""

    def __init__(
        self,
        site: str,
        folder: Path,
        ask: Ask,
        *,
        force: bool = False,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._site = site
        self._folder = folder
        self._ask = ask
        self._force = force
        self._wait = wait
        self.piece_size = SMALLEST
        """Adapted so that a piece, which delays telemetry, takes about a tenth of a second."""

    def fetch(self, name: str, size: int, advance: Callable[[int], None]) -> bool:
        """Fetch one file, or the rest of it; return whether it was incomplete."""
        if not is_file_name(name):
            raise FetchError(f"the site lists {name!r}, which is not a file of a recording")
        target, part = self._folder / name, self._folder / f".{name}.part"
        if target.exists():
            is_beginning = target.stat().st_size <= size and self._is_beginning(target, name)
            if is_beginning and target.stat().st_size == size:
                advance(size)
                return False
            if not (self._force or is_beginning):
                raise FetchError(f"{target} exists and differs; use --force to replace it")
        self._folder.mkdir(parents=True, exist_ok=True)
        with part.open("a+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise FetchError(f"{target} is being fetched by another program") from error
            if target.exists() and not file.seek(0, os.SEEK_END):
                # The existing file may be the beginning; otherwise the fetch starts from zero.
                with target.open("rb") as known:
                    shutil.copyfileobj(known, file)
            self._fill(file, name, size, advance)
            file.flush()
            os.fsync(file.fileno())
            part.replace(target)
        sync_folder(self._folder)
        return True

    def _is_beginning(self, target: Path, name: str) -> bool:
        with target.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            return self._digest(name, file.tell()) == digest

    def _fill(
        self, file: BufferedRandom, name: str, size: int, advance: Callable[[int], None]
    ) -> None:
        """Fetch until the file is complete and equals the site's."""
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256")
        have = file.seek(0, os.SEEK_END)
        if have and (have > size or digest.hexdigest() != self._digest(name, have)):
            file.truncate(0)
            digest, have = hashlib.sha256(), 0
        advance(have)
        while have < size:
            piece = self._piece(name, have, min(self.piece_size, size - have))
            if not piece:
                raise FetchError(f"{name} has become shorter at the site; fetch it again")
            file.write(piece)
            digest.update(piece)
            have += len(piece)
            advance(len(piece))
        if digest.hexdigest() != self._digest(name, size):
            file.truncate(0)
            raise FetchError(f"{name} has changed at the site; fetch it again")

    def _piece(self, name: str, offset: int, size: int) -> bytes:
        params = {"file": name, "offset": offset, "size": size}
        begin_s = time.monotonic()
        data = base64.b64decode(self._persist("fleet.piece", params, "data", PIECE_WAIT_S))
        took_s = time.monotonic() - begin_s
        if took_s < FAST_S:
            self.piece_size = min(self.piece_size * 2, LARGEST)
        elif took_s > SLOW_S:
            self.piece_size = max(self.piece_size // 2, SMALLEST)
        # Leave half of the time to telemetry.
        self._wait(min(took_s, SLOW_S))
        return data

    def _digest(self, name: str, size: int) -> str:
        params = {"file": name, "size": size}
        return self._persist("fleet.digest", params, "sha256", DIGEST_WAIT_S)

    def _persist(self, verb: str, params: dict[str, Any], key: str, wait_s: float) -> str:
        """Retry until there is an answer, since links may fail for a while."""
        end_s = time.monotonic() + SITE_TIMEOUT_S
        while True:
            answer: str | None = self._ask(verb, {"site": self._site, **params}, wait_s)[key]
            if answer is not None:
                return answer
            if time.monotonic() > end_s:
                raise FetchError(
                    f"site {self._site} does not answer; the same command continues from here"
                )
            self._wait(RETRY_S)
