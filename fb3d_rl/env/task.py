"""The ManiSkill task: open a part of an articulated object with the floating suction gripper."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

warnings.filterwarnings("ignore", message="Failed to find system libvulkan")  # nothing is rendered

import gymnasium
import numpy as np
import sapien
import torch
from mani_skill import logger
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.system.backend import render_backend_name_mapping, sim_backend_name_mapping
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.registration import register
from mani_skill.utils.structs import Articulation
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.catalog import find_objects
from fb3d_rl.assets.gripper import BODIES, FINGERS, TOOL
from fb3d_rl.camera.sapien import SENSOR, SapienCamera, add_visuals, camera_config, require_renderer
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.drawing.bodies import GRIPPER, Body, Part, link_colors
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.env.gripper import FloatingSuctionGripper
from fb3d_rl.env.options import EnvOptions, Trial, default_trial, drawn_fraction
from fb3d_rl.env.stage import OBJECT_BIT, Model, Stage
from fb3d_rl.env.suction import ContactImpulses, Suction
from fb3d_rl.errors import UserError
from fb3d_rl.flow.articulation_flow import articulation_flow, normalize_flow
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.perception.cloud import MIN_VISIBLE, sample_cloud

logger.addFilter(lambda record: "does not support rendering" not in record.getMessage())  # it draws without

TASK = "OpenArticulated-v1"
"""The task's name for ``gymnasium.make``."""

PICTURE = 512
"""Width and height (pixels) of what ``render()`` returns."""

VIEW_TRIES = 8
"""Views that are drawn at most until one shows the part to open."""


class OpenArticulatedEnv(BaseEnv):
    """Open one part of an articulated object.

    ``gymnasium.make("fb3d_rl.env.task:OpenArticulated-v1", objects="DIR", split="test")`` makes it for any user of
    ManiSkill; :func:`fb3d_rl.env.torchrl_env.make_env` makes it for TorchRL.

    **Task Description:**
    A floating suction gripper, commanded by eight velocities, opens the given part (a door, a drawer, a lid ...) of an
    object whose base is fixed. It sees the object as a cloud of points from one camera. Suction holds the part as
    soon as a finger touches it. Contact between gripper, object and ground is physical; the object's parts do not
    collide with each other. What cannot move collides as the surface of its meshes, what moves as their convex hulls.

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
        objects: what stands in the scene: objects, a PartNet-Mobility folder of one object or of many; a few procedural
            objects unless given.
        options: the task's constants.
        split: of a folder of many objects, those of this split, category or id (a name or a list).
        link: name of the link to open, where it is always the same.
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
    agent: FloatingSuctionGripper
    scene: Any
    stages: list[Stage]
    """What stands in each of the E environments."""

    def __init__(
        self,
        objects: Iterable[ArticulatedObject] | str | Path | None = None,
        options: EnvOptions | None = None,
        split: str | int | Sequence[object] = "all",
        link: str | None = None,
        num_envs: int = 1,
        **kwargs: Any,
    ) -> None:
        self.use(find_objects(objects, split), link)
        self.options = options or EnvOptions()
        self.stages = []
        self._trial_rng = np.random.default_rng(0)
        self._require_modes(**kwargs)
        kwargs["sim_backend"] = _require_simulator(kwargs.get("sim_backend", "auto"), num_envs)
        kwargs["render_backend"] = self._require_renderer(**kwargs)
        super().__init__(
            num_envs=num_envs,
            robot_uids=FloatingSuctionGripper.uid,
            sim_config=dict(sim_freq=self.options.sim_freq, control_freq=self.options.control_freq),
            **kwargs,
        )

    def _require_modes(self, **modes: Any) -> None:
        for name, known in (
            ("obs_mode", self.SUPPORTED_OBS_MODES),
            ("reward_mode", self.SUPPORTED_REWARD_MODES),
            ("render_mode", self.SUPPORTED_RENDER_MODES),
        ):
            if modes.get(name) not in (None, *known):
                raise UserError(f"{name}={modes[name]!r} is none of this task's; choose from {', '.join(known)}")

    def _require_renderer(
        self,
        render_backend: str | None = None,
        obs_mode: str | None = None,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> str:
        """ManiSkill's ``render_backend``: the one that is asked for, or the best there is where one is needed."""
        needs = {
            "camera.kind=sapien": self.options.camera.kind == "sapien",
            "obs_mode=rgbd": obs_mode == "rgbd",
            f"render_mode={render_mode}": render_mode not in (None, "rgb_array"),
        }
        need = next((name for name, needed in needs.items() if needed), None)
        if render_backend in (None, "none"):
            if need is None:
                return "none"
            if render_backend is not None:
                raise UserError(f"{need} needs a renderer, but render_backend is 'none'; leave one of them out")
            return require_renderer(need, f"leave out {need}")
        name = _device(render_backend_name_mapping, "render_backend", render_backend)
        return require_renderer(
            f"render_backend={render_backend}",
            "leave it out: pictures are then drawn without",
            [(render_backend, name)],
        )

    def use(self, objects: Iterable[ArticulatedObject], link: str | None = None) -> None:
        """Let trials be of these objects from the next reset of all environments on.

        Args:
            objects: the objects.
            link: see the class.

        Raises:
            UserError: there is no object, or none has something to open.
        """
        self.objects = {obj.id: obj for obj in objects}
        self.link = link
        self._models: dict[str, Model] = {}
        if not self.objects:
            raise UserError("the environment has no object; give it at least one")
        if not any(self._to_open(obj, openable_links(obj)) for obj in self.objects.values()):
            raise self._nothing_opens()

    def _to_open(self, obj: ArticulatedObject, links: Sequence[int]) -> list[int]:
        """Those of an object's openable links that the environment opens."""
        return [i for i in links if self.link in (None, obj.links[i].name)]

    def _nothing_opens(self) -> UserError:
        what = "no part that opens" if self.link is None else f"no part that opens and is called {self.link!r}"
        return UserError(f"the objects have {what}; choose other objects: {', '.join([*self.objects][:5])}")

    @property
    def _default_sim_config(self) -> SimConfig:
        gravity = [0.0, 0.0, -9.81 if self.options.gravity else 0.0]
        return SimConfig(scene_config=SceneConfig(gravity=gravity))

    @property
    def max_episode_steps(self) -> int:
        """The horizon, by the name under which ManiSkill's vector environment looks for it."""
        return self.options.horizon

    # ------------------------------------------------------------------------------------------------ reset

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in all environments, or in those that ``options["env_idx"]`` names.

        Args:
            seed: of the trials that are drawn from here on.
            options: ``{"trials": [Trial, ...]}`` with one trial for each environment that is reset; without it they
                are drawn.

        Raises:
            UserError: a trial names an object or a part that does not exist or cannot be opened, or only some
                environments are reset and one of them shall get another object.
        """
        options = dict(options or {})
        if seed is not None:
            self._trial_rng = np.random.default_rng(seed)
        which = sorted(int(i) for i in options.get("env_idx", range(self.num_envs)))
        full = len(which) == self.num_envs
        trials = options.pop("trials", None)
        if trials is None:
            trials = [self._draw_trial(None if full else self.stages[i]) for i in which]
        if len(trials) != len(which):
            raise UserError(f"{len(trials)} trials for {len(which)} environments; give one for each that is reset")
        drafts = [Stage(trial, self._model(trial.object)) for trial in trials]
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
        return super().reset(seed=[stage.trial.seed for stage in self.stages] if full else None, options=options)

    def _model(self, name: str) -> Model:
        if name not in self.objects:
            raise UserError(f"the trial's object {name!r} is none of the environment's {len(self.objects)}")
        if name not in self._models:
            self._models[name] = Model(self.objects[name], self.options)
        return self._models[name]

    def _draw_trial(self, stage: Stage | None = None) -> Trial:
        """A trial from the environment's own generator; its view shows the part if one of ``VIEW_TRIES`` does.

        With a ``stage`` it is one that can run there without building: the object stays, a rendered camera too.
        """
        rng, names = self._trial_rng, list(self.objects) if stage is None else [stage.object.id]
        for i in rng.permutation(len(names)):
            model = self._model(names[i])
            links = self._to_open(model.object, model.links)
            if links:
                break
        else:
            raise self._nothing_opens()
        link, seed = int(rng.choice(links)), int(rng.integers(2**31))
        fraction = drawn_fraction(self.options.start, rng)
        for _ in range(VIEW_TRIES):
            view = self.options.views.sample(rng)
            if stage is not None and self.scene.can_render():
                view = stage.trial.view
            trial = default_trial(model.object, link, view, seed, fraction)
            # The hand is far away, where it hides nothing.
            poses = np.concatenate([model.poses(trial.start), np.tile(np.eye(4), (len(BODIES), 1, 1))])
            poses[len(model.object.links) :, 2, 3] = -1e3
            _, seen = model.camera.capture(poses, view)
            if np.isin(seen, model.object.descendants(link)).sum() >= MIN_VISIBLE:
                break
        return trial

    def _clear(self) -> None:
        # BaseEnv collects garbage here, which takes 0.2 s with torch loaded; the scene is freed without it.
        self._close_viewer()
        self.scene = None
        self.__dict__.pop("agent", None)
        for name in ("articulation", "_built", "_impulses", "_rendered"):
            self.__dict__.pop(name, None)

    def _load_agent(self, options: dict[str, Any]) -> None:
        self.agent = FloatingSuctionGripper(
            self.scene,
            self._control_freq,
            self._control_mode,
            initial_pose=sapien.Pose(),
            options=self.options.gripper,
        )

    def _load_scene(self, options: dict[str, Any]) -> None:
        ground = self.scene.create_actor_builder()
        ground.add_plane_collision(sapien.Pose(q=[0.7071068, 0, -0.7071068, 0]))
        ground.collision_groups[2] |= 1 << OBJECT_BIT
        ground.initial_pose = sapien.Pose()
        ground.build_static(name="ground")
        own = self.agent.robot.links_map
        built = []
        for e, stage in enumerate(self.stages):
            articulation = stage.model.build(self.scene, e)
            self.remove_from_state_dict_registry(articulation)
            built.append(articulation)
            stage.scene = self.scene.sub_scenes[e]
            stage.links = [articulation.links_map[link.name]._objs[0] for link in stage.object.links]
            active = [joint.child_link.name for joint in articulation.active_joints]
            stage.order = [active.index(stage.object.links[i].name) for i in stage.object.movable]
            stage.bodies = [own[name]._objs[e] for name in BODIES]
            stage.static = stage.model.add_shapes(stage.links)
            entity = sapien.Entity()
            entity.add_component(stage.static)
            stage.scene.add_entity(entity)
            if self.scene.can_render():
                visuals = [*(link.visuals for link in stage.object.links), *stage.model.gripper]
                for i, (body, meshes) in enumerate(zip((*stage.links, *stage.bodies), visuals, strict=True)):
                    add_visuals(body.entity, meshes, i)
        self._built = built
        # One view of all objects, whose joint states are padded to the longest.
        self.articulation = Articulation.merge(built, name="object")
        self.add_to_state_dict_registry(self.articulation)
        joints = max(len(stage.order) for stage in self.stages)
        self._columns = torch.zeros(self.num_envs, joints, dtype=torch.int64, device=self.device)
        for row, stage in zip(self._columns, self.stages, strict=True):
            row[: len(stage.order)] = torch.tensor(stage.order)

    def _camera_poses(self) -> NDArray[np.float64]:
        """T_world_camera [E, 4, 4]."""
        return np.stack([stage.model.camera.pose(stage.trial.view) for stage in self.stages])

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return [camera_config(self.options.camera, self._camera_poses())]

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        picture = replace(self.options.camera, resolution=PICTURE, shader="default")
        return [replace(camera_config(picture, self._camera_poses()), uid="render_camera")]

    def _after_reconfigure(self, options: dict[str, Any]) -> None:
        if self.scene.can_render():
            bodies = [[link.entity for link in stage.links] for stage in self.stages]
            self._rendered = SapienCamera(self._sensors[SENSOR], self.options.camera, self._camera_poses(), bodies)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        stages = [self.stages[e] for e in env_idx.tolist()]
        own = self.agent.robot.links_map
        if len(stages) == self.num_envs:
            shape = self._columns.shape
            self._held = torch.zeros(shape, dtype=torch.bool, device=self.device)
            self._force = torch.zeros(self.num_envs, 1, device=self.device)
            self._camera_position = torch.zeros(self.num_envs, 3, device=self.device)
            self._target = torch.zeros(self.num_envs, 1, dtype=torch.int64, device=self.device)
            self._start, self._goal = torch.full((2, *shape), torch.nan, device=self.device)
            self._opens = torch.ones(shape, dtype=torch.bool, device=self.device)
            self._prismatic = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        state = torch.zeros(len(stages), int(self.articulation.max_dof))
        hand = torch.zeros(len(stages), ACTION_DIM)
        for row, (e, stage) in enumerate(zip(env_idx.tolist(), stages, strict=True)):
            start = torch.tensor(stage.trial.start, dtype=torch.float32)
            state[row, stage.order] = start
            start_position = self.options.gripper.start(stage.model.bounds(stage.trial.start))
            hand[row, :3] = torch.from_numpy(start_position)
            self._camera_position[e] = torch.as_tensor(stage.model.camera.pose(stage.trial.view)[:3, 3])
            self._target[e], self._held[e], self._opens[e] = stage.target, False, True
            self._opens[e, stage.target] = stage.trial.goal is None
            self._start[e, : len(start)] = start
            self._goal[e, : len(start)] = torch.from_numpy(stage.goals())
            self._prismatic[e] = stage.object.joint_of(stage.trial.link).type == "prismatic"
            self._force[e] = 0.0
            if hasattr(stage, "suction"):
                stage.suction.release()
            stage.suction = Suction(
                stage.scene,
                tool=own[TOOL]._objs[e],
                fingers=[own[name]._objs[e] for name in FINGERS],
                body=stage.bodies,
                parts={i: stage.links[i] for i in self._holdable(stage)},
                options=self.options.suction,
            )
        self.articulation.set_qpos(state)
        self.agent.reset(hand)
        if self.gpu_sim_enabled:
            self._impulses = self.contact_impulses()

    def _holdable(self, stage: Stage) -> list[int]:
        parts = stage.tree.descendants.any(0) if self.options.suction.hold == "any" else stage.moved
        return [int(i) for i in parts.nonzero().flatten()]

    def contact_impulses(self) -> ContactImpulses:
        """A reader of the contacts of all environments for where the simulator tells no contact points."""
        return ContactImpulses(
            self.scene,
            self.agent.robot,
            FINGERS,
            BODIES,
            TOOL,
            [
                {i: built.links_map[stage.object.links[i].name] for i in self._holdable(stage)}
                for stage, built in zip(self.stages, self._built, strict=True)
            ],
        )

    # ------------------------------------------------------------------------------------------------- step

    def step(self, action: Any) -> tuple[dict[str, Any], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Make one control step.

        Args:
            action: [E, 8] (or [8] with one environment) in [-1, 1].

        Raises:
            UserError: the action has another shape, is not finite or out of range.
        """
        action = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        if action.shape not in ((self.num_envs, ACTION_DIM), (ACTION_DIM,) * (self.num_envs == 1)):
            raise UserError(f"the action has shape {tuple(action.shape)}; give one of {(self.num_envs, ACTION_DIM)}")
        # Rounding may leave the range by a little. Written so that nan fails too.
        if not bool((action.abs() <= 1.0 + 1e-4).all()):
            worst = action[~(action.abs() <= 1.0 + 1e-4)][0]
            raise UserError(f"the action holds {float(worst):.6g}; velocities are numbers from -1 to 1")
        obs, reward, terminated, _, info = super().step(action.clamp(-1.0, 1.0))
        truncated = (self._elapsed_steps >= self.options.horizon) & ~terminated
        return obs, reward, terminated, truncated, info

    def _after_simulation_step(self) -> None:
        if self.gpu_sim_enabled:  # suction, camera and flow read poses from the entities
            self.scene.px.sync_poses_gpu_to_cpu()
            contacts = self._impulses.read()
        else:
            contacts = [stage.suction.contacts() for stage in self.stages]
        for e, stage in enumerate(self.stages):
            stage.suction.update(contacts[e])
            if stage.suction.held is not None:
                carried = stage.tree.descendants[:, stage.suction.held]
                self._held[e, : len(carried)] |= carried.to(self.device)

    def _after_control_step(self) -> None:
        for e, stage in enumerate(self.stages):
            self._force[e] = float(np.linalg.norm(stage.suction.take_impulse())) / self.control_timestep

    def joint_positions(self) -> Tensor:
        """Joint states [E, J] (rad or m) in the order of each object's ``movable``, padded on the right."""
        return self.articulation.get_qpos().gather(1, self._columns)

    def evaluate(self) -> dict[str, Tensor]:
        """Metrics: normalized_distance [E, 1], contact [E, 1] (suction has held the part), held_opened [E, 1] (a part
        that suction has held is open, be it the one to open or another) and success [E].
        """
        positions = self.joint_positions()
        self._position = positions.gather(1, self._target)
        signed = (self._goal - positions) / (self._goal - self._start)
        # Past the limit, by the solver's slack, a part is open; past a goal within the range it has missed it.
        distances = torch.where(self._opens, signed.clamp_min(0.0), signed.abs())
        opened = distances < self.options.success  # not a number, and so not open, where there is nothing to open
        return {
            "normalized_distance": distances.gather(1, self._target),
            "contact": self._held.gather(1, self._target),
            "held_opened": (opened & self._held).any(-1, keepdim=True),
            "success": opened.gather(1, self._target)[:, 0],
        }

    def get_info(self) -> dict[str, Any]:
        """ManiSkill's, with a count of steps that does not go on counting."""
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
        if info is None:
            self.evaluate()
        robot = self.agent.robot
        poses = [stage.poses() for stage in self.stages]
        truth = self._tensor([_joint_truth(s, p) for s, p in zip(self.stages, poses, strict=True)])
        obs: dict[str, dict[str, Tensor]] = {
            "observation": {
                "qpos": robot.get_qpos(),
                "qvel": robot.get_qvel(),
                "tool_pose": self.agent.tool_pose(),
                "attached": self._tensor([[stage.suction.attached] for stage in self.stages]),
                "contact_force": self._force.clone(),
                "camera_position": self._camera_position.clone(),
                "goal_sense": self._tensor([[stage.sense] for stage in self.stages]).float(),
            },
            "privileged": {
                "joint_axis": truth[:, :3],
                "joint_origin": truth[:, 3:],
                "joint_prismatic": self._prismatic.clone(),
                "joint_position": self._position,
            },
        }
        if self._obs_mode == "rgbd" or (self._obs_mode == "pointcloud" and self.options.camera.kind == "sapien"):
            self._rendered.capture()
        if self._obs_mode == "rgbd":
            obs["observation"]["rgb"], obs["observation"]["depth"] = self._rendered.rgbd()
        if self._obs_mode == "pointcloud":
            clouds = self._stacked([self._cloud(e, pose) for e, pose in enumerate(poses)])
            for key in ("points", "valid", "part_mask"):
                obs["observation"][key] = clouds[key]
            for key in ("flow", "link"):
                obs["privileged"][key] = clouds[key]
        return obs if unflattened else self._flatten_raw_obs(obs)

    def _tensor(self, rows: Any) -> Tensor:
        return torch.from_numpy(np.array(rows)).to(self.device)

    def _stacked(self, parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
        if len(parts) == 1:  # without a copy
            return {key: value[None].to(self.device) for key, value in parts[0].items()}
        return {key: torch.stack([part[key] for part in parts]).to(self.device) for key in parts[0]}

    def _cloud(self, e: int, poses: NDArray[np.float64]) -> dict[str, Tensor]:
        """What the camera of environment ``e`` sees, and the ground-truth flow of it."""
        stage = self.stages[e]
        if self.options.camera.kind == "sapien":
            seen = self._rendered.cloud(e)
        else:
            seen = stage.model.camera.capture(poses, stage.trial.view, further=False)
        # A generator for each step, so that a restored state sees the same points again.
        rng = np.random.default_rng([stage.trial.seed, int(self._elapsed_steps[e])])
        cloud, ids = sample_cloud(*seen, self.options.points, rng)
        link, world = torch.from_numpy(ids), torch.from_numpy(cloud)
        flow = articulation_flow(stage.tree, world, link, torch.from_numpy(poses[: len(stage.links)]), stage.direction)
        valid = link >= 0
        return {
            "points": world,
            "valid": valid,
            "part_mask": stage.moved[link.clamp_min(0)] & valid,
            "flow": normalize_flow(flow),
            "link": link,
        }

    # --------------------------------------------------------------------------------------------- pictures

    def render_rgb_array(self, camera_name: str | None = None) -> Tensor:
        """Pictures [E, H, W, 3] uint8 of the scenes: by SAPIEN where it renders, else shaded on the CPU."""
        if self.scene.can_render():
            pictures: Tensor = super().render_rgb_array(camera_name)
            return pictures
        return torch.from_numpy(np.stack([self._shaded(stage) for stage in self.stages]))

    def render_human(self) -> Any:
        """SAPIEN's viewer.

        Raises:
            UserError: there is no screen to open its window on.
        """
        try:
            return super().render_human()
        except RuntimeError as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); run it where there is a screen, or take "
                "render_mode=rgb_array"
            ) from error

    def _shaded(self, stage: Stage) -> NDArray[np.uint8]:
        meshes = [*(link.visuals for link in stage.object.links), *stage.model.gripper]
        colors = [*link_colors(stage.object, stage.trial.link), *[GRIPPER] * len(stage.bodies)]
        body = Body(Part(*each) for each in zip(meshes, colors, stage.poses(), strict=True))
        camera = Camera.fitting(stage.trial.view, body.outline(), (PICTURE, PICTURE))
        return Studio(camera, body).picture()

    # ------------------------------------------------------------------------------------------------ state

    def get_state_dict(self) -> dict[str, Any]:
        """The simulation's state, with suction [E, 7] and the episode's steps, force and held joints [E, 2 + J]."""
        state: dict[str, Any] = super().get_state_dict()
        springs = [
            np.concatenate([[-1 if s.suction.held is None else s.suction.held], *s.suction.anchors])
            for s in self.stages
        ]
        state["suction"] = torch.as_tensor(np.stack(springs), dtype=torch.float32, device=self.device)
        state["episode"] = torch.cat([self._elapsed_steps[:, None], self._force, self._held], dim=-1)
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Restore a state of :meth:`get_state_dict`, taken in the same trials.

        Args:
            state: rows for the environments that are restored.
            env_idx: which they are; all unless given.
        """
        super().set_state_dict(state, env_idx)
        which = list(range(self.num_envs)) if env_idx is None else sorted(int(i) for i in env_idx)
        for row, e in enumerate(which):
            held, on_tool, on_part = np.split(state["suction"][row].double().cpu().numpy(), [1, 4])
            suction = self.stages[e].suction
            suction.release()
            if held[0] >= 0:
                suction.hold(int(held[0]), on_tool, on_part)
            elapsed, force, held_before = state["episode"][row].tensor_split([1, 2])
            self._elapsed_steps[e] = elapsed[0].to(self._elapsed_steps.dtype)
            self._force[e], self._held[e] = force, held_before.bool()

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


# ManiSkill's own decorator would wrap the task in a time limit that overrides ``truncated``.
register(TASK, OpenArticulatedEnv)
gymnasium.register(TASK, entry_point=OpenArticulatedEnv, disable_env_checker=True)


def _device(known: Mapping[str, str], key: str, word: str) -> str:
    """SAPIEN's name of the device that a backend's name means, such as "cuda:1" for "gpu:1".

    Raises:
        UserError: there is no such backend.
    """
    name, _, number = word.partition(":")
    if name == "pci":  # ManiSkill hands it to SAPIEN
        return word
    if name not in known or (number and not number.isdigit()):
        raise UserError(f"{key}={word!r} is none; choose from {', '.join(known)}")
    kind = "cpu" if known[name].endswith("cpu") else "cuda"
    return f"{kind}:{number}" if number else kind


def _require_simulator(word: str, num_envs: int) -> str:
    """ManiSkill's ``sim_backend`` for so many environments.

    Raises:
        UserError: there is no such backend, or it is not here.
    """
    if num_envs < 1:
        raise UserError(f"num_envs={num_envs} is too small; give 1 or more")
    chosen = ("gpu" if num_envs > 1 else "cpu") if word == "auto" else word
    device = _device({"auto": "", **sim_backend_name_mapping}, "sim_backend", chosen)
    if device == "cpu":
        if num_envs > 1:
            raise UserError(
                f"num_envs={num_envs} needs CUDA, and sim_backend={word} runs one environment in a process; give "
                "num_envs=1, or run several processes (gymnasium.vector.AsyncVectorEnv, collector=process)"
            )
        return chosen
    try:
        sapien.Device(device)
        if not torch.cuda.is_available():
            raise RuntimeError("torch finds no CUDA device")
    except RuntimeError as error:
        asks = f"num_envs={num_envs}" if word == "auto" else f"sim_backend={word}"
        raise UserError(
            f"{asks} needs a CUDA device, which is not there ({error}); give num_envs=1 and sim_backend=cpu, and for "
            "more environments run several processes (gymnasium.vector.AsyncVectorEnv, collector=process)"
        ) from error
    return chosen


def _joint_truth(stage: Stage, poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """The axis (towards opening) and the origin of the joint to open, in the world, [6]."""
    joint, pose = stage.object.joint_of(stage.trial.link), poses[stage.trial.link]
    return np.concatenate([stage.sign * pose[:3, :3] @ joint.axis, pose[:3, 3]]).astype(np.float32)
