"""What policies are told is what is declared, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.algos.dagger import acting_policy
from fb3d_rl.algos.kinds import KINDS
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet, artflownet_module
from fb3d_rl.policies.baselines import RandomPolicy, normal_policy
from fb3d_rl.policies.flow_policy import MASK, FlowPolicyOptions, expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.learner import Learner, LearnerOptions
from fb3d_rl.policies.truths import TOLD, table
from fb3d_rl.rollout.run import mask_of

LIMITS = VelocityLimits(2.0, 3.0)
MASKED, MASKLESS = FlowPolicyOptions(), FlowPolicyOptions(mask="none")


def trained(name: str, options: FlowPolicyOptions, part_mask_input: bool = True) -> TensorDictModuleBase:
    generator = torch.Generator().manual_seed(0)
    return KINDS[name].policy(KINDS[name].network(part_mask_input, 8, "delayed", generator), LIMITS, options)


def learned(flow: str, oracle: bool) -> TensorDictModuleBase:
    learner = Learner(LearnerOptions(flow=flow, encoder="pointnet", width=4), LIMITS)  # type: ignore[arg-type]
    return acting_policy(expert_policy(LIMITS), learner, oracle)


POLICIES: dict[str, Callable[[], TensorDictModuleBase]] = {
    "expert": lambda: expert_policy(LIMITS, MASKED),
    "expert, policy.mask=none": lambda: expert_policy(LIMITS, MASKLESS),
    "artflownet": lambda: trained("artflownet", MASKED),
    "artflownet, policy.mask=none": lambda: trained("artflownet", MASKLESS, part_mask_input=False),
    "screwnet": lambda: trained("screwnet", MASKED),
    "ump_di": lambda: trained("ump_di", MASKED),
    "normal": lambda: normal_policy(LIMITS, MASKED),
    "random": lambda: RandomPolicy(),
    "bc, dagger": lambda: learned("none", False),
    "bc_flow, dagger_flow": lambda: learned("ground_truth", False),
    "bc_oracle, dagger_oracle": lambda: learned("none", True),
    "bc_oracle_flow, dagger_oracle_flow": lambda: learned("ground_truth", True),
}


@pytest.mark.parametrize("name", TOLD)
def test_a_policy_reads_what_is_declared(name: str) -> None:
    policy, told = POLICIES[name](), TOLD[name]
    assert {key for key in policy.in_keys if key[0] == "privileged"} == set(told.truth)
    assert (MASK in policy.in_keys) == told.mask
    assert mask_of(policy) == ("target" if told.mask else "" if name == "random" else "none")


def test_no_policy_is_missing_and_the_documents_say_the_same() -> None:
    assert set(POLICIES) == set(TOLD)
    assert table() in (Path(__file__).parents[2] / "docs" / "protocols.md").read_text()


def test_without_a_mask_the_network_s_module_reads_none_either() -> None:
    assert MASK not in artflownet_module(ArtFlowNet(False, 8)).in_keys
    assert MASK in artflownet_module(ArtFlowNet(True, 8)).in_keys


@pytest.mark.parametrize("name", KINDS)
def test_a_network_that_needs_the_mask_says_so(name: str) -> None:
    with pytest.raises(UserError, match=r"policy\.mask=target"):
        trained(name, MASKLESS)
    with pytest.raises(UserError, match=r"policy\.mask=target"):
        normal_policy(LIMITS, MASKLESS)
