"""TorchRL's view of a ManiSkill environment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.tensor_specs import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import UserError
from fb3d_rl.env.options import EnvOptions, Trial

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv

METRICS = (*contract.spec("metrics"), "success")
"""Entries of ManiSkill's ``info`` that become entries of the TensorDict."""


class ManiSkillEnv(EnvBase):
    """Wraps a ManiSkill environment whose observations are nested dicts of tensors [E, ...].

    A step's TensorDict holds under "next" the observation, the metrics of ``info`` ([E, 1] each), "reward" and "done"
    = "terminated" or "truncated"; "trial" [E, 1] is the number of the running trial in the list given to
    :meth:`set_trials`, -1 without one. The specs are those of the first observation, which is checked against the
    data contract (an environment without points only for its metrics).

    Args:
        env: the environment; ``batch_size`` is ``[env.num_envs]``.

    Raises:
        ValueError: an observation does not keep the contract.
    """

    def __init__(self, env: BaseEnv) -> None:
        super().__init__(device=env.device, batch_size=[env.num_envs])
        self.env = env
        self._trials: Sequence[Trial] = ()
        self._started = 0
        self._seed: int | None = None
        obs, info = env.reset()
        first = self._read(obs, info)
        sees = ("observation", "points") in first.keys(include_nested=True)
        for group in ("observation", "privileged", "metrics") if sees else ("metrics",):
            contract.check(first, group)
        self.observation_spec = _specs_of(first)
        (width,) = contract.spec("action")["action"].shape
        if env.single_action_space.shape != (width,):
            raise ValueError(f"action has shape {env.single_action_space.shape}, the contract says {(width,)}")
        self.action_spec = Bounded(-1.0, 1.0, shape=(*self.batch_size, int(width)), device=self.device)
        self.reward_spec = Unbounded(shape=(*self.batch_size, 1), device=self.device)
        flag = Categorical(2, dtype=torch.bool, shape=(*self.batch_size, 1), device=self.device)
        self.done_spec = Composite(
            {key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=self.batch_size
        )

    def set_trials(self, trials: Iterable[Trial]) -> None:
        """Let each further reset start the next of ``trials``; after the last one comes the first again.

        Raises:
            UserError: there is no trial.
        """
        trials = tuple(trials)
        if not trials:
            raise UserError("the list of trials is empty; give at least one")
        self._trials, self._started = trials, 0

    @property
    def running_trial(self) -> int:
        """Number of the running trial in the list given to :meth:`set_trials`; -1 without one."""
        return (self._started - 1) % len(self._trials) if self._trials and self._started else -1

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        options: dict[str, Any] = {}
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            options["env_idx"] = mask.flatten().nonzero().flatten()
        if self._trials:
            options["trials"] = [self._trials[self._started % len(self._trials)]]
            self._started += 1
        obs, info = self.env.reset(seed=self._seed, options=options)
        self._seed = None
        return self._read(obs, info)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        obs, reward, terminated, truncated, info = self.env.step(tensordict["action"])
        result = self._read(obs, info)
        result["reward"] = self._column(reward).float()
        result["terminated"] = self._column(terminated)
        result["truncated"] = self._column(truncated)
        result["done"] = result["terminated"] | result["truncated"]
        return result

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulator."""
        super().close(raise_if_closed=raise_if_closed)
        self.env.close()

    def _read(self, obs: dict[str, Any], info: dict[str, Any]) -> TensorDict:
        result = TensorDict(obs, batch_size=self.batch_size, device=self.device)
        for key in METRICS:
            if key in info:
                result[key] = self._column(info[key])
        result["trial"] = torch.full((*self.batch_size, 1), self.running_trial, dtype=torch.int64, device=self.device)
        return result

    def _column(self, values: Tensor) -> Tensor:
        return values.reshape(*self.batch_size, 1)


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


def require_simulator() -> None:
    """Import the simulator, so that a machine without it says so before any work.

    Raises:
        UserError: ManiSkill or SAPIEN is not installed, or lacks a library of the system.
    """
    try:
        import fb3d_rl.env.task  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"the simulator cannot be loaded ({error}); install mani-skill and, for SAPIEN, the system's libX11, "
            "or leave out the trials: evaluation.trials=0"
        ) from error


def make_env(
    objects: Iterable[ArticulatedObject],
    options: EnvOptions | None = None,
    trials: Iterable[Trial] | None = None,
    **kwargs: Any,
) -> ManiSkillEnv:
    """Make the task for ``objects``, ready for TorchRL's collectors.

    Args:
        objects: the objects that trials may name.
        options: the task's constants.
        trials: see :meth:`ManiSkillEnv.set_trials`; without them every reset runs the first object's default trial.
        kwargs: for :class:`fb3d_rl.env.task.OpenArticulatedEnv`, such as ``obs_mode`` or ``reward_mode``.

    Raises:
        UserError: there is no object, or the first one has nothing to open.
    """
    from fb3d_rl.env.task import OpenArticulatedEnv

    env = ManiSkillEnv(OpenArticulatedEnv(objects, options, **kwargs))
    if trials is not None:
        env.set_trials(trials)
    return env
