"""Episodes of given trials, run by TorchRL collectors in this process, in worker processes or on Ray.

Every worker is a TorchRL collector of its own, so that one that dies takes nothing along but the trial that it ran.
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
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
from fb3d_rl.env.options import Trial
from fb3d_rl.errors import UserError
from fb3d_rl.rollout.options import CollectorOptions

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Episode:
    """A trial that was run.

    Attributes:
        index: the trial's place in the list.
        frames: TensorDict [T], one frame per control step; None if the trial crashed.
        error: what it crashed with.
    """

    index: int
    frames: TensorDictBase | None = None
    error: str = ""


class EpisodeCollector(Collector):
    """A TorchRL collector that is asked for one episode at a time, of a :class:`~fb3d_rl.env.torchrl_env.TrialEnv`."""

    _final_rollout = None  # TorchRL 0.14.1 looks at it when a rollout ends early, though it makes none without buffers

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.interruptor = _EpisodeEnd(self.env)

    def __repr__(self) -> str:
        return "worker"  # Ray puts it before each line that a worker prints

    def episode(self, trial: Trial, keys: Sequence[Key] | None) -> TensorDictBase | str:
        """Frames [T] of the trial, those ``keys`` alone if given, or what it crashed with."""
        self.env.set_trials([trial])
        try:
            with steady_floats():
                frames = self.rollout()[0].exclude("collector")  # TorchRL's count of trajectories: of this worker alone
        except (Exception, SystemExit) as error:  # a policy's library may want to end the process
            log.exception("object %s, link %d, seed %d: the trial crashed", trial.object, trial.link, trial.seed)
            return f"{type(error).__name__}: {error}"
        return frames if keys is None else frames.select(*keys)


class _EpisodeEnd:
    """Ends a collector's batch with the episode; TorchRL's interface for it is ``collection_stopped``."""

    def __init__(self, env: EnvBase) -> None:
        self._env = env

    def collection_stopped(self) -> bool:
        return bool(self._env.idle)


@contextmanager
def steady_floats() -> Iterator[None]:
    """Compute as every worker does: on one thread, and with denormal numbers taken as 0, which is also faster.

    The number of threads decides how sums are split, hence the last bits of a network's output.
    """
    threads, tiny = torch.get_num_threads(), torch.tensor(torch.finfo(torch.float32).tiny)
    flush = bool(tiny / 2 == 0)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(flush)
        torch.set_num_threads(threads)


class Workers:
    """Environment and policy in one or several workers, which take trials from one list, each the next one.

    Which worker runs a trial does not change its frames: a policy sees one environment at a time, on one thread. A
    trial that raises an exception costs itself only. So does one whose worker dies, of a crash of the simulator's
    library or of a signal: the worker is started again and goes on with the next trial. Trials for which there is no
    worker, since none can be started, have that as their error.

    To be used in a ``with`` statement, since workers stay, for further calls of :meth:`run`, until :meth:`close`. As
    always with processes that Python spawns, a script may use them below ``if __name__ == "__main__":`` only.

    Args:
        create_env_fn: makes a :class:`~fb3d_rl.env.torchrl_env.TrialEnv` of one scene, possibly transformed.
        policy: the policy, on the CPU. Like ``create_env_fn`` it has to be picklable unless the backend is "direct".
        options: where and how often.
        horizon: an episode has at most this many steps.
        exploration_type: what TorchRL's probabilistic policies do.

    Raises:
        UserError: Ray is asked for and not installed.
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
            frames_per_batch=horizon, reset_at_each_iter=True, exploration_type=exploration_type, trust_policy=True,
        )  # fmt: skip
        self._workers = [_Worker(self._new_collector) for _ in range(1 if self._direct else options.workers)]
        self._restarts, self._lock, self._stopping = options.restarts, threading.Lock(), False
        self._not_run = "not run: every worker died, and collector.restarts is used up"
        self._threads, self._others = torch.get_num_threads(), set(multiprocessing.active_children())
        self._owns_ray = options.backend == "ray" and _start_ray()
        self._folder = tempfile.TemporaryDirectory(prefix="fb3d_rl-") if options.backend == "process" else None
        if not self._direct:
            self._packed_env, self._packed_policy = self._packed("env", create_env_fn), self._packed("policy", policy)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def run(self, trials: Sequence[Trial], keys: Sequence[Key] | None = None) -> Iterator[Episode]:
        """Run every trial once; yield each as it ends. Leaving the loop early ends the workers.

        Args:
            trials: the trials.
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

            gc.collect()  # the finalizer of a collector that never came to be would start Ray anew
            ray.shutdown()
        if self._folder is not None:
            self._folder.cleanup()

    def _serve(
        self, worker: _Worker, trials: Sequence[Trial], keys: Sequence[Key] | None, jobs: _Jobs, results: _Results
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
                trial = trials[index]
                try:
                    results.put(_episode(index, worker.call("episode", trial, keys)))
                except _WorkerDied as death:
                    if self._stopping:
                        return
                    log.error("object %s, link %d, seed %d: %s", trial.object, trial.link, trial.seed, death)
                    results.put(Episode(index, error=str(death)))
        except BaseException as error:  # noqa: BLE001, the main thread raises it
            results.put(error)
        finally:
            results.put(None)

    def _started(self, worker: _Worker) -> bool:
        """Start a worker, unless it is; whether that went well. What did not is not the end of the run.

        Raises:
            UserError: what keeps it from starting for the first time can be mended.
        """
        try:
            worker.start()
        except Exception as error:
            if isinstance(error, UserError) and not worker.starts:
                raise
            if not self._stopping:  # by which processes end that are just being started
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

        It is a file where that can be, since a process takes what it is started with through a pipe, and Python waits
        for ever for one that dies before it has read its megabytes of meshes.
        """
        content = pickle.dumps(value)
        if self._folder is None:
            return content
        path = Path(self._folder.name) / name
        path.write_bytes(content)
        return path

    def _new_collector(self) -> BaseCollector:
        """The one place that makes TorchRL's collectors: an :class:`EpisodeCollector`, here or elsewhere."""
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
            return Collector(create, collector_kwargs=local, **remote)
        return Collector(create, num_threads=self._threads, **local, **remote)


def _unpacked(content: Path | bytes) -> Any:
    return pickle.loads(content if isinstance(content, bytes) else content.read_bytes())


def _unpacked_env(content: Path | bytes) -> EnvBase:
    env: EnvBase = _unpacked(content)()
    return env


def _idle_env(create_env_fn: Callable[[], EnvBase]) -> EnvBase:
    """The environment, in which no trial starts: TorchRL's collectors reset theirs before they are asked for any."""
    env = create_env_fn()
    env.set_trials([])
    return env


_Jobs: TypeAlias = "queue.SimpleQueue[int]"
_Results: TypeAlias = "queue.SimpleQueue[Episode | BaseException | None]"


def _episode(index: int, outcome: TensorDictBase | str) -> Episode:
    return Episode(index, error=outcome) if isinstance(outcome, str) else Episode(index, outcome)


class _WorkerDied(Exception):
    """Says how."""


class _Worker:
    """An :class:`EpisodeCollector`, here or elsewhere, once it is started.

    Args:
        new: makes the TorchRL collector.
    """

    def __init__(self, new: Callable[[], BaseCollector]) -> None:
        self.starts = 0
        self._new = new
        self._collector: BaseCollector | None = None

    def start(self) -> None:
        """Start it, unless it is."""
        if self._collector is None:
            self._collector = self._new()
            self.starts += 1

    def alive(self) -> bool:
        """Whether it was started and answers."""
        try:
            self.call("stats")
        except _WorkerDied:
            return False
        return True

    def call(self, method: str, *args: Any) -> Any:
        """Result of a method of the :class:`EpisodeCollector`.

        Raises:
            _WorkerDied: it is not started, or its process ended meanwhile.
        """
        collector = self._collector
        if collector is None:
            raise _WorkerDied("not started")
        if isinstance(collector, EpisodeCollector):
            return getattr(collector, method)(*args)
        try:
            return collector.map_fn(method, [args])[0]
        except Exception as error:
            how = _death(collector, error)
            if how is None:
                raise
            self._collector = None
            if not hasattr(collector, "procs"):
                # Ray's: its finalizer would otherwise start Ray anew after Workers.close, and end this process when
                # that has been gone for a minute.
                collector.shutdown()
            raise _WorkerDied(how) from error

    def close(self) -> None:
        """End it."""
        if self._collector is not None:
            for process in getattr(self._collector, "procs", ()):
                process.terminate()  # it keeps nothing, and to ask it to end takes seconds
            self._collector.shutdown()
        self._collector, self.starts = None, 0


def _death(collector: BaseCollector, error: Exception) -> str | None:
    """How the worker died that a call with this ``error`` was for; None if it lives."""
    processes = getattr(collector, "procs", None)
    if processes is None:
        from ray.exceptions import RayActorError

        return f"its Ray worker died ({type(error).__name__})" if isinstance(error, RayActorError) else None
    processes[0].join(1.0)
    code = processes[0].exitcode
    if code is None:
        return None
    if code < 0:
        return f"its worker process died of signal {-code} ({signal.strsignal(-code)})"
    return f"its worker process ended with exit code {code}"


def _start_ray() -> bool:
    """Start Ray or join the cluster that RAY_ADDRESS names; whether this was still to be done."""
    try:
        import ray
    except ImportError as error:
        raise UserError(
            'collector=ray needs Ray, which is not installed; install it: pip install "ray>=2.60"'
        ) from error
    if ray.is_initialized():
        return False
    ray.init(logging_level=logging.WARNING)
    # TorchRL says so of the policy factory; Workers.update_policy_weights_ does update.
    warnings.filterwarnings("ignore", message="The policy is not an nn.Module")
    return True
