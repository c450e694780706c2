"""The threads that do what the event loop must not wait for."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def begin_worker(name: str, most: int = 1) -> ThreadPoolExecutor:
    """Start a thread at once: when its first job comes, the loop would wait for it."""
    worker = ThreadPoolExecutor(most, name)
    worker.submit(int)
    return worker


async def done_by(
    worker: ThreadPoolExecutor,
    job: Callable[Parameters, Result],
    *args: Parameters.args,
    **kwargs: Parameters.kwargs,
) -> Result:
    """Return a job's result; the job is done even if the task that waits for it is cancelled."""
    job_alone = partial(job, *args, **kwargs)
    return await asyncio.shield(asyncio.get_running_loop().run_in_executor(worker, job_alone))
