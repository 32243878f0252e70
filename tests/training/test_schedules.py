"""Beta schedules against their closed forms."""

from __future__ import annotations

import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.training.schedules import SCHEDULES, beta


def test_constant_is_constant() -> None:
    assert [beta("constant", i, value=0.3) for i in range(4)] == [0.3] * 4
    assert beta("constant", 7) == 1.0, "behaviour cloning"


def test_linear_falls_from_1_to_0_in_equal_steps() -> None:
    assert [beta("linear", i, rounds=4) for i in range(6)] == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]


def test_exponential_is_a_power() -> None:
    assert [beta("exponential", i, base=0.5) for i in range(5)] == [1.0, 0.5, 0.25, 0.125, 0.0625]
    assert [beta("exponential", i, base=0.0) for i in range(3)] == [1.0, 0.0, 0.0]
    assert [beta("exponential", i, base=1.0) for i in range(3)] == [1.0] * 3


def test_first_is_the_expert_alone_and_then_never() -> None:
    assert [beta("first", i) for i in range(4)] == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_every_schedule_starts_with_the_expert_and_never_rises(schedule: str) -> None:
    values = [beta(schedule, i) for i in range(20)]
    assert values[0] == 1.0 and values == sorted(values, reverse=True) and values[-1] >= 0.0


@pytest.mark.parametrize(
    ("schedule", "options", "word"),
    [
        ("cosine", {}, "linear"),
        ("constant", {"value": 1.5}, "value"),
        ("exponential", {"base": -0.1}, "base"),
        ("linear", {"rounds": 0}, "rounds"),
    ],
)
def test_what_a_user_gets_wrong_is_named(schedule: str, options: dict[str, float], word: str) -> None:
    with pytest.raises(UserError, match=word):
        beta(schedule, 1, **options)


def test_rounds_count_from_0() -> None:
    with pytest.raises(ValueError, match="negative"):
        beta("first", -1)
