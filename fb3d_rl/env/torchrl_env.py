"""TorchRL's view of a ManiSkill environment."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from gymnasium.spaces import Box
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.tensor_specs import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.errors import UserError

if TYPE_CHECKING:
    import gymnasium
    from mani_skill.envs.sapien_env import BaseEnv


class ManiSkillEnv(EnvBase):
    """Wraps any ManiSkill environment, batched over its E parallel scenes.

    A step's TensorDict holds under "next" the observation, all tensors [E, ...] of the environment's ``info``
    ("success", "fail", "elapsed_steps" ...), "reward" [E, 1] and "done" = "terminated" or "truncated" [E, 1]. A dict
    of observations keeps its keys, a flat one becomes "observation"; an entry with one number per scene has shape
    [E, 1]. The specs are those of the first reset. A "_reset" mask [E, 1] resets the marked scenes only.

    Args:
        env: what ``gymnasium.make`` of a ManiSkill task returns, or the task itself; its action space is a box.

    Raises:
        ValueError: the action space is no box.
    """

    env: gymnasium.Env[Any, Any]

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        task: Any = env.unwrapped
        super().__init__(device=task.device, batch_size=[task.num_envs])
        self.env = env
        self._seed: int | None = None
        space = task.single_action_space
        if not isinstance(space, Box):
            raise ValueError(f"the action space {space} is no box")
        self.action_spec = _action_spec(space, self.batch_size, self.device)
        obs, info = env.reset()
        self._info_keys = [key for key in info if self._per_scene(info[key])]
        self.observation_spec = _specs_of(self._read(obs, info))
        self.reward_spec = Unbounded(shape=(*self.batch_size, 1), device=self.device)
        flag = Categorical(2, dtype=torch.bool, shape=(*self.batch_size, 1), device=self.device)
        self.done_spec = Composite(
            {key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=self.batch_size
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._start(self._scenes_to_reset(tensordict), {})

    def _scenes_to_reset(self, tensordict: TensorDictBase | None) -> Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.arange(self.batch_size[0], device=self.device)
        return mask.flatten().nonzero().flatten()

    def _start(self, scenes: Tensor, options: dict[str, Any]) -> TensorDictBase:
        """Reset ``scenes`` [k]; the result covers all E."""
        if len(scenes) < self.batch_size[0]:
            options = options | {"env_idx": scenes}
        obs, info = self.env.reset(seed=self._seed, options=options)
        self._seed = None
        return self._read(obs, info)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        obs, reward, terminated, truncated, info = self.env.step(tensordict["action"])
        result = self._read(obs, info)
        shape = (*self.batch_size, 1)
        result["reward"] = torch.as_tensor(reward).reshape(shape).float()
        result["terminated"] = torch.as_tensor(terminated).reshape(shape)
        result["truncated"] = torch.as_tensor(truncated).reshape(shape)
        result["done"] = result["terminated"] | result["truncated"]
        return result

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulator."""
        super().close(raise_if_closed=raise_if_closed)
        self.env.close()

    def _per_scene(self, value: Any) -> bool:
        return isinstance(value, Tensor) and value.shape[:1] == self.batch_size

    def _read(self, obs: Any, info: dict[str, Any]) -> TensorDictBase:
        content = dict(obs) if isinstance(obs, dict) else {"observation": obs}
        content |= {key: info[key] for key in self._info_keys}
        return self._group(content)

    def _group(self, content: dict[str, Any]) -> TensorDict:
        """Entries of at least two dimensions each; groups without an entry, which TorchRL refuses, are left out."""
        entries: dict[str, Any] = {}
        for key, value in content.items():
            if not isinstance(value, dict):
                entries[key] = self._entry(value)
            elif value:
                entries[key] = self._group(value)
        # As in TorchRL's own libraries, without the checks of each entry at each step.
        return TensorDict._new_unsafe(source=entries, batch_size=self.batch_size, device=self.device)

    def _entry(self, value: Tensor) -> Tensor:
        # A copy, since ManiSkill returns its own buffers.
        return (value[:, None] if value.ndim == 1 else value).clone()


class TrialEnv(ManiSkillEnv):
    """The task of this package, whose resets start one given trial after the other.

    "trial" [E, 1] is the number of the running trial in what was given to :meth:`set_trials`, -1 if none runs; "seed"
    [E, 1] is its seed.

    Args:
        env: the task.
    """

    def __init__(self, env: BaseEnv) -> None:
        self._trials: Iterator[tuple[int, Trial]] | None = None
        self._running = [-1] * env.num_envs
        self._task: Any = env
        super().__init__(env)

    def set_trials(self, trials: Iterable[Trial]) -> None:
        """Let each further reset start the next of ``trials``.

        Once they have run out, a reset does not change the scene and starts no trial. Give
        ``itertools.cycle(trials)`` to start over. Without any call of this method the task draws its trials.
        """
        self._trials = enumerate(trials)

    @property
    def idle(self) -> bool:
        """Whether the trials have run out and none is running."""
        return self._trials is not None and max(self._running) < 0

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        scenes = self._scenes_to_reset(tensordict)
        if self._trials is None:
            return self._start(scenes, {})
        given = list(itertools.islice(self._trials, len(scenes)))
        for scene, number in itertools.zip_longest(scenes.tolist(), (number for number, _ in given), fillvalue=-1):
            self._running[scene] = number
        if not given:
            return self._read(*self._seen)
        return self._start(scenes[: len(given)], {"trials": [trial for _, trial in given]})

    def _entry(self, value: Tensor) -> Tensor:
        return value[:, None] if value.ndim == 1 else value  # this task returns no buffers of its own

    def _read(self, obs: Any, info: dict[str, Any]) -> TensorDictBase:
        self._seen = obs, info
        result = super()._read(obs, info)
        result["trial"] = torch.tensor(self._running, device=self.device)[:, None]
        result["seed"] = torch.tensor([stage.trial.seed for stage in self._task.stages], device=self.device)[:, None]
        return result


def _action_spec(space: Box, batch: torch.Size, device: torch.device) -> TensorSpec:
    """Actions [E, A] within the box; unbounded ones where a bound is infinite."""
    shape = (*batch, *space.shape)
    dtype = torch.as_tensor(space.low).dtype
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        return Unbounded(shape=shape, dtype=dtype, device=device)
    low, high = (torch.as_tensor(bound, device=device).expand(shape) for bound in (space.low, space.high))
    return Bounded(low, high, shape=shape, dtype=dtype, device=device)


def _specs_of(sample: TensorDictBase) -> Composite:
    """The specs of observations like ``sample``."""
    specs: dict[str, TensorSpec] = {}
    for key, value in sample.items():
        if isinstance(value, TensorDictBase):
            specs[key] = _specs_of(value)
        elif value.dtype is torch.bool:
            specs[key] = Binary(value.shape[-1], shape=value.shape, dtype=torch.bool, device=value.device)
        else:
            specs[key] = Unbounded(shape=value.shape, dtype=value.dtype, device=value.device)
    return Composite(specs, shape=sample.batch_size, device=sample.device)


def _stand_in() -> ArticulatedObject:
    """A block that slides out of another: the object of an environment before its first trial."""
    block = trimesh.creation.box((0.2, 0.2, 0.2))
    back, front = (
        (Mesh(np.asarray(block.vertices) + [x, 0.0, 0.1], np.asarray(block.faces, dtype=np.int64)),)
        for x in (0.1, -0.1)
    )
    slide = Joint("slide", "prismatic", np.eye(4), np.array([-1.0, 0.0, 0.0]), (0.0, 0.2))
    links = (Link("back", "", -1, None, back, back), Link("front", "", 0, slide, front, front))
    return ArticulatedObject("stand-in", "", Path(), links)


def require_simulator(otherwise: str = "leave out the trials: evaluation.trials=0") -> None:
    """Import the simulator, so that a machine without it fails before any work.

    Args:
        otherwise: what to do without it, for the message.

    Raises:
        UserError: ManiSkill or SAPIEN is not installed, or lacks a library of the system.
    """
    try:
        import fb3d_rl.env.task  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"the simulator cannot be loaded ({error}); install mani-skill and, for SAPIEN, the system's libX11, "
            f"or {otherwise}"
        ) from error


def make_env(
    objects: Iterable[ArticulatedObject],
    options: EnvOptions | None = None,
    trials: Iterable[Trial] | None = None,
    **kwargs: Any,
) -> TrialEnv:
    """Make the task for ``objects``, ready for TorchRL's collectors.

    Args:
        objects: the objects that trials may name.
        options: the task's constants.
        trials: see :meth:`TrialEnv.set_trials`; without them the task draws its own.
        kwargs: for :class:`fb3d_rl.env.task.OpenArticulatedEnv`, such as ``obs_mode`` or ``reward_mode``.

    Raises:
        UserError: there is no object, or none has something to open.
        ValueError: the task does not keep the data contract (one without points only has to have the metrics).
    """
    from fb3d_rl.env.task import OpenArticulatedEnv

    if kwargs.get("num_envs", 1) == 1:
        # All objects have the same specs. A given object that cannot be built would fail here, not only in its trial.
        link = kwargs.pop("link", None)
        task = OpenArticulatedEnv([_stand_in()], options, **kwargs)
        env = TrialEnv(task)
        task.use(objects, link)
    else:  # several scenes are built together, and seldom
        env = TrialEnv(OpenArticulatedEnv(objects, options, **kwargs))
    first = env.observation_spec.zero()
    sees = ("observation", "points") in first.keys(include_nested=True)
    for group in ("observation", "privileged", "metrics") if sees else ("metrics",):
        contract.check(first, group)
    contract.check(env.full_action_spec.zero(), "action")
    if trials is not None:
        env.set_trials(trials)
    return env
