"""A policy's digest: the same for the same weights and options, another for any other."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import torch
from torch import nn

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.baselines import RandomPolicy, normal_policy
from fb3d_rl.policies.contact import ContactOptions
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions, artflownet_policy, expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import Learner, LearnerOptions

LIMITS = VelocityLimits(2.0, 3.0)
OPTIONS = FlowPolicyOptions()


def network(seed: int) -> ArtFlowNet:
    return ArtFlowNet(neighbors=16, generator=torch.Generator().manual_seed(seed)).eval()


def learner(seed: int) -> Learner:
    return Learner(LearnerOptions(points=32, width=16), LIMITS, torch.Generator().manual_seed(seed))


def test_whatever_makes_a_policy_act_otherwise_gives_another_digest() -> None:
    expert = expert_policy(LIMITS)
    nudged = network(0)
    with torch.no_grad():
        next(nudged.buffers()).add_(1e-6)
    policies: list[nn.Module] = [
        expert,
        expert_policy(VelocityLimits(2.0, 3.5)),
        expert_policy(LIMITS, replace(OPTIONS, force=21.0)),
        expert_policy(LIMITS, replace(OPTIONS, contact=ContactOptions(near=0.0))),
        FlowPolicy(("prediction", "flow"), LIMITS),
        artflownet_policy(network(0), LIMITS),
        artflownet_policy(network(1), LIMITS),
        artflownet_policy(nudged, LIMITS),
        artflownet_policy(network(0), LIMITS, replace(OPTIONS, force=21.0)),
        normal_policy(LIMITS),
        RandomPolicy(),
        learner(0),
        learner(1),
        InteractivePolicy(expert, learner(0), OracleGate()),
        InteractivePolicy(expert, learner(0), BetaGate()),
        InteractivePolicy(expert, learner(1), OracleGate()),
    ]
    digests = [policy_digest(policy) for policy in policies]
    assert len(set(digests)) == len(policies)


def test_the_same_policy_made_again_has_the_same_digest_in_any_process() -> None:
    policy = artflownet_policy(network(3), LIMITS)
    digest = policy_digest(policy)
    assert digest == policy_digest(artflownet_policy(network(3), LIMITS))
    policy.train()
    assert digest == policy_digest(policy)  # a mode of a moment is no option
    program = "from tests.policies.test_digest import *; print(policy_digest(artflownet_policy(network(3), LIMITS)))"
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert other.stdout.split() == [digest]
