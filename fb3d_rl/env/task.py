"""The ManiSkill task: open a part of an articulated object with the floating suction gripper."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import WrapperSpec
from gymnasium.wrappers import TimeLimit
from mani_skill.utils.registration import register
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.env.backends import choose_renderer, choose_simulator, require_mode
from fb3d_rl.env.gripper import FloatingSuctionGripper, checked_action
from fb3d_rl.env.observation import clouds, gripper_and_joint
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.env.progress import Progress
from fb3d_rl.env.source import TrialSource
from fb3d_rl.env.stage import Stage
from fb3d_rl.env.staged import StagedEnv
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import find_objects

TASK = "OpenArticulated-v1"
"""The task's name for ``gymnasium.make``."""


class OpenArticulatedEnv(StagedEnv):
    """Open one part of an articulated object.

    ``gymnasium.make("fb3d_rl.env.task:OpenArticulated-v1", objects="DIR", split="test")`` makes it for any user of
    ManiSkill; :func:`fb3d_rl.env.torchrl_env.make_env` makes it for TorchRL.

    **Task Description:**
    A floating suction gripper, commanded by eight velocities, opens the given part (a door, a drawer, a lid ...) of an
    object whose base is fixed. It sees the object as a cloud of points from one camera. Suction holds the part as
    soon as a finger touches it. Contact between gripper, object and ground is physical; the object's parts do not
    collide with each other. Static links collide as the surface of their meshes, moving ones as convex hulls.

    **Randomizations:**
    - the object, and which of its parts is to be opened (``link`` fixes the part)
    - how far that part is open at the start (``options.start``); the other parts are closed
    - the camera's azimuth and elevation (``options.views``), such that the part can be seen
    - which of the depth image's points make the cloud

    All of it is a :class:`~fb3d_rl.env.options.Trial`, which ``reset(seed=...)`` draws and
    ``reset(options={"trials": [trial, ...]})`` gives, one for each environment that is reset. The same trial gives the
    same bits on the CPU: there every reset builds a new scene, because PhysX keeps contacts and solver state of the
    episode before.

    **Success Conditions:**
    - the normalized distance |q_goal - q| / |q_goal - q_start| of the part's joint is below ``options.success``;
      q_goal is the trial's, or the joint limit that opens. The episode then terminates; it is truncated after
      ``options.horizon`` control steps.

    Args:
        objects: objects, or the path of one or of many (PartNet-Mobility folders, URDF files); a few procedural
            objects unless given.
        options: the task's constants, also as nested dicts of those that differ from the default.
        split: of a folder of many objects, those of this split, category or id (a name or a list).
        link: name of the link to open; any unless given.
        num_envs: environments that run side by side; more than one need CUDA.
        kwargs: for ManiSkill's ``BaseEnv``. ``obs_mode`` is "pointcloud", "rgbd" ("rgb" [H, W, 3] uint8 and "depth"
            [H, W, 1] float32, m, in place of points; needs Vulkan), "state" (flat), "state_dict" or "none";
            ``reward_mode`` is "normalized_dense" or "sparse"; ``render_backend`` "cpu" or "gpu" draws
            ``render_mode="rgb_array"`` with SAPIEN.

    Raises:
        UserError: there is no object, none has something to open, or a simulator, a renderer or a mode is asked for
            that is not there.
    """

    SUPPORTED_OBS_MODES = ("pointcloud", "rgbd", "state", "state_dict", "none")
    SUPPORTED_REWARD_MODES = ("normalized_dense", "sparse", "none")
    SUPPORTED_ROBOTS = [FloatingSuctionGripper.uid]

    def __init__(
        self,
        objects: Iterable[ArticulatedObject] | str | Path | None = None,
        options: EnvOptions | Mapping[str, Any] | None = None,
        split: str | int | Sequence[object] = "all",
        link: str | None = None,
        num_envs: int = 1,
        **kwargs: Any,
    ) -> None:
        options = EnvOptions.of(options) if isinstance(options, Mapping) else options
        self.options: EnvOptions = options or EnvOptions()
        self.use(find_objects(objects, split), link)
        self.stages = []
        self.metadata = {**StagedEnv.metadata, "render_fps": self.options.control_freq}
        for name in ("obs_mode", "reward_mode", "render_mode"):
            require_mode(name, kwargs.get(name), getattr(self, f"SUPPORTED_{name.upper()}S"))
        kwargs["sim_backend"] = choose_simulator(kwargs.get("sim_backend", "auto"), num_envs)
        kwargs["render_backend"] = choose_renderer(
            kwargs.get("render_backend"), kwargs.get("obs_mode"), kwargs.get("render_mode"), self.options.camera.kind
        )
        super().__init__(
            num_envs=num_envs,
            robot_uids=FloatingSuctionGripper.uid,
            sim_config=dict(sim_freq=self.options.sim_freq, control_freq=self.options.control_freq),
            **kwargs,
        )

    def use(self, objects: Iterable[ArticulatedObject], link: str | None = None) -> None:
        """Let trials be of these objects from the next reset of all environments on.

        Args:
            objects: the objects.
            link: see the class.

        Raises:
            UserError: there is no object, or none has something to open.
        """
        self.source = TrialSource(objects, link, self.options)

    @property
    def objects(self) -> dict[str, ArticulatedObject]:
        """The objects that trials may be of, by their ids."""
        return self.source.objects

    @property
    def max_episode_steps(self) -> int:
        """The horizon, under the name that ManiSkill's vector environment reads."""
        return self.options.horizon

    # ------------------------------------------------------------------------------------------------ reset

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in all environments, or in those that ``options["env_idx"]`` names.

        Args:
            seed: of the trials that are drawn from here on.
            options: ``{"trials": [Trial, ...]}`` with one trial (or its ``dataclasses.asdict``, which RecordEpisode can
                keep) for each environment that is reset; without it they are drawn.

        Raises:
            UserError: a trial names an object or a part that does not exist or cannot be opened, or only some
                environments are reset and one of them gets another object.
        """
        options = dict(options or {})
        if isinstance(seed, list) and len(seed) == 1:
            [seed] = seed
        if seed is not None:
            self._np_random, self._np_random_seed = np.random.default_rng(seed), seed  # gymnasium's, as of its Env
        which = sorted(int(i) for i in options.get("env_idx", range(self.num_envs)))
        full = len(which) == self.num_envs
        trials = options.pop("trials", None)
        if trials is not None:
            trials = [Trial.of(trial) if isinstance(trial, Mapping) else trial for trial in trials]
        seeds: list[int] | None = None if trials is None or not full else [trial.seed for trial in trials]
        if trials is None:
            rng = self.np_random
            if full:  # a seed of its own, which RecordEpisode keeps, so that the episode can be replayed
                drawn = int(rng.integers(2**31)) if seed is None else seed
                rng, seeds = np.random.default_rng(drawn), drawn if isinstance(drawn, list) else [drawn]
            trials = [self._draw_trial(rng, None if full else self.stages[i]) for i in which]
        if len(trials) != len(which):
            raise UserError(f"{len(trials)} trials for {len(which)} environments; give one for each that is reset")
        drafts = [Stage(trial, self.source.model(trial.object)) for trial in trials]
        same = bool(self.stages) and all(
            self.stages[i].object is draft.object for i, draft in zip(which, drafts, strict=True)
        )
        if not full and not same:
            raise UserError("another object needs a reset of all environments, since the whole scene is built anew")
        if not full and self.scene.can_render():
            if any(self.stages[i].trial.view != trial.view for i, trial in zip(which, trials, strict=True)):
                raise UserError("the rendered camera moves in a reset of all environments only; keep the view")
        # On CUDA building is slow and bits differ between runs in any case.
        build = full and not (same and self.device.type == "cuda")
        if build:
            self.stages = drafts
        else:
            for i, trial in zip(which, trials, strict=True):
                self.stages[i] = self.stages[i].place(trial)
        options |= {"reconfigure": build, "env_idx": torch.tensor(which, device=self.device)}
        return super().reset(seed=seeds, options=options)

    def _draw_trial(self, rng: np.random.Generator, stage: Stage | None) -> Trial:
        """A trial; for ``stage`` one that runs there without building anything."""
        if stage is None:
            return self.source.draw(rng)
        view = stage.trial.view if self.scene.can_render() else None
        return self.source.draw(rng, stage.object.id, view)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        which = env_idx.tolist()
        if len(which) == self.num_envs:
            envs, joints = self._columns.shape
            self._progress = Progress(envs, joints, self.options.success, self.device)
            self._force = np.zeros((envs, 1), dtype=np.float32)  # norm of the contact force on each gripper, N
        state = torch.zeros(len(which), int(self.articulation.max_dof))
        hand = torch.zeros(len(which), ACTION_DIM)
        for row, e in enumerate(which):
            stage = self.stages[e]
            start = stage.trial.start
            positions = stage.tree.positions(torch.tensor(start, dtype=torch.float64))
            state[row, [*stage.order, *stage.led]] = positions.float()
            hand[row, :3] = torch.from_numpy(self.options.gripper.start(stage.model.bounds(start)))
            self._progress.begin(e, stage)
            self._force[e] = 0.0
            stage.begin(self.options.suction)
        self.articulation.set_qpos(state)
        self.agent.reset(hand)
        if self.gpu_sim_enabled:
            self._impulses = self.contact_impulses()

    # ------------------------------------------------------------------------------------------------- step

    def step(self, action: Any) -> tuple[dict[str, Any], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Make one control step.

        Args:
            action: [E, 8] (or [8] with one environment) in [-1, 1].

        Raises:
            UserError: the action has another shape, is not finite or out of range.
        """
        action = checked_action(torch.as_tensor(action, dtype=torch.float32, device=self.device), self.num_envs)
        obs, reward, terminated, _, info = super().step(action)
        truncated = (self._elapsed_steps >= self.options.horizon) & ~terminated
        return obs, reward, terminated, truncated, info

    def _after_simulation_step(self) -> None:
        if self.gpu_sim_enabled:  # suction, camera and flow read poses from the entities
            self.scene.px.sync_poses_gpu_to_cpu()
            contacts = self._impulses.read()
        else:
            contacts = [stage.suction.contacts() for stage in self.stages]
        for e, stage in enumerate(self.stages):
            if stage.suction.update(contacts[e]):
                self._progress.hold(e, stage)

    def _after_control_step(self) -> None:
        for e, stage in enumerate(self.stages):
            impulse = stage.suction.take_impulse()
            self._force[e] = math.sqrt(impulse.dot(impulse)) / self.control_timestep

    def evaluate(self) -> dict[str, Tensor]:
        """The metrics (:meth:`fb3d_rl.env.progress.Progress.metrics`)."""
        return self._progress.metrics(self.joint_states())

    def get_info(self) -> dict[str, Any]:
        """ManiSkill's, with a copy of the count of steps, which ManiSkill changes in place."""
        return super().get_info() | {"elapsed_steps": self._elapsed_steps.clone()}

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """How far the part is open [E]: 0 at the start, 1 at the goal."""
        return (1.0 - info["normalized_distance"][:, 0]).clamp(0.0, 1.0)

    def compute_sparse_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """1 on success, else 0 [E]."""
        return info["success"].float()

    # ------------------------------------------------------------------------------------------ observation

    def get_obs(self, info: dict[str, Any] | None = None, unflattened: bool = False) -> Any:
        """Observation and privileged truth, by the data contract's keys, each batched over E."""
        if self._obs_mode == "none":
            return {}
        poses = [stage.poses() for stage in self.stages]
        position = self._progress.of_target(self.joint_states())
        obs = gripper_and_joint(self.stages, poses, self.agent, self._force, position)
        rendered = self._obs_mode == "pointcloud" and self.options.camera.kind == "sapien"
        if rendered or self._obs_mode == "rgbd":
            self._rendered.capture()
        if self._obs_mode == "rgbd":
            obs["observation"]["rgb"], obs["observation"]["depth"] = self._rendered.rgbd()
        if self._obs_mode == "pointcloud":
            camera = self._rendered if rendered else None
            seen = clouds(self.stages, poses, self.options.points, self._elapsed_steps, camera)
            for group, entries in seen.items():
                obs[group] |= entries
        return obs if unflattened else self._flatten_raw_obs(obs)

    # ------------------------------------------------------------------------------------------------ state

    def get_state_dict(self) -> dict[str, Any]:
        """The simulation's state, with suction [E, 7] and the episode's steps, force and held joints [E, 2 + J]."""
        state: dict[str, Any] = super().get_state_dict()
        springs = np.stack([stage.suction.state for stage in self.stages])
        state["suction"] = torch.as_tensor(springs, dtype=torch.float32, device=self.device)
        episode = np.concatenate([self._force, self._progress.held], axis=1, dtype=np.float32)
        state["episode"] = torch.cat([self._elapsed_steps[:, None], torch.from_numpy(episode).to(self.device)], dim=1)
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Restore a state of :meth:`get_state_dict`, taken in the same trials.

        Args:
            state: rows for the environments that are restored, tensors or arrays; of a single one also without the
                axis of the environments, as ManiSkill's trajectory files hold it.
            env_idx: which they are; all unless given.
        """
        state = _rows_of(state, self.device)
        super().set_state_dict(state, env_idx)
        which = list(range(self.num_envs)) if env_idx is None else sorted(int(i) for i in env_idx)
        for row, e in enumerate(which):
            self.stages[e].suction.restore(state["suction"][row].double().cpu().numpy())
            elapsed, force, held_before = state["episode"][row].tensor_split([1, 2])
            self._elapsed_steps[e] = elapsed[0].to(self._elapsed_steps.dtype)
            self._force[e], self._progress.held[e] = float(force), held_before.bool().cpu().numpy()

    def set_state(self, state: Tensor, env_idx: Tensor | None = None) -> None:
        """Restore a flat state [E, D] of ``get_state()``, taken in the same trials."""

        def take(like: dict[str, Any]) -> dict[str, Any]:
            nonlocal state
            taken: dict[str, Any] = {}
            for key, value in like.items():
                if isinstance(value, dict):
                    taken[key] = take(value)
                else:
                    taken[key], state = state.split([value.shape[-1], state.shape[-1] - value.shape[-1]], dim=-1)
            return taken

        self.set_state_dict(take(self.get_state_dict()), env_idx)


def _rows_of(state: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    """A state's tensors [E, D] on the device."""
    return {
        key: _rows_of(value, device)
        if isinstance(value, Mapping)
        else torch.atleast_2d(torch.as_tensor(value, dtype=torch.float32, device=device))
        for key, value in state.items()
    }


def as_made(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """What ``gymnasium.make`` gives: a task whose spec holds plain options, and without the wrapper of a time limit.

    RecordEpisode writes the spec as JSON. ``gymnasium.make(max_episode_steps=N)`` names the horizon: the wrapper that
    it makes has one count for all environments, and its ``truncated`` is no tensor, as ManiSkill's vector environment
    asks for.
    """
    task = env.unwrapped
    assert isinstance(task, OpenArticulatedEnv) and task.spec is not None
    if isinstance(task.spec.kwargs.get("options"), EnvOptions):
        task.spec.kwargs = task.spec.kwargs | {"options": asdict(task.options)}
    if not isinstance(env, TimeLimit):
        return env
    steps = int(env._max_episode_steps)
    task.options = replace(task.options, horizon=steps)
    task.spec.max_episode_steps, task.spec.additional_wrappers = steps, (_AS_MADE,)  # so that the spec makes it again
    return env.env


# ManiSkill's own decorator would wrap the task in a time limit that overrides ``truncated``.
register(TASK, OpenArticulatedEnv)
_AS_MADE = WrapperSpec("AsMade", f"{__name__}:as_made", {})
gymnasium.register(TASK, entry_point=OpenArticulatedEnv, disable_env_checker=True, additional_wrappers=(_AS_MADE,))
