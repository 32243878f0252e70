"""The command that makes one attempt: what it refuses, and that nothing moves without leave."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import sawyer
from fb3d_rl.robot.driver import JointState, Picture, Wrench
from fb3d_rl.robot.run import Settings, make_attempt
from fb3d_rl.robot.simulated import LENS, SHAPE


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"noise": "fog"}, "choose from azure_kinect, stereo, exact"),
        ({"suction": "glue"}, "choose from seal, perfect"),
        ({"seed": -1}, "0 or more"),
        ({"driver": "recorded"}, "go together"),
        ({"session": Path("x")}, "go together"),
        ({"driver": "mine:make"}, "needs --calibration"),
        ({"driver": "mine:make", "calibration": Path("x"), "policy": "expert"}, "truth of the simulated cell"),
        ({"driver": "recorded", "session": Path("x"), "video": Path("x.mp4")}, "films the simulated cell"),
        ({"video": Path("x.avi")}, "ends in .mp4 or .gif"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(settings, says) -> None:
    with pytest.raises(UserError, match=says):
        Settings(**settings)


class Watched:
    """A robot of somebody's own before nothing, which notes what it is told."""

    told: list[str] = []

    def joints(self) -> JointState:
        return JointState(sawyer().home.numpy(), np.zeros(7), 0.0)

    def wrench(self) -> Wrench:
        return Wrench(np.zeros(3), np.zeros(3))

    def move(self, velocity: np.ndarray) -> None:
        self.told.append("move")

    def suction(self, on: bool) -> bool:
        self.told.append("suction")
        return False

    def picture(self) -> Picture:
        self.told.append("picture")
        return Picture(np.ones(SHAPE, dtype=np.float32), None, LENS, 0.0)


def lacking() -> object:
    return object()


def test_a_robot_of_ones_own_is_looked_at_and_not_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "watched", __import__("types").ModuleType("watched"))
    monkeypatch.setattr("watched.make", Watched, raising=False)
    monkeypatch.setattr("watched.lacking", lacking, raising=False)
    calibration = tmp_path / "calibration.json"
    calibration.write_text(json.dumps({"T_base_camera": np.eye(4).tolist()}))
    lines: list[str] = []

    class Network(torch.nn.Module):
        def forward(self, points: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
            return torch.zeros_like(points)

    def made(driver: str, **more: bool) -> int:
        return make_attempt(
            Settings(driver=driver, calibration=calibration, **more), lambda name: Network(), lines.append
        )  # type: ignore[arg-type, return-value]

    Watched.told.clear()
    assert made("watched:make") == 1
    assert Watched.told == ["picture"] and "no object" in lines[-1]
    assert made("watched:make", allow_motion=True) == 1
    assert "move" in Watched.told  # at least to stop
    with pytest.raises(UserError, match="lacks joints, wrench"):
        made("watched:lacking")
    with pytest.raises(UserError, match="cannot be made"):
        made("watched:nothing")
    calibration.write_text("{}")
    with pytest.raises(UserError, match="no calibration"):
        made("watched:make")
