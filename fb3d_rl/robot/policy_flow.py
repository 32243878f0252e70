"""What an attempt asks for the flow: the policies of the floating gripper, for what they see in the robot's cell.

They know objects that stand at the world's origin, face -x and span about two metres. So the cloud of an attempt is
moved, turned about the vertical and enlarged before they see it: as it is first seen, and the same way until the next
attempt, since a part that opens would make the object look larger and turned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import matrix_to_quaternion
from fb3d_rl.models.artflownet import POINTS, ArtFlowNet, Hypotheses, artflownet_module
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.interaction import InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import Learner
from fb3d_rl.policies.policy import initial_state
from fb3d_rl.predict.plan import enlarging
from fb3d_rl.predict.setting import Setting
from fb3d_rl.robot.attempt import Observation, Predictor, Puller
from fb3d_rl.robot.seeing import smoothed
from fb3d_rl.rollout.run import mask_of
from fb3d_rl.rollout.worker import steady_floats

Array = NDArray[np.float64]

Truth: TypeAlias = Callable[[NDArray[Any]], Array]
"""The true flow [N, 3] of points [N, 3] of the part to open, 0 on all else; of a simulated cell."""

DRAWS = 4
"""A contact is chosen by the flow that agrees best with those of other points of the same cloud: where an object can be
taken for two kinds of things, it depends on the points which one a network finds more probable."""

NEIGHBORS = 8
"""A point's flow is the median of those of so many points nearest to it: single points that a camera misplaced may have
any flow, also the largest."""

FLOW = ("prediction", "flow")
FLOWS = ("prediction", "flows")
LOG_PROBABILITIES = ("prediction", "log_probabilities")
TRUE_FLOW = ("privileged", "flow")

MOVES = 0.1
"""A point with less than this share of the largest flow stands still."""

LARGE = 0.5
"""A contact is where a flow has more than this share of its largest."""

SAME = 0.7
"""Cosine above which two directions are the same."""


@dataclass(frozen=True, eq=False)
class Frame:
    """How an object is shown to a policy: scale * turn @ (point - base).

    Attributes:
        turn: [3, 3] about z.
        base: [3] m, below the object's middle, at the table's height.
        scale: by which it is enlarged.
    """

    turn: Array
    base: Array
    scale: float

    @classmethod
    def of(cls, seen: Observation) -> Frame:
        """The one in which the side of the object that the camera sees best faces -x, and that it has the size that the
        policies know.
        """
        points = seen.points.astype(np.float64)
        away = 0.5 * (points.min(0) + points.max(0)) - seen.camera
        bearing = Rotation.from_euler("z", -math.atan2(away[1], away[0])).as_matrix()  # the camera looks along +x
        scene = Setting.of(points @ bearing.T, bearing @ seen.camera, "z", "auto", 0.0, seen.table, False, math.inf)
        middle = 0.5 * (scene.points.min(0) + scene.points.max(0)) * (1.0, 1.0, 0.0)
        turn = scene.turn @ bearing
        return cls(turn, bearing.T @ scene.base + middle @ turn, enlarging(scene.points))

    def shown(self, points: NDArray[Any]) -> Tensor:
        """Points [..., 3] as the policy sees them, float32."""
        return torch.as_tensor(self.scale * (points - self.base) @ self.turn.T, dtype=torch.float32)


class PolicyFlow:
    """The flow on which a policy of the floating gripper acts, as a :data:`~fb3d_rl.robot.attempt.Predictor`.

    Args:
        look: reads the contract's observation and writes ("prediction", "flow"); None for the true flow.
        truth: of the cell, for what is given of it: the mask of the part to open, the true flow; nothing unless given.
        masked: whether the flow counts on the part to open only.
        state: what ``look`` reads besides, [1].
    """

    def __init__(
        self,
        look: TensorDictModuleBase | None,
        truth: Truth = np.zeros_like,
        masked: bool = False,
        state: TensorDictBase | None = None,
    ) -> None:
        self._look, self._truth, self._masked = look, truth, masked
        self._state = TensorDict({}, [1]) if state is None else state
        self._frame: Frame | None = None
        self._refuted: list[tuple[Array, Array]] = []

    def refute(self, at: Array, way: Array) -> None:
        """See :class:`~fb3d_rl.robot.attempt.Learns`: of several answers the next one is given that does not say so."""
        self._refuted.append((at, way))

    @classmethod
    def of_policy(cls, policy: TensorDictModuleBase, truth: Truth) -> PolicyFlow:
        """Of modules that write ("prediction", "flow"), then a flow policy; or of that alone, with the true flow.

        Raises:
            UserError: the policy acts on no flow.
        """
        if isinstance(policy, FlowPolicy) and policy.flow_key == TRUE_FLOW:
            return cls(None, truth)
        if isinstance(policy, TensorDictSequential):
            look = TensorDictSequential(*policy.module[:-1])  # the last one moves the gripper
            if FLOW in look.out_keys:
                return cls(look, truth, mask_of(policy) == "target", initial_state(policy, torch.Size([1])))
        raise UserError(
            "the robot's trials are for policies of a flow, and for learners with algo.oracle=true: choose one"
        )

    @classmethod
    def of_network(cls, net: ArtFlowNet) -> PolicyFlow:
        """Of a network that gets no mask: nobody tells a real robot which part to open."""
        return cls(artflownet_module(net, proposals=True, masked=False))

    def __call__(self, seen: Observation) -> NDArray[Any]:
        """Flow [N, 3] in the robot's base."""
        if self._look is None:
            return self._truth(seen.points)
        if self._frame is None or not seen.holding:
            self._frame = Frame.of(seen)
        draws = [self._flow(seen, few) for few in thinned(seen, 1 if seen.holding else DRAWS)]
        units = [flow / max(float(np.linalg.norm(flow)), 1e-9) for flow in draws]
        agreement = [sum(float((one * other).sum()) for other in units) for one in units]
        return draws[int(np.argmax(agreement))]

    def _flow(self, seen: Observation, few: Observation) -> Array:
        """Flow [N, 3] of all points that are seen, in the robot's base, from what the policy says of a few."""
        assert self._look is not None and self._frame is not None
        data = observed(few, self._frame, self._truth(few.points)).update(self._state)
        with steady_floats(), torch.no_grad():
            self._look(data)
        flow = self._answer(data, few)
        if self._masked:
            flow = flow * data["observation", "part_mask"][0, :, None]
        nearby = _nearest(few.points, seen.points, NEIGHBORS)
        return np.asarray(np.median(flow.double().numpy()[nearby], axis=1) @ self._frame.turn)

    def _answer(self, data: TensorDict, few: Observation) -> Tensor:
        """The flow [N, 3] that is given: of several that no pull refutes the most probable one for all that may move. A
        cloud of which each point has its own most probable one shows a lid and a door at once.
        """
        if FLOWS not in data.keys(include_nested=True):
            return data[FLOW][0]
        found = Hypotheses(data[FLOWS], data[LOG_PROBABILITIES])
        about = (found.flows.norm(dim=3) > MOVES).any(1)
        if self._masked:
            about &= data["observation", "part_mask"]
        order = found.of_clouds(about)[0].argsort(descending=True, stable=True).tolist()
        left = [k for k in order if not self._is_refuted(found.flows[0, k], few)]
        return found.flows[0, left[0] if left else order[0]]

    def _is_refuted(self, flow: Tensor, few: Observation) -> bool:
        """Whether a flow [N, 3] says what a pull has shown to be wrong."""
        assert self._frame is not None
        in_base, most = flow.double().numpy() @ self._frame.turn, float(flow.norm(dim=1).max())
        for at, way in self._refuted:
            said = np.median(in_base[_nearest(few.points, at[None], NEIGHBORS)[0]], axis=0)
            size = float(np.linalg.norm(said))
            if size > LARGE * most and said @ way > SAME * size:
                return True
        return False


def thinned(seen: Observation, draws: int = 1) -> list[Observation]:
    """As many points as policies know, of the smoothed ones, which are in random order: up to so many times others."""
    points = smoothed(seen.points)
    starts = range(0, max(1, min(draws * POINTS, len(points) - POINTS + 1)), POINTS)
    return [replace(seen, points=points[start : start + POINTS]) for start in starts]


def _nearest(points: NDArray[Any], at: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Places [M, count] of the points [N, 3] nearest to others [M, 3]."""
    found = cKDTree(points).query(at, range(1, min(count, len(points)) + 1))[1]
    return np.asarray(found, dtype=np.int64)


class LearnerPull:
    """A learner that moves the held part, as a :data:`~fb3d_rl.robot.attempt.Puller`.

    It gets the cloud, the mask of the part, the hand, the force and that it holds, as in its own task: with a gripper
    whose frame is in the tip, so that joint velocities are the tip's. Of the hand's velocity the robot tells what was
    commanded last. Its answer, a share of the gripper's limits, becomes one of the speed of a pull.

    Args:
        learner: the policy.
        truth: of the cell, for the mask.
        speed: of a pull, m/s.
    """

    def __init__(self, learner: Learner, truth: Truth, speed: float) -> None:
        self._learner, self._truth, self._speed = learner, truth, speed
        self._frame: Frame | None = None
        self._joints = torch.zeros(1, 8)
        self._state = initial_state(learner, torch.Size([1]))

    def see(self, seen: Observation) -> NDArray[Any]:
        """The true flow, by which the expert drives to the contact (supplement, III); it begins an attempt."""
        self._frame = Frame.of(seen)
        return self._truth(seen.points)

    def __call__(self, seen: Observation) -> Array:
        """The tip's velocity (m/s) and angular velocity (rad/s) [6] in the base."""
        frame = self._frame = self._frame or Frame.of(seen)
        (seen,) = thinned(seen)
        data = observed(seen, frame, self._truth(seen.points)).update(self._state)
        place = data["observation", "tool_pose"][:, :3]
        data["observation", "qpos"] = torch.cat([place, torch.zeros(1, 5)], -1)
        data["observation", "qvel"] = self._joints
        with steady_floats(), torch.no_grad():
            self._learner(data)
        self._state = data.get("next", TensorDict({}, [1])).exclude("observation")
        limits = self._learner.limits
        action = data["action"]
        self._joints = action * torch.tensor([limits.linear] * 3 + [limits.angular] * 3 + [0.0] * 2)
        share = action[0].double().numpy()
        turn = frame.turn.T
        # The same path at the robot's speed: an angle for each metre of it, and the robot's metres are larger.
        rate = limits.angular / limits.linear * frame.scale * self._speed
        return np.concatenate([self._speed * turn @ share[:3], rate * turn @ share[3:6]])


def asking(policy: TensorDictModuleBase, truth: Truth, speed: float) -> tuple[Predictor, Puller | None]:
    """What an attempt asks of a policy: for the flow, and, of a learner whose contact the expert chooses, in a pull.

    Raises:
        UserError: the policy is none of a flow, and no such learner.
    """
    if isinstance(policy, InteractivePolicy) and isinstance(policy.gate, OracleGate):
        if isinstance(policy.learner, Learner):
            pull = LearnerPull(policy.learner, truth, speed)
            return pull.see, pull
    return PolicyFlow.of_policy(policy, truth), None


def observed(seen: Observation, frame: Frame, flow: Array) -> TensorDict:
    """What is seen, as the contract's observation [1] in the policies' world; its true flow [N, 3] in the base.

    A suction tip of the floating gripper points along +x of its tool, the robot's along +z of its tip.
    """
    turn = torch.from_numpy(frame.turn @ seen.tip[:3, :3] @ _TOOL)
    tip = torch.cat([frame.shown(seen.tip[:3, 3]).double(), matrix_to_quaternion(turn)])
    force = float(np.linalg.norm(seen.force))
    observation = {
        "points": frame.shown(seen.points),
        "valid": torch.ones(len(seen.points), dtype=torch.bool),
        "part_mask": torch.from_numpy((flow != 0).any(1)),
        "camera_position": frame.shown(seen.camera),
        "tool_pose": tip.float(),
        "attached": torch.tensor([seen.holding]),
        "contact_force": torch.tensor([force]),
        "goal_sense": torch.ones(1),
    }
    content = {"observation": observation, "privileged": {"flow": torch.from_numpy(flow @ frame.turn.T).float()}}
    return TensorDict(content, batch_size=[]).unsqueeze(0)


_TOOL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T
"""R_tip_tool: the tool's x axis is the tip's z axis."""
