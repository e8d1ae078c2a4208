"""Worker processes that end with their parent."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """End this worker as soon as its parent has ended, however that came about; for initializers of process pools.

    A worker of `concurrent.futures` waits for its next job for ever if its parent was killed: other workers keep the queue open
    (https://github.com/python/cpython/issues/111873).
    """
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=follow, daemon=True, name="end_with_parent").start()
