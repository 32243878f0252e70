"""Every policy and algorithm is there in full, and reads what is declared and nothing else."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.algos.learners import acting_policy
from fb3d_rl.algos.options import AlgoOptions
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet, artflownet_module
from fb3d_rl.policies.flow_policy import MASK, FlowPolicyOptions, artflownet_policy, expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.learner import Learner, LearnerOptions
from fb3d_rl.registry import REGISTRY, WITHOUT_MASK, behind, truths, truths_table
from fb3d_rl.rollout.run import mask_of

ROOT = Path(__file__).resolve().parents[1]
LIMITS = VelocityLimits(2.0, 3.0)
MASKED, MASKLESS = FlowPolicyOptions(), FlowPolicyOptions(mask="none")


KINDS = [name for name, entry in REGISTRY.items() if entry.options == REGISTRY["artflownet"].options]
ACCESS = truths()


def trained(name: str, options: FlowPolicyOptions, part_mask_input: bool = True) -> TensorDictModuleBase:
    kind, generator = behind(REGISTRY[name].algorithm), torch.Generator().manual_seed(0)
    made: TensorDictModuleBase = kind.policy(kind.network(part_mask_input, 8, "delayed", generator), LIMITS, options)
    return made


def untrained(name: str, options: FlowPolicyOptions) -> TensorDictModuleBase:
    made: TensorDictModuleBase = behind(REGISTRY[name].act)(LIMITS, options)
    return made


def learned(flow: str, oracle: bool) -> TensorDictModuleBase:
    learner = Learner(LearnerOptions(flow=flow, encoder="pointnet", width=4), LIMITS)  # type: ignore[arg-type]
    return acting_policy(expert_policy(LIMITS), learner, oracle)


def blind(limits: VelocityLimits, options: FlowPolicyOptions) -> Callable[[TensorDictBase], torch.Tensor]:
    """A policy of a user's that declares nothing."""
    return lambda seen: torch.zeros(*seen.batch_size, 8)


def from_outside(make: Callable[..., object], options: FlowPolicyOptions) -> TensorDictModuleBase:
    """policy=plugin with a function of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "plugged", SimpleNamespace(make=make))  # type: ignore[arg-type]
        made: TensorDictModuleBase = behind(REGISTRY["plugin"].act)(LIMITS, options, "plugged:make", 64)
    return made


POLICIES: dict[str, Callable[[], TensorDictModuleBase]] = {
    "plugin": lambda: from_outside(blind, MASKED),
    "plugin, policy.mask=none": lambda: from_outside(blind, MASKLESS),
    "plugin_privileged": lambda: from_outside(expert_policy, MASKED),
    **{
        name + ending: partial(untrained, name, MASKLESS if ending == WITHOUT_MASK else MASKED)
        for name, entry in REGISTRY.items()
        if not entry.trained and not entry.outside
        for ending in entry.access
    },
    "artflownet": lambda: trained("artflownet", MASKED),
    "artflownet, policy.mask=none": lambda: trained("artflownet", MASKLESS, part_mask_input=False),
    "flowbotpp": lambda: trained("flowbotpp", MASKED),
    "screwnet": lambda: trained("screwnet", MASKED),
    "ump_di": lambda: trained("ump_di", MASKED),
    "umpnet": lambda: trained("umpnet", MASKED),
    "bc, dagger": lambda: learned("none", False),
    "bc_flow, dagger_flow": lambda: learned("ground_truth", False),
    "bc_oracle, dagger_oracle": lambda: learned("none", True),
    "bc_oracle_flow, dagger_oracle_flow": lambda: learned("ground_truth", True),
}


@pytest.mark.parametrize("name", ACCESS)
def test_a_policy_reads_what_is_declared(name: str) -> None:
    policy, access = POLICIES[name](), ACCESS[name]
    assert {key for key in policy.in_keys if key[0] == "privileged"} == set(access.truth)
    assert (MASK in policy.in_keys) == access.mask
    assert mask_of(policy) == ("target" if access.mask else "" if name == "random" else "none")


def test_no_policy_is_missing_and_the_documents_say_the_same() -> None:
    assert set(POLICIES) == set(ACCESS)
    assert truths_table() in (ROOT / "docs" / "protocols.md").read_text()


def test_without_a_mask_the_network_s_module_reads_none_either() -> None:
    assert MASK not in artflownet_module(ArtFlowNet(False, 8)).in_keys
    assert MASK in artflownet_module(ArtFlowNet(True, 8)).in_keys


@pytest.mark.parametrize("learn", [True, False])
def test_a_network_whose_mask_is_optional_acts_without_one(learn: bool) -> None:
    net = ArtFlowNet(True, 8, mask_optional=True)
    without, given = (
        artflownet_policy(net, LIMITS, FlowPolicyOptions(mask=mask, learn=learn)) for mask in ("none", "target")
    )
    assert MASK not in without.in_keys and MASK in given.in_keys


@pytest.mark.parametrize("name", KINDS)
def test_a_network_that_needs_the_mask_says_so(name: str) -> None:
    with pytest.raises(UserError, match=r"policy\.mask=target"):
        trained(name, MASKLESS)
    with pytest.raises(UserError, match=r"policy\.mask=target"):
        untrained("normal", MASKLESS)


@pytest.mark.parametrize("name", REGISTRY)
def test_an_entry_is_complete(name: str) -> None:
    entry = REGISTRY[name]
    assert (ROOT / "conf" / "policy" / f"{name}.yaml").is_file()
    assert (ROOT / "conf" / "algo" / f"{name}.yaml").is_file() == entry.trained
    assert bool(entry.act) != entry.trained == bool(entry.options)
    assert entry.access
    if entry.trained:
        algorithm = behind(entry.algorithm)
        assert callable(algorithm.train) and callable(algorithm.load)
        assert issubclass(behind(entry.options), AlgoOptions)
    else:
        assert callable(behind(entry.act))


def test_files_of_policies_and_algorithms_are_of_entries() -> None:
    """A file that names something else would compose and then be refused."""
    assert {path.stem for path in (ROOT / "conf" / "policy").glob("*.yaml")} == set(REGISTRY)
