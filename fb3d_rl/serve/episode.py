"""One client: its policy, and what that carries from one request to the next."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from fb3d_rl import __version__
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import apply
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.perception.arrays import draw
from fb3d_rl.perception.foreground import HEIGHT, outliers
from fb3d_rl.policies.flow_policy import MASK
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, hand_velocities
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.policies.policy import initial_state
from fb3d_rl.predict.plan import Plan, enlarging, plan
from fb3d_rl.predict.results import described
from fb3d_rl.predict.setting import Array, numbers
from fb3d_rl.serve.request import Cloud, cloud_of, number, pose_of, require_known, tool_of


@dataclass(frozen=True)
class Served:
    """What the server offers.

    Attributes:
        name: the policy's name.
        checkpoint: where its weights are from, "" if it has none.
        policy: makes the policy; each client has its own.
        network: makes the plans, and is a part of the policy, on any device; None for a policy without an ArtFlowNet,
            which makes none.
        limits: what an action means, and how long it lasts.
        options: of the flow policy, which the plans follow, too.
        points: of the clouds that the policy sees.
    """

    name: str
    checkpoint: str
    policy: Callable[[], TensorDictModuleBase]
    network: ArtFlowNet | None
    limits: VelocityLimits
    options: FlowPolicyOptions
    points: int

    def metadata(self) -> dict[str, Any]:
        """The first message to each client."""
        return {
            "server": "fb3d_rl",
            "version": __version__,
            "policy": self.name,
            "checkpoint": self.checkpoint,
            "reads": self.read(),
            "plans": self.network is not None,
            "points": self.points,
            "action": "x y z * linear, roll pitch yaw * angular, two fingers; in [-1, 1], in the world frame",
            "twist": "of the suction tip in the cloud's frame: m/s and rad/s, the spin about the tool axis left out",
            "linear": self.limits.linear,
            "angular": self.limits.angular,
            "control_freq": 1.0 / self.limits.period,
        }

    def read(self) -> list[str]:
        """The entries of the observation that the policy reads.

        Raises:
            UserError: it reads the truth, which nobody knows of an object in front of a robot.
        """
        keys = [(key,) if isinstance(key, str) else tuple(key) for key in self.policy().in_keys]
        truths = sorted(".".join(key) for key in keys if key[0] == "privileged")
        if truths:
            raise UserError(f"policy={self.name} reads {', '.join(truths)}, which no robot knows: serve another policy")
        return sorted(key[1] for key in keys if key[0] == "observation")


@dataclass
class Memory:
    """What is known from the earlier requests of an episode.

    Attributes:
        policy: what the policy carries from step to step.
        steps: control steps made.
        pose: T_world_cloud [4, 4].
        bare: whether the client gave it, so that its points are no more than the object.
        camera: [3] where it stood, in the cloud's frame.
        scale: by which the network sees the object enlarged.
        qpos: [8] of the last step.
    """

    policy: TensorDictBase
    steps: int = 0
    pose: Array | None = None
    bare: bool = False
    camera: Array | None = None
    scale: float = 1.0
    qpos: Tensor | None = None


class Episode:
    """The requests of one client, each answered after the one before.

    Args:
        served: the policy.
    """

    def __init__(self, served: Served) -> None:
        self._served, self._policy = served, served.policy()
        self._memory = self._new()

    def _new(self) -> Memory:
        return Memory(initial_state(self._policy, torch.Size([1])))

    @torch.no_grad()
    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to a request (:data:`~fb3d_rl.serve.request.KEYS`).

        Returns:
            Of a request that says where the tool is "actions" [1, 8] and "twist" [1, 6]; a "plan" if it asks for one,
            says nothing of the tool, or T_world_cloud is yet to be found; "T_world_cloud" [4, 4] as lists, "remarks",
            and "server_timing".

        Raises:
            UserError: the request is none that can be answered; the episode is as it was before.
        """
        began = time.perf_counter()
        require_known(request)
        memory = self._new() if number(request, "reset") else replace(self._memory)
        cloud, given = cloud_of(request), pose_of(request)
        if given is not None:
            memory.pose, memory.bare = given, True
        acts = request.get("tool_pose") is not None or request.get("qpos") is not None
        answer: dict[str, Any] = {}
        remarks: list[str] = []
        if number(request, "plan") or not acts or memory.pose is None:
            made = self._plan(request, cloud)
            answer["plan"] = described(made) | ({"flow": made.flow} if number(request, "flow") else {})
            remarks += made.remarks
            memory.camera = made.camera
            memory.pose = made.T_world_cloud if memory.pose is None else memory.pose
        assert memory.pose is not None
        memory.camera = memory.camera if cloud.camera is None else cloud.camera
        tool = tool_of(request, memory.pose)
        if tool is not None:
            if MASK in self._policy.in_keys and cloud.mask is None:
                remarks.append("there is no mask: the whole cloud counts as the part to open")
            answer |= self._act(self._frame(request, cloud, memory, tool), memory)
        self._memory = memory
        answer |= {"T_world_cloud": memory.pose.tolist(), "remarks": remarks}
        answer["server_timing"] = {"infer_ms": 1000 * (time.perf_counter() - began)}
        return answer

    def _plan(self, request: Mapping[str, Any], cloud: Cloud) -> Plan:
        served = self._served
        if served.network is None:
            raise UserError(f"policy={served.name} makes no plans: send T_world_cloud, and tool_pose or qpos")
        return plan(
            cloud.points,
            cloud.mask,
            cloud.camera,
            model=served.network,
            tool_pose=request.get("tool_pose"),
            options=served.options,
            **cloud.planning,
        )

    def _frame(
        self, request: Mapping[str, Any], cloud: Cloud, memory: Memory, tool: tuple[Tensor, Tensor]
    ) -> TensorDictBase:
        """What the policy sees [1], by the contract's keys."""
        pose, camera = memory.pose, memory.camera
        assert pose is not None
        if camera is None:
            raise UserError("Nobody says where the camera stood: send camera, [3] in the cloud's frame.")
        world = apply(torch.from_numpy(pose), torch.from_numpy(cloud.points).double())
        inside = cloud.measured
        if not memory.bare and cloud.planning.get("foreground", True):
            inside = _foreground(world, inside)
        rows = inside.nonzero().flatten()
        if len(rows) < 3:
            raise UserError("Nothing of the cloud is above its support: check T_world_cloud, or send reset=true.")
        if not memory.steps:
            memory.scale = enlarging(world[rows].numpy())
        count = self._served.points
        rows = rows[draw(len(rows), count)]
        points, valid = torch.zeros(count, 3), torch.arange(count) < len(rows)
        points[: len(rows)] = world[rows].float()
        part = valid.clone()
        if cloud.mask is not None:
            part[: len(rows)] = cloud.mask[rows]
        qpos, tip = tool
        before, memory.qpos = memory.qpos, qpos
        if request.get("qvel") is not None:
            qvel = numbers(request["qvel"], (8,), "qvel")
        else:
            qvel = (qpos - (qpos if before is None else before)) / self._served.limits.period
        observation = {
            "points": points,
            "valid": valid,
            "part_mask": part,
            "qpos": qpos.float(),
            "qvel": qvel.float(),
            "tool_pose": tip.float(),
            "attached": torch.tensor([bool(number(request, "attached"))]),
            "contact_force": torch.tensor([number(request, "force")]),
            "camera_position": apply(torch.from_numpy(pose), torch.from_numpy(camera)[None])[0].float(),
            "goal_sense": torch.tensor([number(request, "goal_sense", 1.0)]),
        }
        trial = {"elapsed_steps": torch.tensor([memory.steps]), "seed": torch.tensor([0])}
        return TensorDict({"observation": observation, **trial}, batch_size=[])[None]

    def _act(self, frame: TensorDictBase, memory: Memory) -> dict[str, Any]:
        """The action, and the same as a twist of the tip; the policy's state goes on."""
        assert memory.pose is not None
        frame.update(memory.policy)
        frame = self._decided(frame, memory.scale)
        action = frame["action"].float().clamp(-1.0, 1.0)
        if tuple(action.shape) != (1, ACTION_DIM) or not bool(action.isfinite().all()):
            raise UserError(f"policy={self._served.name} gave {list(action.shape)} that is no action: [1, 8], finite")
        memory.policy = memory.policy.copy()
        if "next" in frame.keys():
            memory.policy.update(frame["next"])
        memory.steps += 1
        limits, obs = self._served.limits, frame["observation"]
        top = torch.tensor([limits.linear] * 3 + [limits.angular] * 3 + [0.0] * 2)
        turn = torch.from_numpy(memory.pose[:3, :3]).float()
        twist = [way @ turn for way in hand_velocities(obs, hand_axis(obs["tool_pose"]), action * top)]
        return {"actions": action.numpy(), "twist": torch.cat(twist, dim=-1).numpy()}

    def _decided(self, frame: TensorDictBase, scale: float) -> TensorDictBase:
        """The frame with the policy's action; its network sees a small or large object of the size that it knows."""
        policy, network = self._policy, self._served.network
        device = torch.device("cpu") if network is None else next(network.parameters()).device
        if network is None or (scale == 1 and device.type == "cpu"):
            decided: TensorDictBase = policy(frame)
            return decided
        assert isinstance(policy, TensorDictSequential)  # the network, and the flow policy
        look, act = policy.module
        seen = frame.select("observation").copy()
        seen["observation", "points"] = seen["observation", "points"] * scale
        frame["prediction"] = look(seen.to(device))["prediction"].to("cpu")
        decided = act(frame)
        return decided


def _foreground(world: Tensor, measured: Tensor) -> Tensor:
    """Which points [N] are on the object: above its support, and not far sparser than the rest."""
    inside = (measured & (world[:, 2] > HEIGHT)).numpy()
    inside[inside] = ~outliers(world[torch.from_numpy(inside)].numpy())
    return torch.from_numpy(inside)
