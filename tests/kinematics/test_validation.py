"""Flaws of objects are found, and sound objects have none."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fb3d_rl.kinematics.validation import Verdict, examine
from fb3d_rl.procedural import FAMILIES, generate

Broken = Callable[[str, str], Verdict]


@pytest.fixture
def broken(tmp_path: Path) -> Broken:
    """The verdict on a box whose URDF has had a pattern replaced."""

    def examined(pattern: str, by: str) -> Verdict:
        (name,) = generate(tmp_path, ["Laptop"], 1, seed=0)
        urdf = tmp_path / name / "mobility.urdf"
        text, count = re.subn(pattern, by, urdf.read_text(), flags=re.DOTALL)
        assert count
        urdf.write_text(text)
        return examine(tmp_path / name)

    return examined


def test_procedural_objects_have_no_flaw(tmp_path: Path) -> None:
    for name in generate(tmp_path, list(FAMILIES), 2, seed=1):
        verdict = examine(tmp_path / name)
        assert verdict.findings == () and verdict.usable and verdict.openable > 0, verdict


@pytest.mark.parametrize(
    ("pattern", "by", "says"),
    [
        ('<joint name="joint_0" type="revolute">', '<joint name="joint_0" type="fixed">', "no joint moves"),
        ("<limit[^>]*/>", '<limit lower="0" upper="0"/>', "no part opens"),
        ('<joint name="joint_0" type="revolute">', '<joint name="joint_0" type="continuous">', "no part opens"),
        ("original-1.obj", "nowhere.obj", "nowhere.obj is missing"),
        ("</robot>", "", "no well-formed XML"),
    ],
)
def test_what_cannot_be_used(broken: Broken, pattern: str, by: str, says: str) -> None:
    verdict = broken(pattern, by)
    assert not verdict.usable
    assert says in verdict.findings[0].what and verdict.findings[0].serious
    assert verdict.entry()["usable"] is False


def test_a_part_without_a_mesh(broken: Broken) -> None:
    verdict = broken('(<link name="link_0">).*?(</link>)', r"\1\2")
    assert any("link_0: the moving part has no mesh" in item.what for item in verdict.findings)


def test_a_lid_that_turns_the_wrong_way_runs_into_the_body(broken: Broken) -> None:
    verdict = broken('<axis xyz="-1.000000', '<axis xyz="1.000000')
    assert verdict.usable
    (finding,) = verdict.findings
    assert "screen" in finding.what and "runs into other parts" in finding.what


def test_a_joint_that_is_closed_at_its_upper_limit(broken: Broken) -> None:
    verdict = broken(
        '<axis xyz="-1.000000 0.000000 0.000000" */>(.*?)<limit lower="0" upper="([0-9.]+)"',
        r'<axis xyz="1.0 0 0"/>\1<limit lower="-\2" upper="0"',
    )
    assert ["flipped axis" in item.what for item in verdict.findings] == [True]
