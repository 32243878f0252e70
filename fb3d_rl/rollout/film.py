"""Run one trial again and record what is needed to draw it; episodes repeat bit for bit, so it is the same episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.views import View
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.rollout.run import policy_env, state_of
from fb3d_rl.rollout.worker import steady_floats

if TYPE_CHECKING:
    from fb3d_rl.env.task import OpenArticulatedEnv


@dataclass(frozen=True, eq=False)
class Film:
    """One episode of T control steps: T + 1 moments.

    Attributes:
        policy: name of the policy.
        obj: the object.
        link: index of the link to open.
        view: position of the policy's camera.
        gripper: meshes of hand, left and right finger, each in its own frame.
        poses: T_world_body [T + 1, L + 3, 4, 4] of the object's links, then of hand, left and right finger.
        tips: where the suction tip is [T + 1, 3], m.
        points: the observed cloud [T + 1, N, 3], m.
        part: [T + 1, N], whether a point lies on the part to open.
        flow: [T + 1, N, 3], the flow that the policy predicted, or the true one for a policy that predicts none.
        attached: [T + 1], whether suction holds a part.
        distance: normalized distance [T + 1].
        success: whether the part was open at the end.
        rate: control steps per second.
        expert_acts: [T], whether the expert acted in a step, of an episode that it shared with a learner; else None.
        per_step: moments of a step.
        aim: what ``opened`` is a share of, for captions ("40 % opened"), and the name of a success.
    """

    policy: str
    obj: ArticulatedObject
    link: int
    view: View
    gripper: Sequence[Sequence[Mesh]]
    poses: NDArray[np.float64]
    tips: NDArray[np.float32]
    points: NDArray[np.float32]
    part: NDArray[np.bool_]
    flow: NDArray[np.float32]
    attached: NDArray[np.bool_]
    distance: NDArray[np.float32]
    success: bool
    rate: int
    expert_acts: NDArray[np.bool_] | None = None
    per_step: int = 1
    aim: tuple[str, str] = ("opened", "opened")

    def __len__(self) -> int:
        return len(self.poses)

    def moment(self, t: int) -> str:
        """What moment ``t`` is called."""
        return f"step {t // self.per_step}"

    @property
    def opened(self) -> NDArray[np.float32]:
        """How far the part is open [T + 1]: 0 at the start, 1 at the joint's limit."""
        return np.clip(1.0 - self.distance, 0.0, 1.0)


def record(name: str, policy: TensorDictModuleBase, obj: ArticulatedObject, trial: Trial, options: EnvOptions) -> Film:
    """Run ``trial`` with ``policy`` in this process and film it.

    Args:
        name: the policy's name.
        policy: see :func:`fb3d_rl.rollout.run.run_trials`.
        obj: the object that the trial names.
        trial: the trial.
        options: the task's constants.
    """
    base = make_env([obj], options, [trial])
    env, task = policy_env(base, state_of(policy)), cast("OpenArticulatedEnv", base.env)
    poses, frames = [], []
    try:
        # As in a worker, or the episode may end differently from its row.
        with steady_floats(), set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            frame, done = env.reset(), False
            while True:
                # The policy runs once more after the last step, for its prediction there.
                frame = policy(frame)
                poses.append(task.stages[0].poses())
                frames.append(frame[0].clone())
                if done:
                    break
                frame = env.step(frame)
                done = bool(frame["next", "done"])
                frame = step_mdp(frame)
        gripper = task.stages[0].model.bodies
    finally:
        env.close(raise_if_closed=False)
    predicted = ("prediction", "flow") in frames[0].keys(include_nested=True)
    flow = ("prediction", "flow") if predicted else ("privileged", "flow")
    kept: dict[str, NDArray[Any]] = {
        key: torch.stack([frame[where] for frame in frames]).cpu().numpy()
        for key, where in {
            "tool": ("observation", "tool_pose"),
            "points": ("observation", "points"),
            "part": ("observation", "part_mask"),
            "flow": flow,
            "attached": ("observation", "attached"),
            "distance": ("normalized_distance",),
        }.items()
    }
    return Film(
        policy=name,
        obj=obj,
        link=trial.link,
        view=trial.view,
        gripper=gripper,
        poses=np.stack(poses),
        tips=kept["tool"][:, :3],
        points=kept["points"],
        part=kept["part"],
        flow=kept["flow"],
        attached=kept["attached"][:, 0],
        distance=kept["distance"][:, 0],
        success=bool(frames[-1]["success"]),
        rate=options.control_freq,
    )
