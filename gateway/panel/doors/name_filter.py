"""Message names that match a client's regular expression.

Python's engine backtracks, which takes exponential time for some expressions and blocks the whole
process. So a separate process tries the names, once per expression, and is killed when it takes
too long.
"""

import asyncio
import functools
import json
import sys
from collections.abc import Iterable
from typing import Final

MAX_PATTERN: Final = 1000
LIMIT_S: Final = 3.0
"""For the start of the process; an ordinary expression takes a thousandth of that."""
EVERYTHING: Final = ".*"
AT_ONCE: Final = 2

SIEVE: Final = """
import json, re, sys
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
            try:
                answer, _ = await asyncio.wait_for(process.communicate(question), LIMIT_S)
            except TimeoutError:
                process.kill()
                await process.wait()
                raise ValueError(f"filter {pattern!r}: it takes too long") from None
        found = json.loads(answer or b'"it cannot be tried"')
        if isinstance(found, str):
            raise ValueError(f"filter {pattern!r}: {found}")  # noqa: TRY004 -- the value is wrong
        return frozenset(found)
