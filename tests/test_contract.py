"""The data contract: ``check`` refuses what deviates from it in any way, and learned inputs hold no truth."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl import contract


def filled(group: str, lead: tuple[int, ...] = (2, 3), points: int = 5) -> TensorDict:
    td = TensorDict({}, batch_size=lead)
    for key, entry in contract.spec(group).items():
        shape = [points if isinstance(size, str) else size for size in entry.shape]
        td.set(key, torch.zeros(*lead, *shape, dtype=entry.dtype))
    return td


@pytest.mark.parametrize("group", contract.GROUPS)
@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
def test_what_keeps_the_contract_passes(group: str, lead: tuple[int, ...]) -> None:
    contract.check(filled(group, lead), group)


@pytest.mark.parametrize("group", contract.GROUPS)
def test_every_deviation_is_refused_and_named(group: str) -> None:
    for key, entry in contract.spec(group).items():
        good = filled(group)
        with pytest.raises(ValueError, match="is missing") as missing:
            contract.check(good.exclude(key), group)
        assert str(key) in str(missing.value)
        wrong = torch.float64 if entry.dtype is not torch.float64 else torch.float32
        with pytest.raises(ValueError, match="float64"):
            contract.check(good.clone().set(key, good.get(key).to(wrong)), group)
        wider = torch.cat([good.get(key)] * 2, dim=-1)
        if entry.shape != ("N",) or len(contract.spec(group)) > 1:
            with pytest.raises(ValueError, match="trailing shape"):
                contract.check(good.clone().set(key, wider), group)
        with pytest.raises(ValueError, match="trailing shape"):
            contract.check(good.clone().set(key, good.get(key)[..., None]), group)


def test_clouds_of_different_sizes_are_refused() -> None:
    td = filled("sample", points=5)
    td["privileged", "flow"] = torch.zeros(2, 3, 6, 3)
    with pytest.raises(ValueError, match="flow"):
        contract.check(td, "sample")


def test_no_group_but_privileged_and_sample_holds_the_truth() -> None:
    for group in set(contract.GROUPS) - {"privileged", "sample"}:
        assert not any(key[0] == "privileged" for key in contract.spec(group) if isinstance(key, tuple))


def test_action_width_is_the_constant() -> None:
    assert contract.spec("action")["action"].shape == (contract.ACTION_DIM,)
