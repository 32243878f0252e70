"""One worker: a TorchRL collector that runs one trial at a time, in this process, in another one or on Ray."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs.utils import set_exploration_type

from fb3d_rl.contract import Key
from fb3d_rl.errors import UserError

log = logging.getLogger(__name__)


@contextmanager
def steady_floats() -> Iterator[None]:
    """Compute as every worker does: on one thread, and with denormal numbers rounded to 0, which is also faster.

    The number of threads decides how sums are split, and so the last bits of a network's output.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with denormals(flushed=True):
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def denormals(flushed: bool) -> Iterator[None]:
    """Round denormal numbers to 0, or do not: SciPy's trees have crashed where they are (1.17.1)."""
    flush = bool(torch.tensor(torch.finfo(torch.float32).tiny) / 2 == 0)
    torch.set_flush_denormal(flushed)
    try:
        yield
    finally:
        torch.set_flush_denormal(flush)


class EpisodeCollector(Collector):
    """A TorchRL collector that runs one episode per call.

    Its environment has one scene and a method ``set_trials``, which takes the trials that the next resets start.
    """

    def __repr__(self) -> str:
        return "worker"  # Ray puts it before each line that a worker prints

    def process_id(self) -> int:
        """Number of the process that this collector lives in."""
        return os.getpid()

    def episode(self, trial: object, keys: Sequence[Key] | None) -> TensorDictBase | str:
        """Frames [T] of the trial, those of ``keys`` that there are alone if given, or the error that ended it."""
        self.env.set_trials([trial])
        try:
            with steady_floats(), set_exploration_type(self.exploration_type), torch.no_grad():
                # Not Collector.rollout: it runs a whole batch of steps, also after the episode has ended.
                frames = self.env.rollout(
                    self.frames_per_batch, self.policy, break_when_any_done=True, trust_policy=self.trust_policy
                )[0]
        except (Exception, SystemExit) as error:  # a policy's library may want to end the process
            log.exception("%s: the trial crashed", trial)
            return f"{type(error).__name__}: {error}"
        return frames if keys is None else frames.select(*keys, strict=False)


ROOM_AFTER = 30
"""Seconds for which a worker waits for room in a Ray cluster; a dead worker's is free after some of them."""


class NoRoom(Exception):
    """There is no room for another worker; the message says how much it needs."""


class WorkerDied(Exception):
    """A worker does not run (any more); the message says why."""


class Worker:
    """A worker, which can be started again after it has died.

    Args:
        new: makes an :class:`EpisodeCollector`, or the TorchRL collector that has one in another process; on Ray it is
            given the options of the actor, else nothing.
        backend: where that is: "direct", "process" or "ray".

    Attributes:
        starts: how often it was started since it was made or closed.
    """

    def __init__(self, new: Callable[..., BaseCollector], backend: str) -> None:
        self.starts = 0
        self._new, self._backend = new, backend
        self._collector: BaseCollector | None = None
        self._process: BaseProcess | None = None  # of the backend "process" alone
        self._place: Any = None  # Ray's placement group

    def start(self) -> None:
        """Start it, unless it is running.

        Raises:
            NoRoom: no node of the Ray cluster has a CPU for it.
        """
        if self._collector is not None:
            return
        collector = self._new() if self._backend != "ray" else self._new(self._ray_options())
        if self._backend == "process":
            [number] = collector.map_fn("process_id", [()])
            self._process = next(child for child in multiprocessing.active_children() if child.pid == number)
        self._collector = collector
        self.starts += 1

    def alive(self) -> bool:
        """Whether it was started and answers."""
        try:
            self.call("process_id")
        except WorkerDied:
            return False
        return True

    def call(self, method: str, *args: Any) -> Any:
        """Result of a method of the :class:`EpisodeCollector`.

        Raises:
            WorkerDied: it is not started, or its process ended meanwhile.
        """
        collector = self._collector
        if collector is None:
            raise WorkerDied("not started")
        if isinstance(collector, EpisodeCollector):
            return getattr(collector, method)(*args)
        try:
            return collector.map_fn(method, [args])[0]
        except Exception as error:
            cause = self._cause_of_death(error)
            if cause is None:
                raise
            self._collector = None
            if self._process is None:
                # Ray's: otherwise its finalizer would start Ray again after Workers.close, and end this process a
                # minute after Ray is gone.
                collector.shutdown()
                self._leave_place()
            raise WorkerDied(cause) from error

    def close(self) -> None:
        """End it."""
        if self._collector is not None:
            if self._process is not None:
                self._process.terminate()  # it has nothing to save, and an orderly end takes seconds
            self._collector.shutdown()
        self._collector, self._process, self.starts = None, None, 0
        self._leave_place()

    def _ray_options(self) -> dict[str, Any]:
        """Options of a Ray actor that has a CPU and memory reserved for it on some node of the cluster.

        An actor for which there is no room would wait for ever, for instance after its node has gone.
        """
        import ray
        from ray.util.placement_group import placement_group
        from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy
        from torchrl.collectors.distributed.ray import DEFAULT_REMOTE_CLASS_CONFIG

        self._leave_place()
        needs = {"CPU": 1, "memory": DEFAULT_REMOTE_CLASS_CONFIG["memory"]}
        self._place = placement_group([needs])
        if not self._place.wait(ROOM_AFTER):
            self._leave_place()
            total = ray.cluster_resources()
            raise NoRoom(
                f"no node of the Ray cluster had a free CPU and {needs['memory'] / 2**30:.0f} GiB within "
                f"{ROOM_AFTER} s; the cluster has {total.get('CPU', 0):.0f} CPUs in all"
            )
        options = DEFAULT_REMOTE_CLASS_CONFIG | {"num_gpus": None}  # trials run on CPUs
        return options | {"scheduling_strategy": PlacementGroupSchedulingStrategy(self._place)}

    def _leave_place(self) -> None:
        if self._place is not None:
            from ray.util.placement_group import remove_placement_group

            remove_placement_group(self._place)
            self._place = None

    def _cause_of_death(self, error: Exception) -> str | None:
        """What the worker died of, after a call of it raised ``error``; None if it is alive."""
        if self._process is None:
            from ray.exceptions import RayActorError

            return f"its Ray worker died ({type(error).__name__})" if isinstance(error, RayActorError) else None
        self._process.join(1.0)
        code = self._process.exitcode
        if code is None:
            return None
        if code < 0:
            return f"its worker process died of signal {-code} ({signal.strsignal(-code)})"
        return f"its worker process ended with exit code {code}"


def start_ray() -> bool:
    """Start Ray or join the cluster that RAY_ADDRESS names; returns False if that was done before.

    Raises:
        UserError: Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError(
            'collector=ray needs Ray, which is not installed; install it: pip install "ray>=2.60"'
        ) from error
    if ray.is_initialized():
        return False
    ray.init(logging_level=logging.WARNING)
    # TorchRL warns that a policy factory's weights are not updated; Workers.update_policy_weights_ updates them.
    warnings.filterwarnings("ignore", message="The policy is not an nn.Module")
    return True
