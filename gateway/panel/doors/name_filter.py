"""Message names that match a client's regular expression.

Python's engine backtracks, which takes exponential time for some expressions and blocks the whole
process. So a separate process tries the names, once per expression, and the kernel ends it when it
has taken too much processor time: a busy machine makes no expression wrong.
"""

import asyncio
import functools
import json
import signal
import sys
from collections.abc import Iterable
from typing import Final

MAX_PATTERN: Final = 1000
LIMIT_S: Final = 1
"""Of processor time: many times what the start takes, and an ordinary expression takes less yet."""
ENDED_BY_KERNEL: Final = (-signal.SIGXCPU, -signal.SIGKILL)
EVERYTHING: Final = ".*"
AT_ONCE: Final = 2

SIEVE: Final = f"""
import json, re, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, ({LIMIT_S}, {LIMIT_S}))
pattern, names = json.load(sys.stdin)
try:
    wanted = re.compile(pattern)
except re.error as error:
    json.dump(str(error), sys.stdout)
else:
    json.dump([name for name in names if wanted.search(name)], sys.stdout)
"""


class NameFilters:
    """Regular expressions tried on a set of names.

    Parameters
    ----------
    names : iterable of str
        All names.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._turns = asyncio.Semaphore(AT_ONCE)
        self._known = functools.lru_cache(maxsize=64)(self._remember)

    async def matching(self, pattern: str) -> frozenset[str]:
        """Return the names in which an expression is found.

        Raises
        ------
        ValueError
            If it is invalid, or takes too long; the text says which.
        """
        if pattern == EVERYTHING:
            return self._names
        if len(pattern) > MAX_PATTERN:
            raise ValueError(f"filter: it has more than {MAX_PATTERN} letters")
        # Shielded: a client that leaves meanwhile must not cancel the answer to the others.
        return await asyncio.shield(self._known(pattern))

    def _remember(self, pattern: str) -> "asyncio.Task[frozenset[str]]":
        return asyncio.create_task(self._try(pattern))

    async def _try(self, pattern: str) -> frozenset[str]:
        async with self._turns:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-I", "-S", "-c", SIEVE),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.DEVNULL,
            )
            question = json.dumps([pattern, sorted(self._names)]).encode()
            answer, _ = await process.communicate(question)
        if process.returncode in ENDED_BY_KERNEL:
            raise ValueError(f"filter {pattern!r}: it takes too long")
        found = json.loads(answer or b'"it cannot be tried"')
        if isinstance(found, str):
            raise ValueError(f"filter {pattern!r}: {found}")  # noqa: TRY004 -- the value is wrong
        return frozenset(found)
