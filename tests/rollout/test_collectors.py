"""Workers: the same frames wherever a trial runs, weights that arrive, and no trial lost, whatever dies."""

from __future__ import annotations

import ast
import dataclasses
import gc
import inspect
import logging
import multiprocessing
import os
import re
import signal
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Literal

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions, Trial, default_trial
from fb3d_rl.env.torchrl_env import TrialEnv, make_env
from fb3d_rl.errors import UserError
from fb3d_rl.rollout import collectors, worker
from fb3d_rl.rollout.collectors import CollectorOptions, Episode, Workers
from fb3d_rl.rollout.worker import steady_floats

HORIZON = 6
OPTIONS = EnvOptions(points=64, horizon=HORIZON)


class Policy(TensorDictModuleBase):
    """Its weight is the action, the cloud's mean a hint of it; at a weight above 0.5 a drawer is the end of it."""

    def __init__(self, end: str) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [("observation", "points"), ("privileged", "joint_prismatic")], ["action"]
        self.weight = torch.nn.Parameter(torch.zeros(8))
        self.end = end

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        if self.weight[0] > 0.5 and bool(td["privileged", "joint_prismatic"]) and td["elapsed_steps"].item() == 3:
            if self.end == "exception":
                raise RuntimeError("the drawer fell out")
            os.kill(os.getpid(), signal.SIGKILL)
        td["action"] = (self.weight + 1e-3 * td["observation", "points"].mean()).expand(1, 8).clone()
        return td

    def set_weight(self, value: float) -> None:
        with torch.no_grad():
            self.weight.fill_(value)


@pytest.fixture(scope="module")
def create(objects: dict[str, ArticulatedObject]) -> partial[TrialEnv]:
    return partial(make_env, [objects["Table"], objects["Laptop"]], OPTIONS)


@pytest.fixture(scope="module")
def trials(objects: dict[str, ArticulatedObject]) -> list[Trial]:
    """Three of a lid with one of a drawer between them."""
    lid, drawer = default_trial(objects["Laptop"]), default_trial(objects["Table"])
    return [dataclasses.replace(trial, seed=seed) for seed, trial in enumerate((lid, drawer, lid, lid))]


def run(workers: Workers, trials: list[Trial]) -> list[Episode]:
    episodes = sorted(workers.run(trials), key=lambda episode: episode.index)
    assert [episode.index for episode in episodes] == list(range(len(trials)))
    return episodes


def frames(episode: Episode) -> TensorDictBase:
    assert episode.frames is not None, episode.error
    return episode.frames


def same(first: Episode, second: Episode) -> bool:
    return bool((frames(first) == frames(second)).all())


@pytest.fixture(scope="module")
def expected(create: partial[TrialEnv], trials: list[Trial]) -> dict[float, list[Episode]]:
    """The episodes in this process, by weight."""
    policy, found = Policy("exception"), {}
    with Workers(create, policy, CollectorOptions("direct"), HORIZON) as workers:
        for weight in (0.0, 0.25, 0.75):
            policy.set_weight(weight)
            workers.update_policy_weights_()
            found[weight] = run(workers, trials)
    return found


def test_an_episode_is_the_trial_from_its_start_to_its_end(
    expected: dict[float, list[Episode]], trials: list[Trial]
) -> None:
    for episode, trial in zip(expected[0.0], trials, strict=True):
        td = frames(episode)
        assert td.batch_size == (HORIZON,)
        assert td["elapsed_steps"].flatten().tolist() == list(range(HORIZON))
        assert td["next", "done"].flatten().tolist() == [False] * (HORIZON - 1) + [True]
        assert bool(td["privileged", "joint_prismatic"].any()) == ("Table" in trial.object)
    clouds = [frames(episode)["observation", "points"] for episode in expected[0.0]]
    assert not torch.equal(clouds[0], clouds[2]), "another seed draws other points"


def test_the_policys_weights_decide_the_action(expected: dict[float, list[Episode]]) -> None:
    for weight in (0.0, 0.25):
        for episode in expected[weight]:
            assert (frames(episode)["action"] - weight).abs().max() < 0.01


def test_an_exception_costs_its_own_trial_only(expected: dict[float, list[Episode]]) -> None:
    assert [episode.error for episode in expected[0.75]] == ["", "RuntimeError: the drawer fell out", "", ""]
    assert all(frames(expected[0.75][k])["action"].min() > 0.7 for k in (0, 2, 3))


def test_keys_choose_what_is_kept(create: partial[TrialEnv], trials: list[Trial]) -> None:
    with Workers(create, Policy("exception"), CollectorOptions(), HORIZON) as workers:
        (episode,) = workers.run(trials[:1], [("next", "success"), "action"])
    assert set(frames(episode).keys(include_nested=True, leaves_only=True)) == {("next", "success"), "action"}


def check(
    backend: str, restarts: int, create: partial[TrialEnv], trials: list[Trial], expected: dict[float, list[Episode]]
) -> str:
    """Run the scenario of ``expected`` in two workers, where the drawer kills its worker; return the error."""
    policy = Policy("kill")
    with Workers(create, policy, CollectorOptions(backend, 2, restarts), HORIZON) as workers:  # type: ignore[arg-type]
        for weight in (0.0, 0.25):
            policy.set_weight(weight)
            workers.update_policy_weights_()
            for episode, same_trial in zip(run(workers, trials), expected[weight], strict=True):
                assert same(episode, same_trial)
        policy.set_weight(0.75)
        workers.update_policy_weights_()
        drawers_first = [trials[k] for k in (1, 1, 0, 2, 3)]
        episodes = run(workers, drawers_first)
        errors = [episode.error for episode in episodes]
        assert all(errors[:2]) and not any(errors[2:])
        # Both workers died, so the frames are of workers that were started again, with the present weights.
        assert all(same(episodes[2 + k], expected[0.75][j]) for k, j in enumerate((0, 2, 3)))
        # No restart is left: with as many deaths again there is no worker for the rest, which is said.
        lost = run(workers, drawers_first)
        assert all("died" in episode.error for episode in lost[:restarts])
        assert [episode.error.split(":")[0] for episode in lost[restarts:]] == ["not run"] * (5 - restarts)
    return errors[0]


@pytest.mark.usefixtures("two_threads")
def test_worker_processes(
    create: partial[TrialEnv],
    trials: list[Trial],
    expected: dict[float, list[Episode]],
    caplog: pytest.LogCaptureFixture,
) -> None:
    before = multiprocessing.active_children()
    with caplog.at_level(logging.ERROR, logger="fb3d_rl"):
        error = check("process", 1, create, trials, expected)
    assert error == "its worker process died of signal 9 (Killed)"
    assert f"object {trials[1].object}, link {trials[1].link}, seed {trials[1].seed}: {error}" in caplog.text
    assert multiprocessing.active_children() == before and torch.get_num_threads() == 2


@pytest.mark.slow
def test_ray(create: partial[TrialEnv], trials: list[Trial], expected: dict[float, list[Episode]]) -> None:
    ray = pytest.importorskip("ray", reason="Ray is not installed; install it to run this test")
    assert "its Ray worker died" in check("ray", 2, create, trials, expected)
    gc.collect()  # the finalizer of a collector that still has actors starts Ray anew
    assert not ray.is_initialized()


@pytest.mark.slow
def test_ray_on_two_nodes_of_which_one_dies(
    create: partial[TrialEnv],
    trials: list[Trial],
    expected: dict[float, list[Episode]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("ray", reason="Ray is not installed; install it to run this test")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    policy = Policy("exception")
    try:
        with Workers(create, policy, CollectorOptions("ray", 2, 2), HORIZON) as workers:
            policy.set_weight(0.25)
            workers.update_policy_weights_()
            for episode, same_trial in zip(run(workers, trials), expected[0.25], strict=True):
                assert same(episode, same_trial)
            nodes = {
                Path(f"/proc/{worker.call('process_id')}/stat").read_text().split()[3] for worker in workers._workers
            }
            assert len(nodes) == 2, "each worker is the child of another node's process"
            cluster.remove_node(second)
            episodes = run(workers, trials * 3)
            assert sum(bool(episode.error) for episode in episodes) <= 1, "the trial that ran there"
            assert all(same(one, expected[0.25][one.index % 4]) for one in episodes if not one.error)
    finally:
        cluster.shutdown()


def test_ray_is_asked_for_where_it_is_missing(create: partial[TrialEnv], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(UserError, match="pip install"):
        Workers(create, Policy("kill"), CollectorOptions("ray"), HORIZON)


@pytest.mark.parametrize("module", [collectors, worker])
def test_only_public_names_of_torchrl_are_used(module: ModuleType) -> None:
    """Names that start with "_" are those of this package's own classes, which are no subclasses of TorchRL's."""
    private = []
    for scope in ast.parse(inspect.getsource(module)).body:
        own = isinstance(scope, ast.ClassDef) and not scope.bases
        for node in ast.walk(scope):
            if isinstance(node, ast.Attribute) and re.match("_(?!_)", node.attr):
                if not (own and isinstance(node.value, ast.Name) and node.value.id == "self"):
                    private.append(f"line {node.lineno}: .{node.attr}")
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("torchrl", "tensordict")):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                private += [f"line {node.lineno}: {name}" for name in names if "._" in name]
    assert not private, f"{module.__name__} uses names that another TorchRL may not have: {private}"


@pytest.mark.slow
def test_leaving_early_ends_the_workers(create: partial[TrialEnv], trials: list[Trial]) -> None:
    before = multiprocessing.active_children()
    with Workers(create, Policy("kill"), CollectorOptions("process", 2), HORIZON) as workers:
        for _ in workers.run(trials * 20):
            break
        assert multiprocessing.active_children() == before


def refuse() -> TrialEnv:
    raise UserError("there is nothing to open")


@pytest.mark.slow
def test_what_keeps_workers_from_starting_is_raised(trials: list[Trial]) -> None:
    before = multiprocessing.active_children()
    with (
        Workers(refuse, Policy("kill"), CollectorOptions("process", 2), HORIZON) as workers,
        pytest.raises(UserError, match="nothing to open"),
    ):
        run(workers, trials)
    assert multiprocessing.active_children() == before


def fall_over() -> TrialEnv:
    raise RuntimeError("no such device")


@pytest.mark.parametrize("backend", ["direct", pytest.param("process", marks=pytest.mark.slow)])
def test_trials_that_no_worker_can_run_say_why(backend: Literal["direct", "process"], trials: list[Trial]) -> None:
    with Workers(fall_over, Policy("exception"), CollectorOptions(backend, 2), HORIZON) as workers:
        episodes = run(workers, trials)
    assert all("not run" in episode.error and "no such device" in episode.error for episode in episodes)


@pytest.mark.usefixtures("two_threads")
def test_an_episode_is_computed_on_one_thread_without_denormals() -> None:
    tiny = torch.tensor(torch.finfo(torch.float32).tiny)
    for denormals in (True, False):
        torch.set_flush_denormal(not denormals)
        with steady_floats():
            assert torch.get_num_threads() == 1 and tiny / 2 == 0
        assert torch.get_num_threads() == 2 and (tiny / 2 > 0) == denormals
    torch.set_flush_denormal(False)
