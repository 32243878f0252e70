"""Sessions of a robot on disk: what a driver was asked and answered, and a driver that answers the same again.

A folder holds ``session.json`` (what the session was, see :class:`Recorder`), ``calls_0000.npz`` and so on (a row for
each call, in turn), and of each picture ``picture_0000.npz`` (depth, m) and ``picture_0000.png`` (colour).
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing, write_text
from fb3d_rl.perception.depth import Intrinsics
from fb3d_rl.robot.driver import Driver, JointState, Picture, Wrench

Array = NDArray[np.float64]

CALLS = ("joints", "wrench", "move", "suction", "picture", "opened")
"""The five methods, and what somebody said; a row has the place of its one."""

ROWS = 2000
"""Rows in a file: so much is lost at most if the power fails."""

LARGEST = 2 * 2**30
"""Bytes after which a session is recorded no further, though the robot goes on."""

SAME = 1e-6
"""A command is the recorded one up to this, rad/s."""

FORMAT = 1


class Recorder:
    """A driver that passes everything on to another one, and writes it down.

    Args:
        driver: the other one.
        folder: to write to; it must not hold a session yet.
        about: what the session is: arm, camera, seed and so on, for :attr:`Replay.about`.
        largest: bytes after which nothing more is written.

    Raises:
        UserError: the folder holds a session.
    """

    def __init__(self, driver: Driver, folder: Path, about: dict[str, Any], largest: int = LARGEST) -> None:
        if (folder / "session.json").exists():
            raise UserError(f"{folder} holds a recorded session; name another folder")
        folder.mkdir(parents=True, exist_ok=True)
        self._driver, self._folder, self._left = driver, folder, largest
        self._rows: list[Array] = []
        self._files = self._pictures = 0
        write_text(folder / "session.json", json.dumps({"format": FORMAT, **about}, indent=1) + "\n")

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`, as for the other four."""
        state = self._driver.joints()
        self._write("joints", state.time, *state.position, *state.velocity)
        return state

    def wrench(self) -> Wrench:
        wrench = self._driver.wrench()
        self._write("wrench", *wrench.force, *wrench.moment)
        return wrench

    def move(self, velocity: Array) -> None:
        self._driver.move(velocity)
        self._write("move", *velocity)

    def suction(self, on: bool) -> bool:
        vacuum = self._driver.suction(on)
        self._write("suction", on, vacuum)
        return vacuum

    def picture(self) -> Picture:
        picture = self._driver.picture()
        if self._left > 0:
            name = self._folder / f"picture_{self._pictures:04d}"
            lens = np.array([*picture.lens[:4]])
            with replacing(name.with_suffix(".npz")) as part, part.open("wb") as file:
                np.savez_compressed(file, depth=picture.depth, lens=lens, time=picture.time)
            self._left -= name.with_suffix(".npz").stat().st_size
            if picture.colour is not None:
                Image.fromarray(picture.colour).save(name.with_suffix(".png"))
                self._left -= name.with_suffix(".png").stat().st_size
        self._write("picture", self._pictures)
        self._pictures += 1
        return picture

    def judged(self, opened: Callable[[], bool]) -> Callable[[], bool]:
        """What somebody says of whether the part is open, written down each time."""

        def answered() -> bool:
            answer = opened()
            self._write("opened", answer)
            return answer

        return answered

    def _write(self, name: str, *numbers: float) -> None:
        self._rows.append(np.array([CALLS.index(name), *numbers], dtype=np.float64))
        if len(self._rows) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Write the rows that are in memory; at the end, too."""
        if not self._rows or self._left <= 0:
            self._rows = []
            return
        path = self._folder / f"calls_{self._files:04d}.npz"
        lengths = np.array([len(row) for row in self._rows])
        with replacing(path) as part, part.open("wb") as file:
            np.savez_compressed(file, lengths=lengths, numbers=np.concatenate(self._rows))
        self._left -= path.stat().st_size
        self._files += 1
        self._rows = []


class Resting:
    """A robot that may be looked at and must not move.

    Args:
        driver: of the robot.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`, as for the other four."""
        return self._driver.joints()

    def wrench(self) -> Wrench:
        return self._driver.wrench()

    def move(self, velocity: Array) -> None:
        raise UserError("it was seen and planned only, and nothing moved: to move the robot give --allow-motion")

    def suction(self, on: bool) -> bool:
        return False

    def picture(self) -> Picture:
        return self._driver.picture()


class Replay:
    """A driver that answers as a recorded session did, to whoever asks the same.

    Args:
        folder: of a :class:`Recorder`.

    Attributes:
        about: what the session was.

    Raises:
        UserError: it holds no session, or a damaged one; and by each method: the recording ends, or goes on with
            another call or another command.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._next, self._pictures = folder, 0, 0
        try:
            self.about: dict[str, Any] = json.loads((folder / "session.json").read_text("utf-8"))
            self._calls: list[Array] = []
            for path in sorted(folder.glob("calls_*.npz")):
                with np.load(path) as rows:
                    self._calls += np.split(rows["numbers"], np.cumsum(rows["lengths"])[:-1])
        except FileNotFoundError as error:
            raise UserError(f"{folder} holds no recorded session: there is no session.json") from error
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise UserError(f"{folder} holds a damaged session: {' '.join(str(error).split())}") from error

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`, as for the other four."""
        time, *both = self._take("joints")
        position, velocity = np.split(np.array(both), 2)
        return JointState(position, velocity, float(time))

    def wrench(self) -> Wrench:
        force, moment = np.split(self._take("wrench"), 2)
        return Wrench(force, moment)

    def move(self, velocity: Array) -> None:
        recorded = self._take("move")
        if recorded.shape != np.shape(velocity) or not np.allclose(recorded, velocity, atol=SAME, rtol=0.0):
            raise UserError(
                f"the recorded session goes on with another velocity (call {self._next} of {len(self._calls)}): it was "
                f"made with other settings or another version"
            )

    def suction(self, on: bool) -> bool:
        recorded, vacuum = self._take("suction")
        if bool(recorded) != on:
            raise UserError(f"the recorded session switches the suction otherwise (call {self._next})")
        return bool(vacuum)

    def picture(self) -> Picture:
        name = self._folder / f"picture_{int(self._take('picture')[0]):04d}"
        try:
            with np.load(name.with_suffix(".npz")) as file:
                depth, lens, time = file["depth"], file["lens"], float(file["time"])
            colour = None
            if name.with_suffix(".png").exists():
                with Image.open(name.with_suffix(".png")) as image:
                    colour = np.asarray(image.convert("RGB"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise UserError(f"{name}.npz of the recorded session is missing or damaged") from error
        fx, fy, cx, cy = lens.tolist()
        return Picture(depth, colour, Intrinsics(fx, fy, cx, cy, depth.shape[1], depth.shape[0]), time)

    def opened(self) -> bool:
        """What was said at this point, in a session where somebody could tell."""
        return bool(self._take("opened")[0])

    def _take(self, name: str) -> Array:
        if self._next >= len(self._calls):
            raise UserError(f"the recorded session ends here, after {len(self._calls)} calls")
        kind, *numbers = self._calls[self._next]
        self._next += 1
        if CALLS[int(kind)] != name:
            raise UserError(
                f"the recorded session goes on with {CALLS[int(kind)]}, not {name} (call {self._next}): it was made "
                f"with other settings or another version"
            )
        return np.array(numbers)
