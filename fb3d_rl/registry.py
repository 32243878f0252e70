"""The table of algorithms and policies: how each acts and is trained, its options, and its privileged inputs.

A new one is a file, an entry here, and a yaml in conf/policy/ and, if it is trained, in conf/algo/. The code
of an entry is imported when it is used, so that commands refuse a wrong configuration at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

FLOW = ("privileged", "flow")


@dataclass(frozen=True)
class Access:
    """Inputs of a policy beyond points and proprioception.

    Attributes:
        words: description of its privileged inputs.
        mask: whether it gets the mask of the part to open.
        truth: the privileged keys that it reads.
    """

    words: str
    mask: bool = True
    truth: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Entry:
    """A policy, and its training if it has one; code is named as "module:object".

    Attributes:
        access: the policy's inputs, by the ending of its name in tables.
        act: ``act(limits, flow policy's options)`` makes a policy that is not trained.
        outside: whether ``act`` also takes ``target``, the name of the user's own code, and ``points`` of a cloud.
        algorithm: a :class:`fb3d_rl.algos.algorithm.Algorithm`, which trains it and loads its checkpoints.
        options: the dataclass of the keys of ``algo`` (:class:`fb3d_rl.algos.options.AlgoOptions`).
        opens_only: whether it can only open parts fully, so that it has no other goals.
        joint_fit: whether several processes can fit it together.
    """

    access: Mapping[str, Access]
    act: str = ""
    algorithm: str = ""
    options: str = ""
    opens_only: bool = False
    joint_fit: bool = False
    outside: bool = False

    @property
    def trained(self) -> bool:
        """Whether it acts from a checkpoint."""
        return bool(self.algorithm)

    @property
    def maskless(self) -> bool:
        """Whether it can act without the mask of the part to open."""
        return not all(access.mask for access in self.access.values())


NOTHING = Access("nothing")
WITHOUT_MASK = ", policy.mask=none"
EXPERT = "the true flow of the part to open"
DECLARED = "what of the truth its `in_keys` declare"
IMITATION = Entry(
    {
        "": NOTHING,
        "_flow": Access("the true flow, which is an input of the network", truth=(FLOW,)),
        "_oracle": Access("the expert drives it to the contact point, by the true flow", truth=(FLOW,)),
        "_oracle_flow": Access("both: the expert's drive and the true flow", truth=(FLOW,)),
    },
    algorithm="fb3d_rl.algos.dagger:ALGORITHM",
    options="fb3d_rl.algos.options:ImitationOptions",
    opens_only=True,
    joint_fit=True,
)
FITTED = "fb3d_rl.algos.options:FlowNetworkOptions"

REGISTRY = {
    "expert": Entry(
        {"": Access(EXPERT, truth=(FLOW,)), WITHOUT_MASK: Access(EXPERT, mask=False, truth=(FLOW,))},
        act="fb3d_rl.policies.flow_policy:expert_policy",
    ),
    "expert_arc": Entry({"": Access(EXPERT, truth=(FLOW,))}, act="fb3d_rl.policies.arc:expert_arc_policy"),
    "artflownet": Entry(
        {"": NOTHING, WITHOUT_MASK: Access("nothing", mask=False)},
        algorithm="fb3d_rl.algos.artflownet:ALGORITHM",
        options=FITTED,
        joint_fit=True,
    ),
    "flowbotpp": Entry({"": NOTHING}, algorithm="fb3d_rl.algos.flowbotpp:ALGORITHM", options=FITTED),
    "screwnet": Entry({"": NOTHING}, algorithm="fb3d_rl.algos.screwnet:ALGORITHM", options=FITTED),
    "ump_di": Entry(
        {
            "": Access(
                "until it holds the part, the size of the true flow at each point, not its direction", truth=(FLOW,)
            )
        },
        algorithm="fb3d_rl.algos.ump_di:ALGORITHM",
        options=FITTED,
    ),
    "umpnet": Entry({"": NOTHING}, algorithm="fb3d_rl.algos.umpnet_training:ALGORITHM", options=FITTED),
    "normal": Entry({"": NOTHING}, act="fb3d_rl.policies.baselines:normal_policy"),
    "random": Entry(
        {"": Access("nothing, and it sees nothing", mask=False)}, act="fb3d_rl.policies.baselines:random_policy"
    ),
    "plugin": Entry(
        {"": NOTHING, WITHOUT_MASK: Access("nothing", mask=False), "_privileged": Access(DECLARED, truth=(FLOW,))},
        act="fb3d_rl.policies.plugin:plugin_policy",
        outside=True,
    ),
    "bc": IMITATION,
    "dagger": IMITATION,
}
"""The entries by name."""


def behind(name: str) -> Any:
    """The object of the name "module:object"."""
    return resolve_name(name)


def trained() -> tuple[str, ...]:
    """The names that launch/train.py takes, and that launch/evaluate.py evaluates from a checkpoint."""
    return tuple(name for name, entry in REGISTRY.items() if entry.trained)


def untrained() -> tuple[str, ...]:
    """The policies that need no checkpoint, by their names in tables."""
    return tuple(name + ending for name, entry in REGISTRY.items() if not entry.trained for ending in entry.access)


def truths() -> dict[str, Access]:
    """The inputs of each policy, by the names in tables of the policies that share them.

    Gates act in training only and are not part of it.
    """
    named: dict[tuple[int, str], list[str]] = {}
    for name, entry in REGISTRY.items():
        for ending in entry.access:
            named.setdefault((id(entry), ending), []).append(name)
    return {
        ", ".join(name + ending for name in names): REGISTRY[names[0]].access[ending]
        for (_, ending), names in named.items()
    }


def truths_table() -> str:
    """:func:`truths` as a table in Markdown."""
    rows = [("policy", "the part's mask", "privileged input"), ("---",) * 3]
    rows += [(name, "yes" if access.mask else "no", access.words) for name, access in truths().items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
