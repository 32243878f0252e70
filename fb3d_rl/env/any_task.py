"""Any task of ManiSkill with an expert: what imitation needs of it, and nothing of opening parts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from fb3d_rl.env.torchrl_env import ManiSkillEnv
from fb3d_rl.errors import UserError
from fb3d_rl.plugins import plugin, said

Expert = Callable[[Any], Any]
"""ManiSkill's observation -> the expert's action [A] or [1, A], array or tensor."""


class TaskEnv(ManiSkillEnv):
    """A task of ManiSkill with one scene, whose resets start one given seed after the other; see :func:`make_task`.

    A step's TensorDict holds ("observation", "state") [1, S] f32, the numbers of ManiSkill's groups "agent" and "extra"
    one after the other, and with points also ("observation", "points") [1, N, 3] (m, world, in random order) and
    ("observation", "valid") [1, N]; ("label", "action") [1, A], what the expert would do; "seed" and "elapsed_steps".

    Args:
        env: of ``gymnasium.make``.
        expert: asked in every step.
        target: the expert's name, for messages.
        points: N; 0 for no points.

    Raises:
        UserError: the expert raises an exception, or gives no action.
    """

    def __init__(self, env: Any, expert: Expert, target: str, points: int) -> None:
        self._expert, self._target, self._points = expert, target, points
        self._seeds: Any = None
        self._running = 0
        super().__init__(env)

    def set_trials(self, trials: Iterable[int]) -> None:
        """Let each further reset start the next of these seeds; once they have run out, it does nothing."""
        self._seeds = iter(trials)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        seed = None if self._seeds is None else next(self._seeds, None)
        if seed is None and self._seeds is not None:
            return self._read(*self._seen)
        self._seed = self._running = seed or 0
        if hasattr(self._expert, "reset"):
            self._expert.reset()
        return self._start(torch.arange(1), {})

    def _read(self, obs: Any, info: dict[str, Any]) -> TensorDictBase:
        self._seen = obs, info
        steps = info["elapsed_steps"].reshape(1).to(torch.int32)
        observation: dict[str, Any] = {"state": state_of(obs)}
        if self._points:
            observation |= self._cloud(obs["pointcloud"], int(steps))
        content = {
            "observation": observation,
            "label": {"action": self._label(obs)},
            "seed": torch.tensor([self._running]),
            "elapsed_steps": steps,
            "success": torch.as_tensor(info.get("success", torch.zeros(1))).reshape(1).bool(),
        }
        return self._group(content)

    def _label(self, obs: Any) -> Tensor:
        shape = self.action_spec.shape
        try:
            action = torch.as_tensor(np.asarray(self._expert(obs)), dtype=torch.float32).reshape(shape)
        except (Exception, SystemExit) as error:  # noqa: BLE001, it is code of others
            raise UserError(
                f"expert.target={self._target} gives no action of {shape[-1]} numbers: {said(error)}"
            ) from error
        if not bool(action.isfinite().all()):
            raise UserError(f"expert.target={self._target} gives an action that is not finite")
        return action.clamp(-1.0, 1.0)

    def _cloud(self, cloud: Mapping[str, Tensor], step: int) -> dict[str, Tensor]:
        seen = cloud["xyzw"][0]
        seen = seen[seen[:, 3] > 0, :3].cpu()
        order = np.random.default_rng([self._running, step]).permutation(len(seen))[: self._points]
        points, valid = torch.zeros(1, self._points, 3), torch.zeros(1, self._points, dtype=torch.bool)
        points[0, : len(order)], valid[0, : len(order)] = seen[torch.from_numpy(order)].float(), True
        return {"points": points, "valid": valid}


def state_of(obs: Mapping[str, Any]) -> Tensor:
    """The numbers [E, S] of the groups "agent" and "extra" of ManiSkill's observation."""

    def leaves(group: Mapping[str, Any]) -> Iterable[Tensor]:
        for value in group.values():
            if isinstance(value, Mapping):
                yield from leaves(value)
            else:
                yield value.reshape(len(value), -1).float().cpu()

    return torch.cat([*leaves({key: obs[key] for key in ("agent", "extra")})], dim=-1)


def make_task(
    task: str, target: str, folder: str, sees: Literal["state", "points"], points: int, options: Mapping[str, Any]
) -> TaskEnv:
    """The environment of ManiSkill's ``task``; a function that can be pickled.

    Args:
        task: its name, such as PickCube-v1.
        target: "package.module:make" of the expert; make(env) returns an :data:`Expert`, and is called once for each
            environment. If that has a method ``reset()``, it is called at the start of each episode.
        folder: where the target's module is looked for.
        sees: "state" needs no renderer.
        points: points of a cloud.
        options: further arguments of ``gymnasium.make``.

    Raises:
        UserError: there is no such task, it cannot be made, its actions are not from -1 to 1, or the expert fails.
    """
    import gymnasium
    import mani_skill.envs  # noqa: F401, it registers the tasks

    if sees == "state":
        _allow_materials()
    given = {"obs_mode": "state_dict", "render_backend": "none"} if sees == "state" else {"obs_mode": "pointcloud"}
    try:
        # Built anew for each episode: what an episode leaves behind, such as a grasp, is felt at the start of the next.
        fixed = {"num_envs": 1, "sim_backend": "physx_cpu", "reconfiguration_freq": 1}
        env = gymnasium.make(task, **{**given, **fixed, **options})
    except Exception as error:  # noqa: BLE001, of any task
        raise UserError(f"env.task={task} cannot be made: {said(error)}") from error
    space = env.action_space
    if not (isinstance(space, gymnasium.spaces.Box) and abs(space.low + 1).max() == abs(space.high - 1).max() == 0):
        raise UserError(
            f"env.task={task} has actions that are not from -1 to 1; choose another control mode, such as "
            "env.task_options.control_mode=pd_ee_delta_pos"
        )
    make = plugin(target, "expert.target", folder)
    try:
        expert = make(env)
    except (Exception, SystemExit) as error:  # noqa: BLE001, it is code of others
        raise UserError(f"expert.target={target} fails: {said(error)}") from error
    return TaskEnv(env, expert, target, points if sees == "points" else 0)


class _Material:
    """Stands in for a material that nobody draws."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass


def _allow_materials() -> None:
    """Let tasks name the materials of what they build on machines without Vulkan, too, where SAPIEN makes none: with
    ``render_backend=none`` they are never drawn.
    """
    import sapien.pysapien
    import sapien.render

    try:
        sapien.render.RenderMaterial()
    except RuntimeError:  # there is no rendering device
        for module in (sapien.render, sapien.pysapien.render):
            module.RenderMaterial = _Material
