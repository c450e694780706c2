"""The threads for files."""

import threading

from gateway.live.kept_files import begin_worker


def test_the_thread_is_there_before_its_first_job() -> None:
    others = set(threading.enumerate())
    worker = begin_worker("files")
    before = {thread for thread in threading.enumerate() if thread.name.startswith("files")}
    assert len(before - others) == 1
    assert worker.submit(threading.current_thread).result() in before - others
    worker.shutdown()
