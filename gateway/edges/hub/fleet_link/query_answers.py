"""Answers the queries on one key, on a thread of its own: the event loop never waits for it."""

import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MAX_QUERIES: Final = 64
"""That wait for their answer; then the oldest gets none."""

ANSWER_S: Final = 1.0
"""Nearly every answer is given by then."""


class RefusedQueryError(Exception):
    """A query that cannot be answered; the text says why."""


class QueryAnswers:
    """Answer queries one after another.

    Parameters
    ----------
    session : zenoh.Session
        An open session.
    key : str
        Where it is asked.
    answer : callable
        Turns a query's payload into the answer's; raises RefusedQueryError. Called on the thread.
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
        """Answer no more, and wait for the thread, though not for all of a long answer."""
        self._queryable.undeclare()
        self._thread.join(ANSWER_S)

    def _serve(self) -> None:
        for query in self._queryable:
            try:
                with query:
                    self._reply(query)
            except self._failure as error:
                log.debug("not answered: %s", error)

    def _reply(self, query: "zenoh.Query") -> None:
        asked = b"" if query.payload is None else query.payload.to_bytes()
        try:
            answer = self._answer(asked)
        except RefusedQueryError as error:
            query.reply_err(str(error).encode())
        else:
            query.reply(self._key, answer)
