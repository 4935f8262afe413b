"""Work on many images in several processes.

Workers are spawned, not forked: a forked one would inherit the lock of the run folder and outlive a killed run.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from robcal.errors import InvalidInput

A = TypeVar("A")
B = TypeVar("B")

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def begin_worker(parent: int) -> None:
    """One thread each, and no life after the parent's: a run killed with -9 leaves no worker behind."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    import cv2

    cv2.setNumThreads(1)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def in_processes(work: Callable[[A], B], items: Sequence[A], workers: int) -> Iterator[B]:
    """``work(item)`` of all items in their order; in this process when there is one worker or little to do.

    Raises
    ------
    InvalidInput : a worker died (for lack of memory); whatever ``work`` raises.
    """
    if workers <= 1 or len(items) < 2 * workers:
        for item in items:
            yield work(item)
        return
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read when a worker loads numpy
    try:
        with ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), initializer=begin_worker, initargs=(os.getpid(),)
        ) as pool:
            try:
                yield from pool.map(work, items)
            except BrokenProcessPool:
                remedy = "probably for lack of memory: run again with --workers 1"
                raise InvalidInput(f"a worker process died, {remedy}") from None
            except KeyboardInterrupt:
                for child in multiprocessing.active_children():
                    child.terminate()  # at once, not after the image that it is at
                raise
            finally:
                pool.shutdown(cancel_futures=True)
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
