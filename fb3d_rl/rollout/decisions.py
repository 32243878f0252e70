"""Measure and limit the time that a policy takes for a decision."""

from __future__ import annotations

import faulthandler
import multiprocessing
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

DECISION = "decision_seconds"
"""Where :class:`TimedPolicy` writes how long it took: [E, 1] float32, s of wall time, so it differs between runs."""

GRACE = 10.0
"""Seconds after the limit at which a worker process that does not return to Python is ended."""


class TookTooLong(Exception):
    """A decision took longer than it may."""


class TimedPolicy(TensorDictModuleBase):
    """A policy whose decisions are timed.

    A decision that takes longer than the limit ends in :class:`TookTooLong`. One that hangs in a library, where no
    exception can be raised, ends its worker process; with collector=direct there is no such process, and it hangs on.

    Args:
        policy: the policy.
        limit: seconds; None for no limit.
    """

    def __init__(self, policy: TensorDictModuleBase, limit: float | None = None) -> None:
        super().__init__()
        self.policy, self.limit = policy, limit
        self.in_keys, self.out_keys = policy.in_keys, [*policy.out_keys, DECISION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Let the policy decide."""
        started = time.perf_counter()
        with _limited(self.limit):
            decided: TensorDictBase = self.policy(tensordict)
        seconds = time.perf_counter() - started
        decided[DECISION] = torch.full((*decided.batch_size, 1), seconds, device=decided.device)
        return decided


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """End what runs in this context after ``seconds``."""
    alarm = threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")
    if seconds is None or not alarm:
        yield
        return

    def late(number: int, frame: FrameType | None) -> None:
        raise TookTooLong(f"a decision of the policy took more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    worker = multiprocessing.parent_process() is not None
    if worker:
        faulthandler.dump_traceback_later(seconds + GRACE, exit=True)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        if worker:
            faulthandler.cancel_dump_traceback_later()
