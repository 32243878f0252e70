"""Baselines that learn nothing (FlowBot3D, section V): random actions, and pulling along the surface's normal."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.geometry.points import knn, pca_curvature
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import uniform
from fb3d_rl.policies.policy import Policy


class RandomPolicy(Policy):
    """Actions that are uniform in [-1, 1] and depend on the trial's seed and the step only: the lower bound.

    Shapes: reads the trial's "seed" and "elapsed_steps" [E, 1]; writes "action" [E, 8].
    """

    in_keys = ["seed", "elapsed_steps"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        draws = uniform(tensordict, purpose=2, count=ACTION_DIM)
        tensordict["action"] = (2 * draws - 1).to(tensordict.device, torch.float32)
        return tensordict


class NormalFlow(TensorDictModuleBase):
    """The outward normal of the part's visible surface in place of a flow.

    Normals are computed from neighbourhoods on the part (PCA) and turned towards the camera as in the paper.

    Args:
        neighbors: number of points of a neighbourhood.

    Shapes: reads the observation's points [E, N, 3], valid, part_mask [E, N] and camera_position [E, 3]; writes
    ("prediction", "flow") [E, N, 3], unit vectors on the part, 0 elsewhere.
    """

    def __init__(self, neighbors: int) -> None:
        super().__init__()
        self.neighbors = neighbors
        self.in_keys = [("observation", key) for key in ("points", "valid", "part_mask", "camera_position")]
        self.out_keys = [("prediction", "flow")]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the normals."""
        points, valid, part, camera = (tensordict[key] for key in self.in_keys)
        on_part = part & valid
        nearest = knn(points, points, self.neighbors, on_part)
        tensordict["prediction", "flow"] = pca_curvature(points, nearest, on_part, camera)[1]
        return tensordict


def random_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> RandomPolicy:
    """Random actions; limits and options are not used."""
    return RandomPolicy()


def normal_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> TensorDictSequential:
    """The flow policy fed with surface normals.

    The paper's "Normal Direction" is given the point of largest true flow; this one chooses its contact point as
    every flow policy does, so that it needs no ground truth.
    """
    options = options or FlowPolicyOptions()
    options.require_mask("policy=normal")
    return TensorDictSequential(
        NormalFlow(options.contact.neighbors), FlowPolicy(("prediction", "flow"), limits, options)
    )
