"""Episodes of given trials, run by TorchRL collectors in this process, in worker processes or on Ray.

Every worker is a TorchRL collector of its own, so that one that dies loses nothing but the trial that it ran.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import multiprocessing.resource_tracker
import pickle
import queue
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from fb3d_rl.contract import Key
from fb3d_rl.errors import UserError
from fb3d_rl.rollout.options import CollectorOptions
from fb3d_rl.rollout.worker import EpisodeCollector, NoRoom, Worker, WorkerDied, start_ray

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Episode:
    """A trial that was run.

    Attributes:
        index: the trial's place in the list.
        frames: TensorDict [T], one frame per control step; None if the trial crashed.
        error: the exception or death that ended it; "" if it did not crash.
    """

    index: int
    frames: TensorDictBase | None = None
    error: str = ""


class Workers:
    """Environment and policy in one or several workers, which take trials from one list in turn.

    Which worker runs a trial does not change its frames: a policy sees one environment at a time, on one thread. A
    trial that raises an exception is lost alone. So is one whose worker dies, of a crash of the simulator's library or
    of a signal: the worker is started again and goes on with the next trial. Trials that no worker could run, since
    none could be started, have that as their error.

    Use them in a ``with`` statement: workers stay alive for further calls of :meth:`run` until :meth:`close`. As always
    with processes that Python spawns, a script may start them below ``if __name__ == "__main__":`` only.

    Args:
        create_env_fn: makes an environment of one scene with a method ``set_trials``: each further reset starts the
            next of the trials that it is given, and none once they have run out.
        policy: the policy, on the CPU. Like ``create_env_fn`` it has to be picklable unless the backend is "direct".
        options: where they run, and how many.
        horizon: an episode has at most this many steps.
        exploration_type: what TorchRL's probabilistic policies do.

    Raises:
        UserError: the backend is Ray, which is not installed.
    """

    def __init__(
        self,
        create_env_fn: Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        options: CollectorOptions,
        horizon: int,
        exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    ) -> None:
        self._create_env_fn, self._policy, self._options = create_env_fn, policy, options
        self._rollout = dict(
            frames_per_batch=horizon, exploration_type=exploration_type, trust_policy=True,
        )  # fmt: skip
        self._workers = [
            Worker(self._new_collector, options.backend) for _ in range(1 if self._direct else options.workers)
        ]
        self._restarts, self._lock, self._stopping = options.restarts, threading.Lock(), False
        self._not_run = "not run: every worker died, and collector.restarts is used up"
        self._threads, self._others = torch.get_num_threads(), set(multiprocessing.active_children())
        self._owns_ray = options.backend == "ray" and start_ray()
        self._folder = tempfile.TemporaryDirectory(prefix="fb3d_rl-") if options.backend == "process" else None
        if not self._direct:
            self._packed_env, self._packed_policy = self._packed("env", create_env_fn), self._packed("policy", policy)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def run(self, trials: Sequence[object], keys: Sequence[Key] | None = None) -> Iterator[Episode]:
        """Run every trial once; yield each as it ends. Leaving the loop early ends the workers.

        Args:
            trials: the trials, as the environment's ``set_trials`` takes them; str() of one names it in the log.
            keys: which entries of the frames, such as ("next", "reward"); all unless given. Frames come through shared
                memory from another process, so fewer are cheaper.
        """
        if self._direct:
            started = self._started(self._workers[0])
            for index, trial in enumerate(trials):
                outcome = self._workers[0].call("episode", trial, keys) if started else self._not_run
                yield _episode(index, outcome)
            return
        jobs: _Jobs = queue.SimpleQueue()
        for index in range(len(trials)):
            jobs.put(index)
        results: _Results = queue.SimpleQueue()
        threads = [
            threading.Thread(target=self._serve, args=(worker, trials, keys, jobs, results), daemon=True)
            for worker in self._workers[: len(trials)]
        ]
        # Its first use, in a thread that starts a process, would unblock Ctrl-C there.
        multiprocessing.resource_tracker.ensure_running()
        self._stopping, working = False, len(threads)
        try:
            for thread in threads:
                thread.start()
            while working:
                result = results.get()
                if isinstance(result, BaseException):
                    raise result
                if result is None:
                    working -= 1
                else:
                    yield result
            while not jobs.empty():
                yield Episode(jobs.get(), error=self._not_run)
        finally:
            while working and any(thread.is_alive() for thread in threads):
                self._stop()  # more than once: a process may just be about to start
                time.sleep(0.05)
            for thread in threads:
                thread.join()
            if working:
                self._stop()

    def update_policy_weights_(self) -> None:
        """Give the workers the policy's present weights."""
        if not self._direct:
            self._packed_policy = self._packed("policy", self._policy)
        weights = TensorDict.from_module(self._policy).data.clone()
        for worker in self._workers:
            if worker.alive():  # one that starts later has them anyway
                worker.call("update_policy_weights_", weights)

    def close(self) -> None:
        """End the workers for good."""
        for worker in self._workers:
            worker.close()
        torch.set_num_threads(self._threads)  # TorchRL changes it on behalf of its workers
        if self._owns_ray:
            import ray

            gc.collect()  # the finalizer of a collector whose start failed would start Ray again
            ray.shutdown()
        if self._folder is not None:
            self._folder.cleanup()

    def _serve(
        self, worker: Worker, trials: Sequence[object], keys: Sequence[Key] | None, jobs: _Jobs, results: _Results
    ) -> None:
        """Let one worker take jobs until there are none; runs in a thread of its own."""
        # Ctrl-C reaches every process of the group: only the main thread handles it, and processes that are started
        # from here inherit that it is blocked.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            while not (jobs.empty() or self._stopping):
                if not worker.alive():
                    again = worker.starts > 0
                    if again and not self._may_restart():
                        return
                    if not self._started(worker):
                        if again:  # the next attempt counts as a restart too
                            continue
                        return
                try:
                    index = jobs.get_nowait()
                except queue.Empty:
                    return
                try:
                    results.put(_episode(index, worker.call("episode", trials[index], keys)))
                except WorkerDied as death:
                    if self._stopping:
                        return
                    log.error("%s: %s", trials[index], death)
                    results.put(Episode(index, error=str(death)))
        except BaseException as error:  # noqa: BLE001, the main thread raises it
            results.put(error)
        finally:
            results.put(None)

    def _started(self, worker: Worker) -> bool:
        """Start a worker unless it is running; returns whether it runs. A failure does not end the run.

        Raises:
            UserError: it fails to start for the first time, for a reason that the user can change.
        """
        try:
            worker.start()
        except Exception as error:
            if isinstance(error, UserError) and not worker.starts:
                raise
            if isinstance(error, NoRoom):
                log.warning("a worker less: %s", error)
            elif not self._stopping:  # which ends processes while they are being started
                log.exception("a worker could not be started")
            self._not_run = f"not run: a worker could not be started ({type(error).__name__}: {error})"
            return False
        return True

    def _may_restart(self) -> bool:
        with self._lock:
            self._restarts -= 1
            return self._restarts >= 0

    def _stop(self) -> None:
        """End the workers in the middle of their trials, also those that are just being started."""
        self._stopping = True
        for child in set(multiprocessing.active_children()) - self._others:
            child.kill()
        if self._options.backend == "ray":
            for worker in self._workers:
                worker.close()

    @property
    def _direct(self) -> bool:
        return self._options.backend == "direct"

    def _packed(self, name: str, value: object) -> Path | bytes:
        """``value`` for the workers, pickled once for all of them.

        For processes it is written to a file: arguments of a new process go through a pipe, and Python waits for ever
        for a process that dies before it has read its megabytes of meshes.
        """
        content = pickle.dumps(value)
        if self._folder is None:
            return content
        path = Path(self._folder.name) / name
        path.write_bytes(content)
        return path

    def _new_collector(self, ray_options: dict[str, Any] | None = None) -> BaseCollector:
        """The one place that makes TorchRL's collectors: an :class:`EpisodeCollector`, here or elsewhere.

        Args:
            ray_options: of its actor, if the backend is Ray.
        """
        local = dict(use_buffers=False, auto_register_policy_transforms=False)
        if self._direct:
            return EpisodeCollector(partial(_idle_env, self._create_env_fn), self._policy, **local, **self._rollout)
        remote = dict(
            backend=self._options.backend,
            sync=True,
            collector_class=EpisodeCollector,
            # With a factory TorchRL starts no threads that copy weights: update_policy_weights_ does, between episodes.
            policy_factory=partial(_unpacked, self._packed_policy),
            weight_sync_schemes={},
            **self._rollout,
        )
        create = [partial(_idle_env, partial(_unpacked_env, self._packed_env))]
        if self._options.backend == "ray":
            return Collector(create, collector_kwargs=local, remote_configs=ray_options, **remote)
        return Collector(create, num_threads=self._threads, **local, **remote)


def _unpacked(content: Path | bytes) -> Any:
    return pickle.loads(content if isinstance(content, bytes) else content.read_bytes())


def _unpacked_env(content: Path | bytes) -> EnvBase:
    env: EnvBase = _unpacked(content)()
    return env


def _idle_env(create_env_fn: Callable[[], EnvBase]) -> EnvBase:
    """The environment without trials: TorchRL's collectors reset theirs when they are made, before the first trial."""
    env = create_env_fn()
    env.set_trials([])
    return env


_Jobs: TypeAlias = "queue.SimpleQueue[int]"
_Results: TypeAlias = "queue.SimpleQueue[Episode | BaseException | None]"


def _episode(index: int, outcome: TensorDictBase | str) -> Episode:
    return Episode(index, error=outcome) if isinstance(outcome, str) else Episode(index, outcome)
