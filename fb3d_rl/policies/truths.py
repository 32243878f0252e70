"""What each evaluated policy is told that a camera and the hand's own joints do not show.

This is the one statement of it: a test compares it with the keys that the policies read, and with docs/protocols.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from fb3d_rl.contract import Key

FLOW: Key = ("privileged", "flow")


@dataclass(frozen=True)
class Told:
    """What a policy is told.

    Attributes:
        words: what that means.
        mask: which of the points it sees are those of the part to open.
        truth: the privileged keys that it reads.
    """

    words: str
    mask: bool = True
    truth: tuple[Key, ...] = ()


TOLD = {
    "expert": Told("the true flow of the part to open", truth=(FLOW,)),
    "expert, policy.mask=none": Told("the true flow of the part to open", mask=False, truth=(FLOW,)),
    "artflownet": Told("nothing"),
    "artflownet, policy.mask=none": Told("nothing", mask=False),
    "screwnet": Told("nothing"),
    "ump_di": Told(
        "until it holds the part, the size of the true flow at each point, not its direction", truth=(FLOW,)
    ),
    "normal": Told("nothing"),
    "random": Told("nothing, and it sees nothing", mask=False),
    "bc, dagger": Told("nothing"),
    "bc_flow, dagger_flow": Told("the true flow, which is an input of the network", truth=(FLOW,)),
    "bc_oracle, dagger_oracle": Told("the expert drives it to the contact point, by the true flow", truth=(FLOW,)),
    "bc_oracle_flow, dagger_oracle_flow": Told("both: the expert's drive and the true flow", truth=(FLOW,)),
}
"""The policies by their names in the tables; gates change who acts in training only."""


def table() -> str:
    """The table in Markdown."""
    rows = [("policy", "the part's mask", "what it is told besides"), ("---",) * 3]
    rows += [(name, "yes" if told.mask else "no", told.words) for name, told in TOLD.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
