"""Every algorithm and policy, entered once: what makes it act, what trains it, its options, and what it is told.

A new one is a file, an entry here, and a yaml in conf/policy/ and, if it is trained, in conf/algo/. What stands behind
a name is imported when it is asked for, so that commands refuse a wrong configuration at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

FLOW = ("privileged", "flow")


@dataclass(frozen=True)
class Told:
    """What a policy is told that a camera and the hand's own joints do not show.

    Attributes:
        words: what that means.
        mask: which of the points it sees are those of the part to open.
        truth: the privileged keys that it reads.
    """

    words: str
    mask: bool = True
    truth: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Entry:
    """A policy, and how it is trained if it is; code is named as "module:object".

    Attributes:
        told: what the policy is told, by what its name in tables ends with.
        act: of a policy that is not trained, ``act(limits, flow policy's options)`` makes it.
        algorithm: a :class:`fb3d_rl.algos.algorithm.Algorithm`, which trains it and loads what was trained.
        options: the dataclass of the keys of ``algo`` (:class:`fb3d_rl.algos.options.AlgoOptions`).
        opens_only: whether it learns to open and nothing else, so that it cannot reach other goals.
        joint_fit: whether several processes may fit together.
    """

    told: Mapping[str, Told]
    act: str = ""
    algorithm: str = ""
    options: str = ""
    opens_only: bool = False
    joint_fit: bool = False

    @property
    def trained(self) -> bool:
        """Whether it acts from a checkpoint."""
        return bool(self.algorithm)

    @property
    def maskless(self) -> bool:
        """Whether it can do without the mask of the part to open."""
        return not all(told.mask for told in self.told.values())


NOTHING = Told("nothing")
WITHOUT_MASK = ", policy.mask=none"
EXPERT = "the true flow of the part to open"
IMITATION = Entry(
    {
        "": NOTHING,
        "_flow": Told("the true flow, which is an input of the network", truth=(FLOW,)),
        "_oracle": Told("the expert drives it to the contact point, by the true flow", truth=(FLOW,)),
        "_oracle_flow": Told("both: the expert's drive and the true flow", truth=(FLOW,)),
    },
    algorithm="fb3d_rl.algos.dagger:ALGORITHM",
    options="fb3d_rl.algos.options:ImitationOptions",
    opens_only=True,
)
FITTED = "fb3d_rl.algos.options:FlowNetworkOptions"

REGISTRY = {
    "expert": Entry(
        {"": Told(EXPERT, truth=(FLOW,)), WITHOUT_MASK: Told(EXPERT, mask=False, truth=(FLOW,))},
        act="fb3d_rl.policies.flow_policy:expert_policy",
    ),
    "artflownet": Entry(
        {"": NOTHING, WITHOUT_MASK: Told("nothing", mask=False)},
        algorithm="fb3d_rl.algos.artflownet:ALGORITHM",
        options=FITTED,
        joint_fit=True,
    ),
    "screwnet": Entry({"": NOTHING}, algorithm="fb3d_rl.algos.screwnet:ALGORITHM", options=FITTED),
    "ump_di": Entry(
        {
            "": Told(
                "until it holds the part, the size of the true flow at each point, not its direction", truth=(FLOW,)
            )
        },
        algorithm="fb3d_rl.algos.ump_di:ALGORITHM",
        options=FITTED,
    ),
    "normal": Entry({"": NOTHING}, act="fb3d_rl.policies.baselines:normal_policy"),
    "random": Entry(
        {"": Told("nothing, and it sees nothing", mask=False)}, act="fb3d_rl.policies.baselines:random_policy"
    ),
    "bc": IMITATION,
    "dagger": IMITATION,
}
"""The entries by the name of algorithm, checkpoints and policy."""


def behind(name: str) -> Any:
    """What "module:object" names."""
    return resolve_name(name)


def trained() -> tuple[str, ...]:
    """The names that launch/train.py takes, and that launch/evaluate.py evaluates from a checkpoint."""
    return tuple(name for name, entry in REGISTRY.items() if entry.trained)


def untrained() -> tuple[str, ...]:
    """The policies that need no checkpoint."""
    return tuple(name for name, entry in REGISTRY.items() if not entry.trained)


def truths() -> dict[str, Told]:
    """What each policy is told, by the names in tables of those that are told the same.

    Gates, which take part in training only, change nothing of it.
    """
    named: dict[tuple[int, str], list[str]] = {}
    for name, entry in REGISTRY.items():
        for ending in entry.told:
            named.setdefault((id(entry), ending), []).append(name)
    return {
        ", ".join(name + ending for name in names): REGISTRY[names[0]].told[ending]
        for (_, ending), names in named.items()
    }


def truths_table() -> str:
    """:func:`truths` as a table in Markdown."""
    rows = [("policy", "the part's mask", "what it is told besides"), ("---",) * 3]
    rows += [(name, "yes" if told.mask else "no", told.words) for name, told in truths().items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
