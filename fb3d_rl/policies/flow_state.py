"""What the flow policy carries from step to step, what it observes, and its options in units of one control step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.policies.contact import Contact
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions

SELECT, TRAVEL, APPROACH, PULL, RETREAT, RELEASE = range(6)
"""Phases. Grasp selection (supplement, I.F and I.G) is 0 to 2, 4 and 5, articulation execution (I.G) is 3."""

PHASES = ("select", "travel", "approach", "pull", "retreat", "release")
"""Their names."""

TRIES = 6
"""Failed contact points that are remembered."""


VECTORS = ("contact_point", "standoff", "pull", "leave", "tip", "came")
"""The entries of the state that the phases compute with, in float64; in the TensorDict they are float32."""


class FlowState(TensorClass):
    """The flow policy's state in E environments; in the TensorDict it lies under "policy".

    Attributes:
        phase: [E, 1] int64, one of the phases.
        contact_point: [E, 3] where to touch, m; in RETREAT where the hand backs off from.
        standoff: [E, 3] unit direction from the contact point to the hand.
        pull: [E, 3] unit flow at the contact point.
        idle: [E, 1] int64, control steps without progress.
        leave: [E, 3] unit direction in which the hand backs off, or leaves the object's bounding sphere; 0: none.
        tip: [E, 3] the suction tip in the last step, m.
        came: [E, 3] the way back along which the tip travelled, m, older steps faded; 0 but in TRAVEL.
        tried: [E, TRIES, 3] the last contact points that failed, m.
        tries: [E, 1] int64, how many have failed.
        chosen: [E, 1] int64, how many have been chosen.
        candidates: the points that were as good as the chosen one when it was chosen, the TensorDict of
            the :class:`~fb3d_rl.policies.contact.Contact` of CANDIDATES points for each environment.
    """

    phase: Tensor
    contact_point: Tensor
    standoff: Tensor
    pull: Tensor
    idle: Tensor
    leave: Tensor
    tip: Tensor
    came: Tensor
    tried: Tensor
    tries: Tensor
    chosen: Tensor
    candidates: TensorDictBase

    @classmethod
    def _of(
        cls, source: dict[str, Tensor | TensorDictBase], batch: torch.Size, device: torch.device | None
    ) -> FlowState:
        # As in TorchRL's own libraries, without the checks of each entry at each step.
        return cls.from_tensordict(TensorDict._new_unsafe(source=source, batch_size=batch, device=device))

    @classmethod
    def initial(cls, batch: Sequence[int]) -> FlowState:
        """The state at the start of an episode: all zeros, phase SELECT."""
        vector, count = torch.zeros(*batch, 3), torch.zeros(*batch, 1, dtype=torch.int64)
        vectors = {key: vector.clone() for key in VECTORS}
        counts = {key: count.clone() for key in ("phase", "idle", "tries", "chosen")}
        return cls(
            **vectors,
            **counts,
            tried=torch.zeros(*batch, TRIES, 3),
            candidates=Contact.none(batch).to_tensordict(),
            batch_size=torch.Size(batch),
        )

    @classmethod
    def read(cls, state: TensorDictBase) -> FlowState:
        """The state in a TensorDict, vectors in float64."""
        wide = {key: value.double() if key in VECTORS else value for key, value in state.items()}
        return cls._of(wide, state.batch_size, state.device)

    def packed(self) -> TensorDict:
        """The TensorDict of the state, in float32."""
        state = {key: value.float() if key in VECTORS else value for key, value in self.items()}
        return TensorDict._new_unsafe(source=state, batch_size=self.batch_size, device=self.device)

    def updated(self, **values: Tensor | TensorDictBase) -> FlowState:
        """The state with other values."""
        return self._of({**dict(self.items()), **values}, self.batch_size, self.device)

    def changed(self, where: Tensor, **values: Tensor | float) -> FlowState:
        """The state with other values in the environments ``where`` [E, 1] bool."""
        if not bool(where.any()):
            return self
        return self.updated(**{key: torch.where(where, value, getattr(self, key)) for key, value in values.items()})

    def given_up(self, where: Tensor, point: Tensor) -> FlowState:
        """The state with ``point`` [E, 3] among the failed ones in the environments ``where`` [E, 1] bool."""
        if not bool(where.any()):
            return self
        slot = torch.arange(TRIES, device=point.device) == self.tries % TRIES
        tried = torch.where((where & slot)[..., None], point[:, None].to(self.tried), self.tried)
        return self.updated(tried=tried, tries=self.tries + where)

    def set_out(self, chosen: Contact, candidates: Contact) -> FlowState:
        """The state of a hand that sets out for a contact point; it keeps its phase where that is none (flow 0)."""
        found = (chosen.flow != 0).any(-1, keepdim=True)
        return self.updated(
            contact_point=chosen.point.to(self.tip),
            pull=chosen.flow.to(self.tip),
            standoff=chosen.standoff.to(self.tip),
            candidates=candidates.to_tensordict(),
            phase=torch.where(found, TRAVEL, self.phase),
            chosen=self.chosen + found,
        )


@dataclass(frozen=True)
class Observed:
    """What the phases see of E environments. Vectors and numbers are float64, clouds float32.

    Attributes:
        phase: [E, 1] the phase in which the step begins.
        tip: [E, 3] the suction tip, m.
        hand: [E, 3] unit direction from the tip to the hand.
        attached: [E, 1] bool, suction holds a movable part.
        force: [E, 1] contact force, N.
        sense: [E, 1] 1 to open, -1 to close.
        points: [E, N, 3] m.
        valid: [E, N] bool.
        part: [E, N] bool, on the part to open; None if the policy is not shown it.
        flow: [E, N, 3].
        camera: [E, 3] m.
        pull: [E, 3] velocity of the tip in a pull, m/s; None if it follows from the flow.
        twist: [E, 6] velocity of the world's origin and angular velocity of the part, 0 where they are not known; None
            if they follow from the flow.
    """

    phase: Tensor
    tip: Tensor
    hand: Tensor
    attached: Tensor
    force: Tensor
    sense: Tensor
    points: Tensor
    valid: Tensor
    part: Tensor | None
    flow: Tensor
    camera: Tensor
    pull: Tensor | None = None
    twist: Tensor | None = None

    def __getitem__(self, rows: Tensor) -> Observed:
        """Some of the environments, by a mask [E] bool."""
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        return replace(self, **{name: value[rows] for name, value in values if value is not None})


@dataclass(frozen=True)
class Control:
    """The options in units of one control step.

    Attributes:
        options: speeds, gains, distances and times.
        limits: what an action means.
    """

    options: FlowPolicyOptions
    limits: VelocityLimits

    @property
    def patience(self) -> int:
        """Steps of pressing without hold after which an approach has failed."""
        return round(self.options.patience / self.limits.period)

    @property
    def stuck(self) -> int:
        """Steps without progress after which the hand is stuck."""
        return round(self.options.stuck_time / self.limits.period)

    @property
    def release(self) -> int:
        """Steps after which tearing off is given up."""
        return round(self.options.release_time / self.limits.period)

    @property
    def still(self) -> float:
        """Way (m) in one step that is less than progress."""
        return self.options.stuck_speed * self.limits.period

    @property
    def fade(self) -> float:
        """Share of the way behind it that still counts one step later."""
        return float(self.options.fade ** (self.limits.period / 0.05))

    def gain(self, wanted: float) -> float:
        """The gain (1/s) with which an offset is corrected: at most all of it in one step."""
        return min(wanted, 1.0 / self.limits.period)


Rows = TypeVar("Rows", Tensor, FlowState)


def split_by_phase(state: FlowState, seen: Observed) -> list[tuple[int, Tensor, FlowState, Observed]]:
    """The environments of each phase that occurs: the phase, which they are [E] bool, their state and observation."""
    phase = state.phase.squeeze(-1)
    present = sorted(set(phase.tolist()))
    rows = [phase == value for value in present]
    if len(present) == 1:
        return [(present[0], rows[0], state, seen)]
    return [(value, row, state[row], seen[row]) for value, row in zip(present, rows, strict=True)]


def join(parts: Sequence[tuple[Tensor, Rows]]) -> Rows:
    """Put together again what was split, from which environments [E] bool each part holds and the part."""
    if len(parts) == 1:
        return parts[0][1]
    order = torch.cat([rows.nonzero().flatten() for rows, _ in parts]).argsort()
    whole: Any = torch.cat([part for _, part in parts])
    return whole[order]
