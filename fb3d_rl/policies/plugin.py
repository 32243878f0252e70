"""policy=plugin: a policy from outside the package, which gets what it declares and nothing else."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from fb3d_rl.contract import ACTION_DIM, BOOL, F32, Entry, Key, spec
from fb3d_rl.errors import UserError
from fb3d_rl.plugins import plugin, said
from fb3d_rl.policies.flow_policy import MASK
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.policies.policy import Policy, initial_state

TARGET = "policy.target"
"""The key of the configuration that names it."""

SEEN = spec("observation")
"""What any policy may read; one that declares nothing gets all of it."""

TRUTHS: dict[Key, Entry] = {
    **spec("privileged"),
    ("privileged", "link"): spec("sample")["privileged", "link"],
    ("privileged", "joint_axis"): Entry((3,), F32, "of the joint to open, towards opening, in the world"),
    ("privileged", "joint_origin"): Entry((3,), F32, "a point on it, m"),
    ("privileged", "joint_prismatic"): Entry((1,), BOOL, "whether it slides"),
    ("privileged", "joint_position"): Entry((1,), F32, "rad or m"),
}
"""What it has to declare to be given it."""

EPISODE: dict[Key, Entry] = {
    "elapsed_steps": Entry((1,), torch.int64, "control steps made"),
    "seed": Entry((1,), torch.int64, "of the trial, for random numbers"),
}

SHOWN = ("prediction", "flow")
"""The flow that it acts on, if it writes one, for films."""


class Plugin(Policy):
    """What the user's ``make(limits, options)`` returns, as a policy.

    That is called with a TensorDict [E] of what its attribute ``in_keys`` lists, a copy, and answers with the action
    [E, 8] or with a TensorDict that holds it as "action". A state is laid out in a method ``initial_state(batch)``, as
    :class:`~fb3d_rl.policies.policy.Policy` says, and its next one written below "next".

    Args:
        target: the name of ``make``.
        limits: what an action means.
        options: the flow policy's.
        folder: see :func:`fb3d_rl.plugins.plugin`.

    Raises:
        UserError: there is no such function, it fails, or it returns or declares what is none of these.
    """

    def __init__(self, target: str, limits: VelocityLimits, options: FlowPolicyOptions, folder: str) -> None:
        super().__init__()
        make = plugin(target, TARGET, folder)
        self.target, self.limits, self.options, self._folder = target, limits, options, folder
        if not callable(make):
            raise UserError(f"{TARGET}={target} is {type(make).__name__}, and no function make(limits, options)")
        self.source = _digest_of(make)
        try:
            self.act = make(limits, options)
        except (Exception, SystemExit) as error:  # noqa: BLE001, it is code of others
            raise UserError(f"{TARGET}={target} fails: {said(error)}") from error
        if not callable(self.act):
            raise UserError(
                f"{TARGET}={target} returns {type(self.act).__name__}: a function from TensorDict to action is needed"
            )
        self._state = initial_state(self.act, torch.Size([1]))
        groups = {*self._state.keys()}
        for name in groups & {"observation", "privileged", "prediction", "next", "action"}:
            raise UserError(f"{TARGET}={target} keeps its state under {name!r}, which is taken: choose another name")
        declared = [unravel_key(key) for key in getattr(self.act, "in_keys", SEEN)]
        asked = [key for key in declared if not (key in groups or (isinstance(key, tuple) and key[0] in groups))]
        known = SEEN | TRUTHS | EPISODE
        for key in asked:
            if key not in known:
                names = ", ".join(".".join(word) if isinstance(word, tuple) else word for word in known)
                raise UserError(f"{TARGET}={target} declares {key!r} in in_keys, which is unknown; choose from {names}")
        if options.mask == "none" and MASK in asked:
            if hasattr(self.act, "in_keys"):
                raise UserError(f"{TARGET}={target} reads the mask of the part: leave policy.mask=target")
            asked.remove(MASK)
        self._read = asked
        self.in_keys = [*asked, *self._state.keys(True, True)]
        self.out_keys = ["action", *(("next", *_path(key)) for key in self._state.keys(True, True))]

    def __reduce__(self) -> Any:
        """Workers make it anew, since functions in functions cannot be pickled."""
        return Plugin, (self.target, self.limits, self.options, self._folder)

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """See :class:`Policy`."""
        return initial_state(self.act, batch)

    @property
    def truths(self) -> list[str]:
        """The privileged entries that it is given."""
        return [key[1] for key in self._read if key[0] == "privileged"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action.

        Raises:
            UserError: it is none.
        """
        given = tensordict.select(*self._read, *self._state.keys()).clone()
        answer = self.act(given)
        written = answer if isinstance(answer, TensorDictBase) else given
        action = written.get("action", None) if isinstance(answer, TensorDictBase) else answer
        tensordict["action"] = self._checked(action, tensordict.batch_size)
        for name in self._state.keys():
            state = written.get(("next", name), None)
            if state is None:
                raise UserError(f"{TARGET}={self.target} does not write its next state, ('next', {name!r})")
            tensordict["next", name] = state
        if (shown := written.get(SHOWN, None)) is not None:
            tensordict[SHOWN] = shown
        return tensordict

    def _checked(self, action: Any, batch: torch.Size) -> Tensor:
        shape = (*batch, ACTION_DIM)
        try:
            values = torch.as_tensor(action, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError) as error:
            kind = type(action).__name__
            raise UserError(
                f"{TARGET}={self.target} answers with {kind}: the action {list(shape)} is needed"
            ) from error
        if tuple(values.shape) != shape:
            raise UserError(f"{TARGET}={self.target} answers with an action {list(values.shape)}: give {list(shape)}")
        if not bool(values.isfinite().all()):
            raise UserError(f"{TARGET}={self.target} answers with an action that is not finite")
        return values

    def tried(self, points: int) -> Plugin:
        """Itself, after a decision on made-up input of N = ``points`` points.

        Raises:
            UserError: that fails.
        """
        known, generator = SEEN | TRUTHS | EPISODE, torch.Generator().manual_seed(0)
        frame = TensorDict({key: _made_up(known[key], points, generator) for key in self._read}, batch_size=[])
        for key, value in (("tool_pose", [-1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]), ("goal_sense", [1.0])):
            if ("observation", key) in self._read:
                frame["observation", key] = torch.tensor(value)
        frame = frame[None].update(self.initial_state(torch.Size([1])))
        try:
            self(frame)
        except UserError:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001, it is code of others
            reads = ", ".join(".".join(_path(key)) for key in self._read)
            hint = f"; it gets {reads}" if isinstance(error, KeyError) else ""
            raise UserError(f"{TARGET}={self.target} cannot decide: {said(error)}{hint}") from error
        return self


def _made_up(entry: Entry, points: int, generator: torch.Generator) -> Tensor:
    shape = [points if size == "N" else int(size) for size in entry.shape]
    if entry.dtype == F32:
        return torch.randn(shape, generator=generator).mul(0.3)
    return torch.ones(shape).to(entry.dtype)


def _path(key: Key) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def _digest_of(make: Callable[..., Any]) -> str:
    """SHA-256 of the file that it is in, by which rows know the policy that made them; "" if there is none."""
    try:
        return hashlib.sha256(Path(inspect.getfile(make)).read_bytes()).hexdigest()
    except (TypeError, OSError):
        return ""


def plugin_policy(limits: VelocityLimits, options: FlowPolicyOptions, target: str, points: int = 1200) -> Plugin:
    """The policy of ``policy.target``, tried once.

    Raises:
        UserError: see :class:`Plugin`.
    """
    return Plugin(target, limits, options, str(Path.cwd())).tried(points)
