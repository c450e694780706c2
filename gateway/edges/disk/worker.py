"""The threads that do what the event loop must not wait for."""

from concurrent.futures import ThreadPoolExecutor


def begin_worker(name: str) -> ThreadPoolExecutor:
    """Start a thread for files at once: when its first job comes, the loop would wait for it.

    Parameters
    ----------
    name : str
        Prefix of the thread's name.

    Returns
    -------
    ThreadPoolExecutor
        With this one thread.
    """
    worker = ThreadPoolExecutor(1, name)
    worker.submit(int)
    return worker
