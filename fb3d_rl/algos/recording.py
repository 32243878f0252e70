"""Episodes of a learner and a person who takes over, as rows of the format of a run's buffer."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from filelock import FileLock, Timeout
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.algos.collection import RowsOptions
from fb3d_rl.algos.learners import members
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import Key
from fb3d_rl.data.demonstrations import TABLE, DemonstrationBuffer, recorded
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.errors import UserError
from fb3d_rl.interrupt import Deferred
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import InteractivePolicy
from fb3d_rl.policies.learner import FLOW_KEYS, HAND_FEATURES
from fb3d_rl.rollout.demonstrations import Assets, episode_info, recipe
from fb3d_rl.settings import leaves

EPISODES = 400
"""Episodes of full length that a new folder has room for."""

NOT_MADE = "record=FOLDER goes on with a folder that it made itself: choose another one"
"""What to do about a folder of other data."""


def shared_rows(acting: TensorDictModuleBase, limits: VelocityLimits) -> RowsOptions:
    """What a row holds where a person watches a learner: what a run's row holds, and the learner's own action.

    Args:
        acting: the policy of an algorithm that imitates: the learner, or a learner with an oracle.
        limits: what action 1 means.
    """
    learner = acting.learner if isinstance(acting, InteractivePolicy) else acting
    assert learner is not None
    options = members(learner)[0].options
    written = [key for key in learner.out_keys if key[0] == "learner"]
    further: tuple[Key, ...] = (("learner", "action"), *written)
    return RowsOptions(limits, options.history, FLOW_KEYS[options.flow], further, guided=options.guided)


class Recording:
    """Adds whole episodes to a folder of demonstrations, a new one or one that it has made before.

    Each episode is on the disk when :meth:`add` returns, so that whatever ends the process loses the running trial
    only. A file beside the folder keeps other processes from recording into it.

    Args:
        folder: the folder.
        rows: what a row holds.
        env: the task's constants.
        fits: see :class:`~fb3d_rl.algos.algorithm.Acting`; it is also the number of the round, which a learner with so
            many fits behind it would act in.
        root: where the objects are; None if they are made for this session, and so have to be kept
            (:meth:`keep_object`).

    Attributes:
        keys: the entries of a step that it needs.

    Raises:
        UserError: the folder holds something else, or episodes with other rows or of another task, or has no room for
            another one, or another process records into it.
    """

    def __init__(self, folder: Path | str, rows: RowsOptions, env: EnvOptions, fits: int, root: str | None) -> None:
        self.keys = rows.keys()
        self._folder = Path(folder).expanduser().resolve()
        self._rows, self._env, self._fits = rows, env, fits
        self._objects = self._folder.with_name(f"{self._folder.name}_objects")
        self._root = root
        self._categories: dict[str, str] = {}
        self._copied: list[Path] = []
        self._lock = FileLock(self._folder.with_name(f".{self._folder.name}.lock"))
        try:
            self._folder.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
            try:
                self._buffer = self._opened()
                self.require_room()
            except BaseException:
                self._unlock()
                raise
        except Timeout as error:
            raise UserError(f"another process records into {folder}; end it, or choose another folder") from error
        except OSError as error:
            raise UserError(f"{folder} cannot be written ({error.strerror}); choose another folder") from error

    def keep_object(self, obj: ArticulatedObject) -> None:
        """Take note of an object, whose trials are to come; one that was made for this session is copied beside the
        folder, where ``launch/demos.py show`` finds it.
        """
        self._categories[obj.id] = obj.category
        copy = self._objects / obj.id
        if self._root is None and not copy.exists():
            self._copied.append(copy)
            shutil.copytree(obj.urdf.parent, copy)

    def require_room(self) -> None:
        """Check that another episode fits.

        Raises:
            UserError: it does not.
        """
        if self._buffer.capacity - len(self._buffer) < self._env.horizon:
            raise UserError(
                f"{self._folder} holds {len(self._buffer)} of the {self._buffer.capacity} steps that it has room for, "
                "so that another episode does not fit: choose another folder"
            )

    def add(self, frames: TensorDictBase, trial: Trial) -> None:
        """Keep the steps [T] of an episode, which hold :attr:`keys`, as a whole.

        Raises:
            UserError: the disk is full.
        """
        info = episode_info(trial, self._categories[trial.object], frames, self._fits)
        rows = recorded(self._rows.of(frames), info, beta=0.0, version=self._fits)
        with Deferred():
            self._buffer.extend(rows, info)
            self._buffer.commit()

    def close(self) -> None:
        """Let other processes record here; a folder that got no episode goes."""
        if not len(self._buffer):
            for made in (self._folder, *self._copied):
                shutil.rmtree(made)
            if self._copied and not any(self._objects.iterdir()):
                self._objects.rmdir()
        self._unlock()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _unlock(self) -> None:
        self._lock.release()
        Path(self._lock.lock_file).unlink(missing_ok=True)

    def _opened(self) -> DemonstrationBuffer:
        """The folder's buffer; see the class for what is refused."""
        about = recipe(self._env, Assets(root=self._root or str(self._objects)))
        if not self._folder.exists() or (self._folder.is_dir() and not any(self._folder.iterdir())):
            return DemonstrationBuffer.create(self._folder, EPISODES * self._env.horizon, about)
        if not (self._folder / TABLE).is_file():
            raise UserError(f"{self._folder} holds no demonstrations; {NOT_MADE}")
        buffer = DemonstrationBuffer.open(self._folder)
        held, wanted = buffer.keys, self._rows.kept()
        lacking = [key for key in wanted if key not in held]
        if len(buffer) and (lacking or len(held) > len(wanted)):
            what = f"lack {_said(lacking)}" if lacking else f"hold {_said([key for key in held if key not in wanted])}"
            raise UserError(f"the rows of {self._folder} {what}, unlike those of this learner; {NOT_MADE}")
        shape = held.get(("learner", "felt"), (None, None))[0]
        if shape is not None and tuple(shape) != (self._rows.history, HAND_FEATURES):
            raise UserError(
                f"the rows of {self._folder} hold {shape[0]} earlier steps of the hand, and this learner reads "
                f"{self._rows.history}; {NOT_MADE}"
            )
        before, now = (
            dict(leaves(json.loads(json.dumps(env)))) for env in (buffer.about.get("env") or {}, about["env"])
        )
        other = sorted(key for key in {*before, *now} - {"horizon"} if before.get(key) != now.get(key))
        if other:
            raise UserError(
                f"{self._folder} was recorded with {other[0]}={before.get(other[0])} in place of {now.get(other[0])}: "
                "give the same, or choose another folder"
            )
        return buffer


def _said(keys: list[Key]) -> str:
    """Keys as the documentation names them, the first three."""
    names = [key if isinstance(key, str) else ".".join(key) for key in keys]
    return ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
