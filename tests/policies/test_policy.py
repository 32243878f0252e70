"""Every policy declares the state that it carries, and no more."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.direction_net import DirectionNet
from fb3d_rl.policies.baselines import RandomPolicy, normal_policy
from fb3d_rl.policies.direction_policy import direction_policy
from fb3d_rl.policies.ensemble import Ensemble
from fb3d_rl.policies.flow_policy import artflownet_policy, expert_policy
from fb3d_rl.policies.gates import make_gate
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy
from fb3d_rl.policies.learner import Learner, LearnerOptions
from fb3d_rl.policies.policy import initial_state

LIMITS = VelocityLimits(linear=2.0, angular=3.0)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def learner(**options: int) -> Learner:
    return Learner(LearnerOptions(encoder="pointnet", width=8, points=32, **options), LIMITS, generator())  # type: ignore[arg-type]


def policies() -> dict[str, tuple[TensorDictModuleBase, set[str]]]:
    """Policies and the groups of state that they carry."""
    expert = expert_policy(LIMITS)
    return {
        "expert": (expert, {"policy"}),
        "artflownet": (artflownet_policy(ArtFlowNet(neighbors=8, generator=generator()), LIMITS), {"policy", "touch"}),
        "normal": (normal_policy(LIMITS), {"policy"}),
        "direction": (direction_policy(DirectionNet(generator=generator()), LIMITS), {"policy"}),
        "random": (RandomPolicy(), set()),
        "bc": (learner(), {"learner"}),
        "bc with a plan": (learner(chunk=3, execute=2), {"learner"}),
        "bc without a history": (learner(history=0), set()),
        "ensemble": (Ensemble([learner(), learner()]), {"learner"}),
        "dagger": (InteractivePolicy(expert, learner(), BetaGate()), {"policy", "learner", "expert"}),
        "lazy": (
            InteractivePolicy(expert, learner(discrepancy=True), make_gate("lazy")),
            {"policy", "learner", "expert", "gate"},
        ),
    }


@pytest.mark.parametrize("name", policies())
def test_the_initial_state_is_what_a_policy_reads_back_of_what_it_writes(name: str) -> None:
    policy, groups = policies()[name]
    state = initial_state(policy, torch.Size([2]))
    assert set(state.keys()) == groups
    assert state.batch_size == torch.Size([2]) and not any(bool(value.any()) for value in state.values(True, True))
    keys = {key for key in state.keys(True) if isinstance(key, tuple) and len(key) == 2}
    carried = {key[1:] for key in policy.out_keys if key[0] == "next"}
    gate = {key for key in keys if key[0] == "gate"}  # a gate declares nothing that it writes
    assert carried == keys - gate - ({*_not_declared(policy)})
    assert keys - gate <= set(policy.in_keys)


def _not_declared(policy: TensorDictModuleBase) -> set[tuple[str, str]]:
    """What the expert and the learner in an interactive policy write and it does not declare."""
    if not isinstance(policy, InteractivePolicy):
        return set()
    inner = [part for part in (policy.expert, policy.learner) if part is not None]
    return {key[1:] for part in inner for key in part.out_keys if key[0] == "next"}


def test_a_learner_carries_what_it_remembers_and_nothing_of_the_flow_policy() -> None:
    state = initial_state(learner(history=3), torch.Size([1]))
    assert sum(value.numel() for value in state.values(True, True)) == 3 * 15


def test_the_state_of_a_sequence_is_that_of_its_parts_and_the_same_as_the_policys_alone() -> None:
    def same(a: TensorDictBase, b: TensorDictBase) -> bool:
        return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())

    one = torch.Size([1])
    assert same(initial_state(normal_policy(LIMITS), one), expert_policy(LIMITS).initial_state(one))
