"""An interactive view of one object: its joints, the camera's cloud, the flow, the contact point, and a trial.

It does not depend on the page; the simulator is loaded when a trial begins.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import TIP
from fb3d_rl.camera.views import View
from fb3d_rl.data.samples import SampleOptions, flow_sample
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import TrialEnv, make_env, require_simulator
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.flow import predict
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.live.moment import FLOWS, Contact, Moment, Progress
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.contact import Contact as Touch
from fb3d_rl.policies.contact import choose_contact
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions
from fb3d_rl.policies.flow_state import APPROACH, PHASES, PULL, SELECT, TRAVEL
from fb3d_rl.policies.hand import hand_axis
from fb3d_rl.policies.interaction import InteractivePolicy
from fb3d_rl.rollout.run import limits_of, policy_env, state_of
from fb3d_rl.rollout.trials import schedule
from fb3d_rl.scene.observer import observe
from fb3d_rl.scene.posed import Posed

if TYPE_CHECKING:
    from fb3d_rl.env.task import OpenArticulatedEnv

PICK = 0.02
"""A click picks the foremost of the points that are at most this much (m) farther from its ray than the nearest one."""


class Session:
    """An object, the part to open, a joint state, a view, and a trial of the policy if one runs.

    It begins with the trial that an evaluation of the same seed runs with the object's first part. A person's change
    ends a running trial; the joints stay where they are.

    Args:
        obj: the object.
        samples: points of a cloud, views and camera.
        env: the task's constants.
        policy: speeds and thresholds of the flow policy.
        net: predicts the flow; without one there is the true flow only.
        flow: which of :data:`FLOWS` the policy is given; the predicted one if there is a network, unless given.
        device: where the network computes.
        seed: of views and clouds.

    Raises:
        UserError: the object has no part that opens, or the policy needs a network and there is none.
    """

    def __init__(
        self,
        obj: ArticulatedObject,
        samples: SampleOptions,
        env: EnvOptions,
        policy: FlowPolicyOptions,
        net: ArtFlowNet | None = None,
        flow: str | None = None,
        device: torch.device | None = None,
        seed: int = 0,
    ) -> None:
        self.obj = obj
        self.flows = [name for name in FLOWS if name == "true" or net is not None]
        self._object = Posed(obj, samples.camera)
        self._env_options, self._policy_options = env, policy
        self._net, self._device = net, device or torch.device("cpu")
        self._env: EnvBase | None = None
        self._base: TrialEnv | None = None
        self._points = samples.points
        self._by = ""
        first = default_trial(obj)  # raises if nothing opens
        self._trials = {item.trial.link: item.trial for item in schedule([(obj, "")], samples, seed)[0]}
        self.parts = self._object.openable
        """Links that open."""
        self.set_flow(flow or self.flows[-1])
        self.set_part(next(iter(self._trials), first.link))

    # ------------------------------------------------------------------------------------------- what a person sets

    def set_flow(self, name: str) -> None:
        """Let the policy act on the flow of this name.

        Raises:
            UserError: there is no network to predict it.
        """
        if name not in self.flows:
            raise UserError(f"there is no {name} flow without a network; give its weights: checkpoint=PATH")
        self.flow = name
        self._policy = self._acting(FlowPolicy(FLOWS[name], limits_of(self._env_options), self._policy_options))
        self._picked: tuple[Touch, Touch] | None = None

    def _acting(self, flow_policy: FlowPolicy) -> FlowPolicy | InteractivePolicy:
        """The policy that acts; given the one that follows the flow."""
        return flow_policy

    def set_part(self, link: int) -> None:
        """Choose the part to open, with the joint state and the view that an evaluation would start from."""
        self._trial = self._trials.get(link) or default_trial(self.obj, link)
        self._observe()

    def set_joint(self, index: int, position: float) -> None:
        """Move joint ``index`` of the joint state [J] to a position, rad or m."""
        state = self.moment.qpos.copy()
        state[index] = np.clip(position, *self.limits[index])
        self._trial = replace(self._trial, start=tuple(state.tolist()))
        self._observe()

    def set_view(self, view: View) -> None:
        """Set the camera's view."""
        self._trial = replace(self._trial, view=view, start=tuple(self.moment.qpos.tolist()))
        self._observe()

    def reset(self) -> None:
        """Set everything back to the start of the trial."""
        self._observe()

    @property
    def link(self) -> int:
        """The part to open."""
        return self._trial.link

    @property
    def view(self) -> View:
        """The camera's viewpoint."""
        return self._trial.view

    @property
    def limits(self) -> NDArray[np.float64]:
        """Lowest and highest position of each joint [J, 2], rad or m; half a turn each way where it has no limits."""
        return np.where(np.isfinite(self.obj.limits), self.obj.limits, [-np.pi, np.pi])

    @property
    def centre(self) -> NDArray[np.float64]:
        """The point [3] (m) in the middle of the camera's image."""
        return self._object.camera.centre

    @property
    def size(self) -> float:
        """Diameter of the closed object's bounding sphere, m."""
        return 2 * self._object.camera.radius

    @property
    def field_of_view(self) -> float:
        """The camera's, rad."""
        return math.radians(self._object.camera.options.fov)

    @property
    def period(self) -> float:
        """Time (s) of a control step."""
        return 1.0 / self._env_options.control_freq

    def pick(self, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> None:
        """Let the policy touch the point of the part that a ray hits, instead of its own choice.

        Args:
            origin: start of the ray [3], m.
            direction: direction of the ray [3].

        Raises:
            UserError: the part is not seen, does not move there, is held already, or the trial is over.
        """
        if self.trial is not None and (self.trial.attached or self.trial.done):
            raise UserError("the hand is past the choice of a contact point; press reset to choose another")
        obs, flow = self._frame["observation"], self._frame[FLOWS[self.flow]]
        on_part = self._shown()[0].nonzero().flatten()
        if not len(on_part):
            raise UserError("the camera sees nothing of the part; turn it until it does")
        way = obs["points"][0, on_part].double() - torch.as_tensor(origin)
        ray = torch.as_tensor(direction)
        along = way @ (ray / ray.norm())
        aside = (way.square().sum(-1) - along.square()).clamp_min(0).sqrt()
        row = int(on_part[torch.where(aside <= aside.min() + PICK, along, torch.inf).argmin()])
        norm = flow[0].norm(dim=-1)
        others = torch.ones_like(obs["valid"])
        others[0, row] = False
        picked = self._choose(others)
        if not torch.equal(picked[0].point[0], obs["points"][0, row]):
            raise UserError(
                f"the {self.flow} flow there is {float(norm[row]):.2f}, too little to pull along; "
                "pick a point that moves"
            )
        self._picked = picked
        if self.trial is not None:
            FlowPolicy.go_to(self._frame, *picked)
        self.moment = self._moment()

    # ------------------------------------------------------------------------------------------------- what is seen

    def _observe(self) -> None:
        """Observe the object at the start of the trial, without the simulator."""
        trial, posed = self._trial, self._object
        poses = posed.poses(trial.start)
        cloud = observe(posed, poses, trial.view, self._points, trial.cloud_rng())
        frame = flow_sample(cloud, trial.link)[None]
        tip = self._env_options.gripper.start(posed.bounds(trial.start)) + [TIP, 0, 0]
        frame["observation", "tool_pose"] = torch.tensor([[*tip, 1, 0, 0, 0]], dtype=torch.float32)
        camera = posed.camera.pose(trial.view)[:3, 3]
        frame["observation", "camera_position"] = torch.tensor(camera[None], dtype=torch.float32)
        self.trial: Progress | None = None
        self._by = ""
        self._picked = None
        self._frame = self._predicted(frame)
        self._poses, self._qpos = poses, np.array(trial.start)
        self.moment = self._moment()

    def _predicted(self, frame: TensorDictBase) -> TensorDictBase:
        if self._net is not None:
            frame["prediction", "flow"] = predict(self._net, frame, self._device)
        return frame

    def _moment(self) -> Moment:
        frame = self._frame
        valid = frame["observation", "valid"]
        flows = {name: frame[FLOWS[name]] for name in self.flows}
        metrics = {}
        if "predicted" in flows:
            measured = flow_metrics(flows["predicted"], flows["true"], valid)
            metrics = {key: float(value) for key, value in measured.items() if bool(value.isfinite())}
        return Moment(
            poses=self._poses,
            qpos=self._qpos,
            tip=frame["observation", "tool_pose"][0].numpy(),
            camera=self._object.camera.pose(self.view),
            points=frame["observation", "points"][valid].numpy(),
            part=frame["observation", "part_mask"][valid].numpy(),
            flows={name: flow[valid].numpy() for name, flow in flows.items()},
            metrics=metrics,
            contact=self._contact(),
            trial=self.trial,
        )

    def _contact(self) -> Contact | None:
        """The policy's contact, or the one that it would choose now."""
        phase = SELECT if self.trial is None else PHASES.index(self.trial.phase)
        if phase == SELECT:
            touch = (self._picked or self._choose())[0]
            point, pull, standoff = touch.point, touch.flow, touch.standoff
        elif phase in (TRAVEL, APPROACH, PULL):
            point, pull, standoff = (self._frame["policy", key] for key in ("contact_point", "pull", "standoff"))
            if phase == PULL:
                point = self._frame["observation", "tool_pose"][:, :3]
        else:
            return None
        return Contact(point[0].numpy(), pull[0].numpy(), standoff[0].numpy()) if bool(pull.any()) else None

    def _shown(self) -> Tensor:
        """The points [1, N] that the policy may touch: those of the part, or all if the policy gets no mask."""
        obs = self._frame["observation"]
        return obs["valid"] if self._policy_options.mask == "none" else obs["valid"] & obs["part_mask"]

    def _choose(self, avoid: Tensor | None = None) -> tuple[Touch, Touch]:
        """The policy's contact candidates; with ``avoid`` those at the points that are not avoided."""
        obs, options = self._frame["observation"], self._policy_options.contact
        shown = self._shown()
        flow = torch.where(shown[..., None], self._frame[FLOWS[self.flow]], 0.0)
        if avoid is None:
            avoid = torch.zeros_like(shown)
        else:  # a person may want a point that the heuristic does not consider
            options = replace(options, min_flow=0.0, weak_flow=0.0)
        pose = obs["tool_pose"]
        return choose_contact(
            obs["points"],
            obs["valid"],
            None if self._policy_options.mask == "none" else shown,
            flow,
            obs["camera_position"],
            pose[:, :3],
            hand_axis(pose),
            avoid,
            options,
        )

    # ------------------------------------------------------------------------------------------------------ a trial

    @torch.no_grad()
    def step(self) -> None:
        """Make one control step; the first one of a trial begins it. After its last one nothing happens.

        Raises:
            UserError: the simulator cannot be loaded, or the part is fully open already.
        """
        if self.trial is None:
            self._begin()
        elif self.trial.done:
            return
        assert self._env is not None
        frame = self._env.step(self._policy(self._frame))
        self._made(frame)
        over = bool(frame["next", "done"])
        self._seen(step_mdp(frame), over)

    def _made(self, frame: TensorDictBase) -> None:
        """Take note of a step [1], with what came after it below "next"."""

    def _begin(self) -> None:
        require_simulator("use the page without running trials")
        if self._base is None or self._env is None:
            self._base = make_env([self.obj], self._env_options)
            self._env = policy_env(self._base, state_of(self._policy))
        self._base.set_trials([self._trial])
        frame = self._env.reset()
        if self._picked is not None:
            FlowPolicy.go_to(frame, *self._picked)
        self._seen(frame, False)

    def _seen(self, frame: TensorDictBase, over: bool) -> None:
        """Store the trial's new state."""
        assert self._base is not None
        task = cast("OpenArticulatedEnv", self._base.env)
        self._frame = self._predicted(frame)
        self._poses = task.stages[0].poses()
        positions = task.joint_positions()[0, : len(self.obj.movable)].double().numpy()
        self._qpos = np.clip(positions, *self.limits.T)  # the solver has slack
        self.trial = Progress(
            steps=int(frame["elapsed_steps"]),
            phase=PHASES[int(frame["policy", "phase"])],
            distance=float(frame["normalized_distance"]),
            attached=bool(frame["observation", "attached"]),
            success=bool(frame["success"]),
            done=over,
            by=self._by,
        )
        self.moment = self._moment()

    @property
    def loaded(self) -> bool:
        """Whether the simulator is loaded."""
        return self._base is not None

    def close(self) -> None:
        """Free the simulator."""
        if self._env is not None:
            self._env.close(raise_if_closed=False)
            self._env = self._base = None
