"""Trials through the collector: every scheduled trial ends in one row, whatever happens."""

from __future__ import annotations

import dataclasses
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.policies.arc import LOOKS
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.policies.flow_policy import FlowPolicyOptions, expert_policy
from fb3d_rl.rollout.collectors import CollectorOptions
from fb3d_rl.rollout.pulls import pulls_until_moved
from fb3d_rl.rollout.run import _outcome, limits_of, run_trials
from fb3d_rl.rollout.trials import Scheduled, schedule

CAMERA = CameraOptions(resolution=48)
OPTIONS = EnvOptions(points=300, camera=CAMERA, horizon=150)
LIMITS = limits_of(OPTIONS)


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[ArticulatedObject]:
    out: Path = tmp_path_factory.mktemp("objects")
    return [load_object(out / name) for name in procedural.generate(out, ["Microwave", "KitchenPot"], 2, 3)]


@pytest.fixture(scope="module")
def trials(objects: list[ArticulatedObject]) -> list[Scheduled]:
    found = schedule([(obj, "train_test") for obj in objects], SampleOptions(points=300, camera=CAMERA), seed=0)[0]
    assert len(found) >= 4
    return found


class Policy(TensorDictModuleBase):
    """Calls ``act`` with the number of its call."""

    def __init__(self, act: Callable[[int], torch.Tensor]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [("observation", "qpos")], ["action"]
        self.act, self.calls = act, 0

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        td["action"] = self.act(self.calls)[None]
        return td


class Still(Policy):
    """Stands still; can be pickled."""

    def __init__(self) -> None:
        super().__init__(_zeros)


def _zeros(call: int) -> torch.Tensor:
    return torch.zeros(8)


def test_the_expert_opens_and_repeats_bit_for_bit(objects: list[ArticulatedObject], trials: list[Scheduled]) -> None:
    rows = run_trials("expert", expert_policy(LIMITS), objects, trials, OPTIONS)
    assert [row.trial for row in rows] == list(range(len(trials)))
    assert [(row.object, row.link) for row in rows] == [(t.trial.object, t.link) for t in trials]
    assert sum(row.success for row in rows) >= len(rows) - 1
    for row in rows:
        assert row.status == "ok" and (row.failure == "") == row.success
        assert row.success == (row.normalized_distance < OPTIONS.success)
        assert 0 <= row.attach_step < row.steps <= OPTIONS.horizon
    again = run_trials("expert", expert_policy(LIMITS), objects, trials[::-1], OPTIONS)
    outcome = [(row.object, row.link, row.steps, row.normalized_distance, row.attach_step) for row in rows]
    assert [(r.object, r.link, r.steps, r.normalized_distance, r.attach_step) for r in again[::-1]] == outcome, (
        "a trial depends on neither its neighbours nor its place"
    )


@pytest.mark.parametrize("frequency", [10, 40])
def test_the_expert_opens_at_other_control_frequencies(
    frequency: int, objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    options = replace(OPTIONS, sim_freq=120, control_freq=frequency, horizon=15 * frequency // 2)
    rows = run_trials("expert", expert_policy(limits_of(options)), objects, trials[::2], options)
    assert all(row.success for row in rows)
    assert all(row.seconds < 7.0 for row in rows)


def test_without_a_mask_the_expert_still_opens_and_rows_say_what_was_held(
    objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    options = replace(OPTIONS, suction=replace(OPTIONS.suction, hold="any"))
    maskless = expert_policy(LIMITS, FlowPolicyOptions(mask="none"))
    rows = run_trials("expert", maskless, objects, trials, options)
    assert all(row.success and row.held_opened and row.mask == "none" for row in rows)
    rows = run_trials("expert", expert_policy(LIMITS), objects, trials[:1], OPTIONS)
    assert [(row.mask, row.held_opened) for row in rows] == [("target", rows[0].success)]


class Astray(TensorDictModuleBase):
    """The expert without a mask, whose flow is that of another part: the one the camera sees most of."""

    def __init__(self) -> None:
        super().__init__()
        self.expert = expert_policy(LIMITS, FlowPolicyOptions(mask="none"))
        self.in_keys, self.out_keys = [*self.expert.in_keys, ("privileged", "link")], self.expert.out_keys
        self.initial_state = self.expert.initial_state

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        link, true = td["privileged", "link"], td["privileged", "flow"]
        other = int(link[(link >= 0) & (true.norm(dim=-1) == 0) & self.drawer(td)].mode().values)
        along = true[true.norm(dim=-1) > 0][0]
        td["privileged", "flow"] = torch.where((link == other)[..., None], along, torch.zeros(3))
        return self.expert(td)

    def drawer(self, td: TensorDictBase) -> torch.Tensor:
        return torch.isin(td["privileged", "link"], self.drawers)

    drawers: torch.Tensor


def test_opening_another_part_is_no_success_but_what_was_held_was_opened(tmp_path: Path) -> None:
    """A cabinet with several drawers: the policy is led to another one than the target."""
    obj = load_object(tmp_path / procedural.generate(tmp_path, ["Table"], 1, 0)[0])
    drawers = [i for i in openable_links(obj) if obj.links[i].semantic == "drawer"]
    scheduled = [item for item in schedule([(obj, "")], SampleOptions(points=300, camera=CAMERA), seed=0)[0]
                 if item.trial.link == drawers[0]]  # fmt: skip
    policy = Astray()
    policy.drawers = torch.tensor(drawers[1:])
    options = replace(OPTIONS, suction=replace(OPTIONS.suction, hold="any"))
    (row,) = run_trials("astray", policy, [obj], scheduled, options)
    assert (row.status, row.success, row.contact, row.held_opened) == ("ok", False, False, True)


def test_a_policy_that_stands_still_opens_nothing(objects: list[ArticulatedObject], trials: list[Scheduled]) -> None:
    options = EnvOptions(points=300, camera=CAMERA, horizon=5)
    rows = run_trials("still", Policy(lambda call: torch.zeros(8)), objects, trials, options)
    assert len(rows) == len(trials)
    for row in rows:
        assert (row.steps, row.contact, row.success, row.attach_step) == (5, False, False, -1)
        assert row.normalized_distance == pytest.approx(1.0, abs=1e-3)
        assert row.failure == "never touched the part"


def test_a_crash_costs_its_own_trial_only(objects: list[ArticulatedObject], trials: list[Scheduled]) -> None:
    def act(call: int) -> torch.Tensor:
        if call == 8:  # in the second trial
            raise RuntimeError("the network fell over")
        return torch.zeros(8)

    options = EnvOptions(points=300, camera=CAMERA, horizon=5)
    rows = run_trials("broken", Policy(act), objects, trials, options)
    assert len(rows) == len(trials)
    assert [row.status for row in rows] == ["ok", "error", *["ok"] * (len(trials) - 2)]
    assert "the network fell over" in rows[1].error and rows[1].normalized_distance == 1.0


@pytest.mark.parametrize("backend", ["direct", pytest.param("process", marks=pytest.mark.slow)])
@pytest.mark.parametrize("broken", ["first", "all"])
def test_an_object_that_cannot_be_built_costs_its_own_trials_only(
    backend: Literal["direct", "process"], broken: str, objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    """From the first trial on: no worker needs an object to start."""
    endless = Mesh(np.full((4, 3), np.nan), np.array([[0, 1, 2], [0, 2, 3]]))
    names = {trials[0].trial.object} if broken == "first" else {item.trial.object for item in trials}

    def spoiled(obj: ArticulatedObject) -> ArticulatedObject:
        links = tuple(dataclasses.replace(link, collisions=(endless,)) for link in obj.links)
        return dataclasses.replace(obj, links=links) if obj.id in names else obj

    options = EnvOptions(points=300, camera=CAMERA, horizon=3)
    rows = run_trials("still", Still(), [spoiled(obj) for obj in objects], trials, options,
                      collector=CollectorOptions(backend, 1))  # fmt: skip
    assert [row.status == "error" for row in rows] == [item.trial.object in names for item in trials]
    assert all(row.error and "not run" not in row.error for row in rows if row.status == "error")


class Deadly(TensorDictModuleBase):
    """The expert, until its fifth step seen from ``camera``, which kills the process."""

    def __init__(self, camera: torch.Tensor) -> None:
        super().__init__()
        self.expert = expert_policy(LIMITS)
        self.initial_state = self.expert.initial_state
        self.in_keys, self.out_keys = self.expert.in_keys, self.expert.out_keys
        self.camera = camera

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        if td["elapsed_steps"].item() == 4 and torch.equal(td["observation", "camera_position"], self.camera):
            os.kill(os.getpid(), signal.SIGKILL)
        return self.expert(td)


@pytest.mark.slow
def test_worker_processes_give_the_same_rows_and_a_dead_one_costs_its_trial_only(
    objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    rows = run_trials("expert", expert_policy(LIMITS), objects, trials, OPTIONS)
    env = make_env(objects, OPTIONS, [trials[1].trial])
    policy = Deadly(env.reset()["observation", "camera_position"])
    env.close()
    seen: list[int] = []
    again = run_trials("expert", policy, objects, trials, OPTIONS, lambda row: seen.append(row.trial),
                       CollectorOptions("process", 2))  # fmt: skip
    assert sorted(seen) == list(range(len(trials)))
    assert again[1].status == "error" and "signal 9" in again[1].error and again[1].failure == "crashed"
    assert policy_digest(policy) != policy_digest(expert_policy(LIMITS))  # it is another policy
    again = [replace(row, policy_digest=rows[0].policy_digest) for row in again]
    assert again[:1] + again[2:] == rows[:1] + rows[2:]


class Late:
    """Stands still, and hangs from its ``first`` call on; can be pickled."""

    def __init__(self, seconds: float, first: int) -> None:
        self.seconds, self.first = seconds, first

    def __call__(self, call: int) -> torch.Tensor:
        if call >= self.first:
            time.sleep(self.seconds)
        return torch.zeros(8)


@pytest.mark.parametrize("backend", ["direct", "process"])
def test_a_policy_that_hangs_costs_its_own_trial(
    backend: Literal["direct", "process"], objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    options = EnvOptions(points=300, camera=CAMERA, horizon=3)
    started = time.perf_counter()
    timing: list[float] = []
    rows = run_trials("late", Policy(Late(60.0, first=8)), objects, trials[:4], options,
                      collector=CollectorOptions(backend, 1), limit=0.5,
                      timing=lambda trial, seconds: timing.extend(seconds))  # fmt: skip
    assert time.perf_counter() - started < 50
    assert [row.status for row in rows] == ["ok", "ok", "error", "error"]
    assert {row.failure for row in rows[2:]} == {"took too long"} and "0.5 s" in rows[2].error
    assert len(timing) == 6 and 0 < max(timing) < 0.5


class Deaf(Late):
    """Hangs where no exception reaches it."""

    def __call__(self, call: int) -> torch.Tensor:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
        return super().__call__(call)


@pytest.mark.slow
def test_a_policy_that_hangs_in_a_library_costs_its_worker(
    objects: list[ArticulatedObject], trials: list[Scheduled]
) -> None:
    options = EnvOptions(points=300, camera=CAMERA, horizon=3)
    rows = run_trials("deaf", Policy(Deaf(120.0, first=5)), objects, trials[:3], options,
                      collector=CollectorOptions("process", 1), limit=0.5)  # fmt: skip
    assert [row.status for row in rows] == ["ok", "error", "ok"] and "exit code 1" in rows[1].error


def test_a_policy_that_answers_nan_fails_its_trial(objects: list[ArticulatedObject], trials: list[Scheduled]) -> None:
    policy = Policy(lambda call: torch.full((8,), float("nan") if call == 2 else 0.0))
    options = EnvOptions(points=300, camera=CAMERA, horizon=3)
    rows = run_trials("nan", policy, objects, trials[:2], options)
    assert [row.failure for row in rows] == ["crashed", "never touched the part"] and "nan" in rows[0].error


def frames(distance: list[float], contact: list[bool], attached: list[bool], force: float = 1.0) -> TensorDict:
    """An episode whose tip goes 1 cm a step."""
    steps = len(distance)
    pose = torch.zeros(steps + 1, 7)
    pose[:, 0] = 0.01 * torch.arange(steps + 1)

    def column(values: list[Any]) -> torch.Tensor:
        return torch.tensor(values)[:, None]

    seen = {"tool_pose": pose[1:], "attached": column(attached), "contact_force": column([force] * steps)}
    after = {
        "success": column([d < 0.1 for d in distance]),
        "normalized_distance": column(distance),
        "contact": column(contact),
        "held_opened": column([False] * steps),
        "observation": seen,
    }
    return TensorDict({"observation": {"tool_pose": pose[:-1]}, "next": after}, batch_size=[steps])


def test_why_trials_fail() -> None:
    held, no = [True] * 40, [False] * 40
    slowly = [1.0 - 0.01 * k for k in range(40)]
    for expected, episode in {
        "never touched the part": frames([1.0] * 40, no, no, force=0.0),
        "touched, but never held the part": frames([1.0] * 40, no, no),
        "lost hold": frames([0.5] * 40, held, [True] * 39 + [False]),
        "stuck": frames(slowly[:10] + [0.9] * 30, held, held),
        "timed out": frames(slowly, held, held),
        "wrong direction": frames([1.0 + 0.01 * k for k in range(40)], held, held),
        "": frames([*slowly[:-1], 0.05], held, held),
    }.items():
        assert _outcome(episode, control_freq=20)["failure"] == expected
    blinking = [k % 10 > 4 for k in range(40)]
    episode = frames(slowly, held, blinking)
    outcome = _outcome(episode, control_freq=20)
    assert outcome["lost"] == 3 and outcome["seconds"] == 2.0 and outcome["network_calls"] == -1
    episode[LOOKS] = torch.arange(40)[:, None] // 10
    assert _outcome(episode, control_freq=20)["network_calls"] == 3
    assert outcome["path_length"] == pytest.approx(0.4)


def test_pulls_until_the_part_moves_the_right_way() -> None:
    def tips(*ways: float) -> torch.Tensor:  # along x, cm in each step
        return torch.tensor([[x, 0.0, 0.0] for x in (0.0, *ways)]).cumsum(0) / 100

    def pulls(ways: list[float], attached: list[bool], distance: list[float]) -> int:
        return pulls_until_moved(tips(*ways), torch.tensor(attached), torch.tensor(distance))

    held = [True] * 8
    opens = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.94, 0.5]
    assert pulls([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], held, opens) == 1
    assert pulls([0.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0], held, opens) == 2, "it turned round"
    assert pulls([0.0, 0.1, -0.1, 0.1, -0.1, 0.1, 1.0, 1.0], held, opens) == 1, "it trembled"
    assert pulls([1.0] * 8, [True, False, False, True, True, True, True, True], opens) == 2, "it was held twice"
    assert pulls([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0], held, opens) == 1, "afterwards it does not count"
    assert pulls([1.0] * 8, held, [1.0] * 8) == -1, "it never moved"


def test_a_goal_on_either_side_is_reached_by_the_flow_and_its_inverse(
    objects: list[ArticulatedObject], tmp_path: Path
) -> None:
    for way, (start, goal) in {"open": (0.1, 0.7), "close": (0.8, 0.2)}.items():
        trials = []
        for obj in objects:
            link = openable_links(obj)[0]
            trial = default_trial(obj, link, fraction=start, goal=goal)
            trials.append(Scheduled(trial, obj.category, "", obj.links[link].name, "", ""))
        rows = run_trials("expert", expert_policy(LIMITS), objects, trials, OPTIONS)
        assert [row.success for row in rows] == [True] * len(objects), way
        assert all(row.steps > 5 for row in rows)
