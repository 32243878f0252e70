"""Expert and learner at one gripper: whose action counts, what the label is, what the expert makes of other's steps."""

from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.env.options import EnvOptions, Trial, default_trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.policies.flow_policy import FlowPolicy, expert_policy
from fb3d_rl.policies.flow_state import APPROACH, PULL, RELEASE, RETREAT, SELECT, TRAVEL, FlowState
from fb3d_rl.policies.gates import make_gate
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, EitherGate, Gate, HumanGate, InteractivePolicy, OracleGate, uniform
from fb3d_rl.rollout.collectors import CollectorOptions, Workers
from fb3d_rl.rollout.run import policy_env, state_of

LIMITS = VelocityLimits(linear=2.0, angular=3.0)
POINTS = 40


class Learner(TensorDictModuleBase):
    """Drifts with an action that grows with the step; its discrepancy and variance are known functions of the step."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys = [("observation", "qpos"), "elapsed_steps", ("learner", "last")]
        self.out_keys = ["action", ("learner", "discrepancy"), ("learner", "variance"), ("next", "learner", "last")]
        self.drift = torch.nn.Parameter(torch.linspace(-0.3, 0.3, ACTION_DIM))

    @staticmethod
    def initial_state(batch: torch.Size) -> TensorDict:
        return TensorDict({"learner": {"last": torch.zeros(*batch, ACTION_DIM)}}, batch_size=batch)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        step = td["elapsed_steps"].float()
        td["action"] = self.drift * (1 + 0.01 * step)
        td["learner", "discrepancy"] = 0.5 + 0.5 * torch.sin(step)
        td["learner", "variance"] = 0.01 * (1 + torch.cos(2 * step))
        td["next", "learner", "last"] = td["action"]
        return td


def chooses(*decisions: bool) -> Callable[[TensorDictBase], Tensor]:
    """A person who takes over in these environments."""
    return lambda td: torch.tensor(decisions)[:, None]


def scene(count: int, attached: bool = False) -> TensorDict:
    """Steps of ``count`` environments before a door in the plane x = 0 that opens towards -x."""
    random = torch.Generator().manual_seed(0)
    points = torch.rand(count, POINTS, 3, generator=random) * torch.tensor([0.0, 0.8, 0.8])
    flow = torch.zeros(count, POINTS, 3)
    flow[..., 0] = -points[..., 1] / points[..., 1].amax(1, keepdim=True)
    qpos = torch.zeros(count, ACTION_DIM)
    qpos[:, :3] = torch.tensor([-1.0, 0.4, 0.5]) + 0.1 * torch.rand(count, 3, generator=random)
    tip = qpos[:, :3] + torch.tensor([0.12, 0.0, 0.0])
    observation = {
        "points": points,
        "valid": torch.ones(count, POINTS, dtype=torch.bool),
        "part_mask": torch.ones(count, POINTS, dtype=torch.bool),
        "qpos": qpos,
        "qvel": torch.zeros(count, ACTION_DIM),
        "tool_pose": torch.cat([tip, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4)], -1),
        "attached": torch.full((count, 1), attached),
        "contact_force": torch.zeros(count, 1),
        "camera_position": torch.tensor([[-3.0, 0.4, 1.0]]).expand(count, 3).clone(),
        "goal_sense": torch.ones(count, 1),
    }
    content = {
        "observation": observation,
        "privileged": {"flow": flow},
        "policy": FlowState.initial((count,)).packed(),
        "seed": torch.arange(count)[:, None],
        "elapsed_steps": torch.full((count, 1), 3),
    }
    return TensorDict(content, batch_size=[count])


def start(policy: InteractivePolicy, td: TensorDict) -> TensorDict:
    td.update(policy.initial_state(td.batch_size))
    return td


def test_the_label_is_the_experts_whoever_acts() -> None:
    expert, learner = expert_policy(LIMITS), Learner()
    policy = InteractivePolicy(expert, learner, HumanGate(chooses(True, False, True)))
    td = start(policy, scene(3))
    alone, own = expert(td.clone())["action"], learner(td.clone())["action"]
    assert (alone - own).norm(dim=-1).min() > 0.1
    out = policy(td)
    assert torch.equal(out["expert", "action"], alone) and torch.equal(out["learner", "action"], own)
    assert torch.equal(out["action"], torch.stack([alone[0], own[1], alone[2]]))
    assert out["expert", "acts"].flatten().tolist() == [True, False, True]
    assert out["next", "expert", "looks_on"].flatten().tolist() == [False, True, False]


def test_labels_do_not_change_with_who_acts() -> None:
    labels = []
    for decisions in ((True, True), (False, False)):
        policy = InteractivePolicy(expert_policy(LIMITS), Learner(), HumanGate(chooses(*decisions)))
        labels.append(policy(start(policy, scene(2)))["expert", "action"])
    assert torch.equal(*labels)


def test_without_a_learner_the_expert_acts_whatever_the_gate_says() -> None:
    policy = InteractivePolicy(expert_policy(LIMITS), None, BetaGate(0.0))
    td = start(policy, scene(2))
    alone = expert_policy(LIMITS)(td.clone())["action"]
    out = policy(td)
    assert torch.equal(out["action"], alone) and torch.equal(out["expert", "action"], alone)
    assert out["expert", "acts"].all() and ("learner", "action") not in out.keys(True)


def test_keys_that_come_from_outside_and_those_that_do_not() -> None:
    policy = InteractivePolicy(expert_policy(LIMITS), Learner(), EitherGate(OracleGate(), make_gate("thrifty")))
    outside = {("observation", "attached"), ("learner", "last"), ("expert", "looks_on")}
    made = {"action", ("expert", "action"), ("learner", "action"), ("learner", "discrepancy"), ("learner", "variance")}
    assert outside <= set(policy.in_keys) and not made & set(policy.in_keys)
    given = start(policy, scene(2))
    assert set(policy.in_keys) <= set(given.keys(True)), "nothing else is needed"
    assert set(policy.out_keys) <= set(policy(given).keys(True))
    assert {"seed", "elapsed_steps"} <= set(InteractivePolicy(expert_policy(LIMITS), Learner(), BetaGate()).in_keys)


def test_a_learner_that_would_write_the_experts_state_is_refused() -> None:
    learner = FlowPolicy(("prediction", "flow"), LIMITS)
    with pytest.raises(ValueError, match="policy.*phase"):
        InteractivePolicy(expert_policy(LIMITS), learner, BetaGate())


def looking_on(phases: list[int], sideways: float) -> TensorDict:
    """Environments in the given phases twice: where the expert acted before, then where it looked on.

    The tip is 0.3 m before the contact point and ``sideways`` (m) off the approach line; one candidate is 1 m to that
    side, another one 1 m to the other.
    """
    count = 2 * len(phases)
    towards = torch.tensor([-1.0, 0.0, 0.0])
    td = TensorDict({"policy": FlowState.initial((count,)).packed()}, batch_size=[count])
    td["policy", "phase"], td["policy", "idle"] = torch.tensor(phases * 2)[:, None], torch.full((count, 1), 5)
    td["policy", "standoff"] = td["policy", "pull"] = towards.expand(count, 3).clone()
    for k, side in enumerate((1.0, -1.0)):
        contact = {
            "point": torch.tensor([0.0, side, 0.0]),
            "flow": towards,
            "standoff": towards,
            "share": torch.ones(1),
        }
        for key, value in contact.items():
            td["policy", "candidates", key][:, k] = value
    td["observation", "tool_pose"] = torch.tensor([-0.3, sideways, 0.0, 1.0, 0.0, 0.0, 0.0]).expand(count, 7)
    td["expert", "looks_on"] = (torch.arange(count) >= len(phases))[:, None]
    return td


@pytest.mark.parametrize(
    ("sideways", "after"),
    [
        (0.01, [SELECT, TRAVEL, TRAVEL, PULL, SELECT, SELECT]),
        (-0.2, [SELECT, TRAVEL, TRAVEL, PULL, SELECT, SELECT]),
    ],
)
def test_an_expert_that_looks_on_draws_no_conclusions_and_insists_on_no_plan(sideways: float, after: list[int]) -> None:
    phases = [SELECT, TRAVEL, APPROACH, PULL, RETREAT, RELEASE]
    td = looking_on(phases, sideways)
    td["policy", "chosen"] = torch.full((12, 1), 2)
    before = td["policy"].clone()
    InteractivePolicy(expert_policy(LIMITS), None, BetaGate()).follow(td)
    assert td["policy", "phase"].flatten().tolist() == phases + after
    assert td["policy", "idle"].flatten().tolist() == [5] * 6 + [0] * 6
    chosen = [phase == TRAVEL for phase in after]
    goal = torch.where(torch.tensor(chosen), 1.0 if sideways > 0 else -1.0, 0.0)
    assert torch.equal(td["policy", "contact_point"][6:, 1], goal), "the candidate on the side where the hand is"
    tries = [1 if phase == SELECT else 2 for phase in after]
    assert td["policy", "chosen"].flatten().tolist() == [2] * 6 + tries, "what the learner missed was none of its tries"
    rest = [key for key in before.keys() if key not in ("phase", "idle", "contact_point", "chosen")]
    assert (td["policy"].select(*rest) == before.select(*rest)).all()


def test_the_label_of_one_that_looks_on_does_not_depend_on_what_it_meant_to_do() -> None:
    """On the way or on its approach, to whichever point: what it then sees is the same, so is its label."""
    policy = InteractivePolicy(expert_policy(LIMITS), Learner(), BetaGate(0.0))
    one = start(policy, scene(1))
    one.update(policy(one.clone())["next"])
    td = torch.cat([one] * 3)
    state, candidates = td["policy"], one["policy", "candidates"][0]
    assert (candidates["share"] > 0).sum() >= 3
    for k, phase in enumerate((TRAVEL, APPROACH, APPROACH)):
        state["phase"][k] = phase
        for key, value in (("contact_point", "point"), ("pull", "flow"), ("standoff", "standoff")):
            state[key][k] = candidates[value][k]
    for looks_on in (True, False):
        td["expert", "looks_on"] = torch.full((3, 1), looks_on)
        labels = policy(td.clone())["expert", "action"]
        same = torch.equal(labels[0], labels[1]) and torch.equal(labels[1], labels[2])
        assert same == looks_on


def test_a_learner_that_stands_still_is_no_stuck_expert() -> None:
    """Held and without progress the expert gives up after a while, but not if the learner does the pulling."""
    for acts in (True, False):
        policy = InteractivePolicy(expert_policy(LIMITS), Learner(), HumanGate(chooses(acts)))
        td, seen = start(policy, scene(1, attached=True)), []
        for _ in range(12):
            after = policy(td.clone())["next"]
            td.update(after)
            seen.append(int(after["policy", "phase"]))
        assert seen[0] == PULL and (RELEASE in seen) == acts


def test_draws_are_uniform_and_depend_on_seed_step_and_purpose_only() -> None:
    seeds, at = torch.arange(6).repeat(2)[:, None], torch.tensor([0] * 6 + [9] * 6)[:, None]
    td = TensorDict({"seed": seeds, "elapsed_steps": at}, batch_size=[12])
    drawn = uniform(td, 1)
    assert drawn.dtype is torch.float64 and len(drawn.unique()) == 12 and ((drawn >= 0) & (drawn < 1)).all()
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    assert torch.equal(uniform(td[order], 1), drawn[order]), "neither the place in the batch nor the neighbours count"
    assert torch.equal(torch.cat([uniform(td[i : i + 1], 1) for i in range(12)]), drawn), "nor who asked before"
    assert not (uniform(td, 2) == drawn).any()
    once = uniform(td, 1, per_step=False)
    assert torch.equal(once[:6], once[6:]) and len(once.unique()) == 6


@pytest.mark.parametrize("per_step", [True, False])
@pytest.mark.parametrize("beta", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_beta_is_the_experts_share(beta: float, per_step: bool) -> None:
    """Of 6000 draws, within 5 standard deviations of the binomial: a right gate would fail with p < 6e-7."""
    seeds, at = torch.meshgrid(torch.arange(100), torch.arange(60), indexing="ij")
    td = TensorDict({"seed": seeds.reshape(-1, 1), "elapsed_steps": at.reshape(-1, 1)}, batch_size=[6000])
    acts = BetaGate(beta, per_step)(td).reshape(100, 60)
    if per_step and 0 < beta < 1:
        assert acts.any(1).all() and not acts.all(1).any(), "in an episode of 60 steps both act"
    if not per_step:
        assert torch.equal(acts, acts[:, :1].expand(100, 60)), "one draw for the episode"
        seeds = torch.arange(6000)[:, None]
        acts = BetaGate(beta, per_step)(TensorDict({"seed": seeds, "elapsed_steps": seeds % 60}, batch_size=[6000]))
    n = acts.numel()
    assert abs(int(acts.sum()) - n * beta) <= 5 * math.sqrt(n * beta * (1 - beta))


def test_a_share_that_falls_takes_steps_from_the_expert_and_gives_none() -> None:
    td = TensorDict({"seed": torch.arange(500)[:, None], "elapsed_steps": torch.arange(500)[:, None]}, batch_size=[500])
    few, many = BetaGate(0.3)(td), BetaGate(0.6)(td)
    assert (many | ~few).all() and many.sum() > few.sum()


def test_the_oracle_acts_until_the_part_is_held_and_when_it_is_lost() -> None:
    td = TensorDict({"observation": {"attached": torch.tensor([[False], [True]])}}, batch_size=[2])
    assert OracleGate()(td).flatten().tolist() == [True, False]


def takes_over_late(td: TensorDictBase) -> Tensor:
    """A person who takes over in every third step."""
    return td["elapsed_steps"] % 3 == 2


def test_a_person_reads_the_step_and_decides() -> None:
    policy = InteractivePolicy(expert_policy(LIMITS), Learner(), HumanGate(takes_over_late))
    td = start(policy, scene(4))
    td["elapsed_steps"] = torch.arange(4)[:, None]
    assert policy(td)["expert", "acts"].flatten().tolist() == [False, False, True, False]


def test_a_policy_can_be_pickled_and_its_gate_comes_with_the_weights() -> None:
    gate, learner = BetaGate(0.5), Learner()
    policy = InteractivePolicy(expert_policy(LIMITS), learner, gate)
    there = pickle.loads(pickle.dumps(policy))
    gate.beta.fill_(0.25)
    learner.drift.data.fill_(0.125)
    TensorDict.from_module(policy).data.clone().to_module(there)
    assert float(there.gate.beta) == 0.25 and torch.equal(there.learner.drift, learner.drift)
    td = start(policy, scene(2))
    assert torch.equal(there(td.clone())["action"], policy(td)["action"])


# In the simulator

OPTIONS = EnvOptions(points=200, camera=CameraOptions(resolution=32), horizon=24)
BARE = expert_policy(VelocityLimits(OPTIONS.gripper.v_max, OPTIONS.gripper.w_max))


@pytest.fixture(scope="module")
def microwave(procedural_objects: dict[str, ArticulatedObject]) -> ArticulatedObject:
    return procedural_objects["Microwave"]


@pytest.fixture(scope="module")
def trials(microwave: ArticulatedObject) -> list[Trial]:
    return [dataclasses.replace(default_trial(microwave), seed=seed) for seed in range(2)]


def create(obj: ArticulatedObject, policy: TensorDictModuleBase) -> EnvBase:
    return policy_env(make_env([obj], OPTIONS), state_of(policy))


def rounds(
    policy: TensorDictModuleBase, trials: list[Trial], obj: ArticulatedObject, backend: str = "direct"
) -> Iterator[list[TensorDictBase]]:
    """The frames of all trials, round after round, each with the policy's weights as they are by then."""
    with Workers(partial(create, obj, policy), policy, CollectorOptions(backend), OPTIONS.horizon) as workers:
        while True:
            workers.update_policy_weights_()
            episodes = sorted(workers.run(trials), key=lambda episode: episode.index)
            assert [episode.error for episode in episodes] == [""] * len(trials)
            yield [episode.frames for episode in episodes if episode.frames is not None]


def first_round(policy: TensorDictModuleBase, trials: list[Trial], obj: ArticulatedObject) -> list[TensorDictBase]:
    generator = rounds(policy, trials, obj)
    frames = next(generator)
    generator.close()
    return frames


@pytest.fixture(scope="module")
def bare(trials: list[Trial], microwave: ArticulatedObject) -> list[TensorDictBase]:
    return first_round(BARE, trials, microwave)


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("name", ["beta", "lazy"])
def test_an_episode_of_the_expert_alone_is_the_bare_experts(
    name: str, learns: bool, bare: list[TensorDictBase], trials: list[Trial], microwave: ArticulatedObject
) -> None:
    gate = make_gate(name)
    if name == "lazy":
        gate.beta_h.fill_(-math.inf)  # as a budget of everything sets it
    policy = InteractivePolicy(BARE, Learner() if learns else None, gate)
    for mixed, alone in zip(first_round(policy, trials, microwave), bare, strict=True):
        assert mixed["expert", "acts"].all() and alone["action"].abs().max() > 0.1
        keys = list(alone.keys(True, True))
        assert {"action", ("policy", "phase"), ("next", "observation", "points")} <= set(keys)
        assert (mixed.select(*keys) == alone).all(), "bit for bit"
        assert torch.equal(mixed["expert", "action"], alone["action"])
        if learns:
            learner = Learner()(mixed.select("elapsed_steps"))
            assert torch.equal(mixed["learner", "action"], learner["action"]), "it says what it would have done"


def gates() -> list[Gate]:
    return [
        BetaGate(0.4),
        BetaGate(0.4, per_step=False),
        EitherGate(OracleGate(), make_gate("safe")),
        make_gate("ensemble", chi=0.01, tau=9.0),
        make_gate("lazy", beta_h=0.8, beta_r=0.1),
        make_gate("thrifty", delta_h=0.019, beta_h=2.0, delta_r=9.0),
        HumanGate(takes_over_late),
    ]


@pytest.mark.parametrize("gate", gates(), ids=lambda gate: type(gate).__name__)
def test_who_acts_in_the_simulator_is_what_the_gate_decides(
    gate: Gate, trials: list[Trial], microwave: ArticulatedObject
) -> None:
    for frames in first_round(InteractivePolicy(BARE, Learner(), gate), trials, microwave):
        assert frames["elapsed_steps"].flatten().tolist() == list(range(OPTIONS.horizon))
        acts = frames["expert", "acts"]
        assert torch.equal(gate(frames.exclude("next")), acts), "asked again, about all steps at once"
        assert torch.equal(frames["action"], torch.where(acts, frames["expert", "action"], frames["learner", "action"]))
        assert torch.equal(frames["next", "expert", "looks_on"], ~acts)
        state = [("expert", "looks_on"), ("learner", "last"), *gate.initial_state(torch.Size([])).keys(True, True)]
        for key in state:
            assert not frames[key][0].any() and torch.equal(frames[key][1:], frames["next"][key][:-1])
        moved = frames["next", "observation", "qpos"] - frames["observation", "qpos"]
        assert (moved[:5, :3] * frames["action"][:5, :3]).sum() > 0, "the hand does what the action says"


def test_shares_by_known_signals(trials: list[Trial], microwave: ArticulatedObject) -> None:
    """The learner's signals are known functions of the step, so the expert's steps are too."""
    over = 0.5 + 0.5 * torch.sin(torch.arange(OPTIONS.horizon, dtype=torch.float32)) > 0.8
    first = int(over.nonzero()[0])
    held = [t >= first for t in range(OPTIONS.horizon)]  # the learner never comes within 0.1 of the expert
    for gate, expected in (
        (make_gate("safe", tau=0.8), over.tolist()),
        (make_gate("lazy", beta_h=0.8, beta_r=0.1), held),
    ):
        for frames in first_round(InteractivePolicy(BARE, Learner(), gate), trials, microwave):
            assert frames["expert", "acts"].flatten().tolist() == expected
    assert 0 < first and 0 < int(over.sum()) < sum(held)


@pytest.mark.parametrize("backend", ["direct", pytest.param("process", marks=pytest.mark.slow)])
def test_a_rounds_share_reaches_the_workers(backend: str, trials: list[Trial], microwave: ArticulatedObject) -> None:
    gate = BetaGate(1.0)
    generator = rounds(InteractivePolicy(BARE, Learner(), gate), trials, microwave, backend)
    for beta in (1.0, 0.3, 0.0):
        gate.beta.fill_(beta)
        for frames in next(generator):
            assert torch.equal(frames["expert", "acts"], uniform(frames, 1) < beta)
    generator.close()
