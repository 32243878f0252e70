"""What ``launch/robot.py run`` does: make one attempt with a driver, an arm, a calibration and a policy."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.noise import PRESETS
from fb3d_rl.drawing.video import require_encoder
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import find_objects
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.procedural import FAMILIES, generate
from fb3d_rl.robot.arm import Arm, named_arm
from fb3d_rl.robot.attempt import OPEN, Predictor
from fb3d_rl.robot.driver import Driver
from fb3d_rl.robot.episode import attempt
from fb3d_rl.robot.film import Filmed
from fb3d_rl.robot.policy_flow import PolicyFlow
from fb3d_rl.robot.recorded import Recorder, Replay, Resting
from fb3d_rl.robot.simulated import CellOptions, SimulatedCell
from fb3d_rl.robot.table import on_table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """The settings of the command; see its help."""

    driver: str = "simulated"
    object: str = "Microwave"
    part: str | None = None
    arm: str = "sawyer"
    calibration: Path | None = None
    policy: str = "pretrained"
    noise: str = "azure_kinect"
    suction: str = "seal"
    seed: int = 0
    session: Path | None = None
    record: Path | None = None
    video: Path | None = None
    allow_motion: bool = False

    def __post_init__(self) -> None:
        """Check what needs no file.

        Raises:
            UserError: settings do not go together.
        """
        simulated = self.driver == "simulated"
        if self.noise not in PRESETS:
            raise UserError(f"--noise {self.noise} is unknown; choose from {', '.join(PRESETS)}")
        if self.suction not in ("seal", "perfect"):
            raise UserError(f"--suction {self.suction} is unknown; choose from seal, perfect")
        if self.seed < 0:
            raise UserError(f"--seed {self.seed} is out of range; give 0 or more")
        if self.policy == "expert" and not simulated:
            raise UserError("--policy expert knows the truth of the simulated cell only; give a network's weights")
        if self.video is not None and not simulated:
            raise UserError("--video films the simulated cell; leave it out with another driver")
        if self.video is not None and self.video.suffix not in (".mp4", ".gif"):
            raise UserError(f"--video {self.video}: give a file that ends in .mp4 or .gif")
        if (self.driver == "recorded") != (self.session is not None):
            raise UserError("--driver recorded and --session DIR go together")
        if self.driver not in ("simulated", "recorded") and self.calibration is None:
            raise UserError("a robot of your own needs --calibration FILE, which calibrate writes")


class _Setting(NamedTuple):
    """What an attempt is made with."""

    driver: Driver
    arm: Arm
    camera: Array
    policy: str
    seed: int
    opened: Callable[[], bool] | None = None
    cell: SimulatedCell | None = None


def make_attempt(settings: Settings, load: Callable[[str], ArtFlowNet], say: Callable[[str], None]) -> int:
    """Make one attempt, and say each stage in a line.

    Args:
        settings: of the command.
        load: makes the network of a policy's name.
        say: gets the lines.

    Returns:
        The exit code: 0, or 1 if the attempt failed.

    Raises:
        UserError: the attempt cannot begin.
    """
    made = _setting(settings)
    driver, opened = made.driver, made.opened
    predictor: Predictor = (
        made.cell.expert if made.cell and made.policy == "expert" else PolicyFlow.of_network(load(made.policy))
    )
    filmed = recorder = None
    if settings.video is not None and made.cell is not None:
        require_encoder()
        driver = filmed = Filmed(made.cell, f"{settings.object} · {made.policy}")
    if settings.record is not None:
        about = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(settings).items()}
        about |= {"judged": opened is not None, "T_base_camera": made.camera.tolist()}
        driver = recorder = Recorder(driver, settings.record, about)
        opened = None if opened is None else recorder.judged(opened)
    result = attempt(driver, made.arm, made.camera, predictor, seed=made.seed, opened=opened, say=say)
    if recorder is not None:
        recorder.flush()
        say(f"recorded in {settings.record}")
    if filmed is not None and settings.video is not None:
        settings.video.parent.mkdir(parents=True, exist_ok=True)
        filmed.write(settings.video)
        say(f"wrote {settings.video}")
    if result.failed is not None:
        say(f"failed: {result.failed} ({result.reason.value if result.reason else 'not open'})")
    return int(result.failed is not None)


def _setting(settings: Settings) -> _Setting:
    if settings.session is not None:
        replay = Replay(settings.session)
        about = replay.about
        try:
            judge = replay.opened if about["judged"] else None
            camera, policy, seed = np.array(about["T_base_camera"]), str(about["policy"]), int(about["seed"])
            arm = named_arm(str(about["arm"]))
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{settings.session}/session.json does not say what was run: {error}") from error
        if policy == "expert":
            raise UserError("a session of the expert cannot be replayed: the truth that it saw is not recorded")
        return _Setting(replay, arm, camera, policy, seed, judge)
    arm = named_arm(settings.arm)
    calibration = None if settings.calibration is None else _calibration(settings.calibration)
    if settings.driver != "simulated":
        assert calibration is not None
        driver = _own(settings.driver)
        driver = driver if settings.allow_motion else Resting(driver)
        return _Setting(driver, arm, np.array(calibration["T_base_camera"]), settings.policy, settings.seed)
    off = None
    if calibration is not None:
        if "truth" not in calibration:
            raise UserError(f"{settings.calibration} is of a real camera; in the simulated cell give one of its own")
        off = np.linalg.inv(calibration["truth"]["T_base_camera"]) @ np.array(calibration["T_base_camera"])
    content = on_table(_object(settings.object, settings.seed), settings.seed, settings.part)
    suction = cast(Literal["seal", "perfect"], settings.suction)
    options = CellOptions(noise=PRESETS[settings.noise], suction=suction)
    cell = SimulatedCell(arm, content, options, session=settings.seed, seed=settings.seed, error=off)
    return _Setting(cell, arm, cell.believed, settings.policy, settings.seed, lambda: cell.distance() < OPEN, cell)


def _calibration(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
        pose = np.array(content["T_base_camera"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no calibration: calibrate writes one ({' '.join(str(error).split())})") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1.0) > 1e-3:
        raise UserError(f"{path}: T_base_camera is no pose, 4 x 4")
    return content


def _own(name: str) -> Driver:
    """The driver that a function ``package.module:make`` makes."""
    if ":" not in name:
        raise UserError(f"--driver {name} is unknown; choose simulated or recorded, or give package.module:make")
    try:
        driver = resolve_name(name)()
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"--driver {name} cannot be made: {error}") from error
    if not isinstance(driver, Driver):
        lacks = [key for key in ("joints", "wrench", "move", "suction", "picture") if not hasattr(driver, key)]
        raise UserError(f"--driver {name} makes no driver: it lacks {', '.join(lacks)}")
    return driver


def _object(name: str, seed: int) -> ArticulatedObject:
    if name in FAMILIES:
        with tempfile.TemporaryDirectory() as folder:
            generate(Path(folder), [name], 1, seed=seed)
            return find_objects(folder)[0]
    if not Path(name).is_dir():
        raise UserError(f"--object {name} is neither a folder nor one of {', '.join(FAMILIES)}")
    return find_objects(name)[0]
