"""Processes that a command starts: Ctrl-C reaches only their parent, which ends them."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker


@contextmanager
def withheld() -> Iterator[None]:
    """Processes that start in this context never see Ctrl-C, which reaches the whole group: their parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # its first use would let Ctrl-C through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def worker_pool(workers: int, initializer: Callable[[], None] | None = None) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes, which an error or Ctrl-C ends at once. Submit in :func:`withheld`."""
    others = set(active_children())
    # Spawned: a forked process would inherit torch's threads in the middle of what they do.
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer) as pool:
        try:
            yield pool
        except BaseException:
            for child in set(active_children()) - others:
                child.terminate()
            pool.shutdown(cancel_futures=True)
            raise
