"""A session in which a learner acts, a person watches and takes over, and every step may be recorded."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import Key
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.errors import UserError
from fb3d_rl.live.moment import Contact
from fb3d_rl.live.person import Person, SharedPolicy
from fb3d_rl.live.session import Session
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.options import FlowPolicyOptions


class Recorder(Protocol):
    """Keeps episodes, such as :class:`fb3d_rl.algos.recording.Recording`."""

    keys: list[Key]
    """The entries of a step that it needs."""

    def require_room(self) -> None:
        """Check that another episode fits.

        Raises:
            UserError: it does not.
        """

    def add(self, frames: TensorDictBase, trial: Trial) -> None:
        """Keep the steps [T] of an episode as a whole.

        Raises:
            UserError: it cannot be written.
        """


class SharedSession(Session):
    """A :class:`Session` in which a learner acts, and a person takes over and hands back.

    The expert labels every step, from the true flow. A trial that ends, or that the person ends by a change or a reset,
    goes to the recorder as one episode; one that runs when the session is closed does not.

    Args:
        obj: the object.
        samples: points of a cloud, views and camera.
        env: the task's constants.
        policy: speeds and thresholds of the expert.
        acting: the learner, or a learner with an oracle, as an algorithm loads them.
        recorder: keeps the episodes, if they are to be kept.
        seed: of views and clouds.

    Attributes:
        person: whether the person is in charge.

    Raises:
        UserError: the object has no part that opens.
    """

    def __init__(
        self,
        obj: ArticulatedObject,
        samples: SampleOptions,
        env: EnvOptions,
        policy: FlowPolicyOptions,
        acting: TensorDictModuleBase,
        recorder: Recorder | None = None,
        seed: int = 0,
    ) -> None:
        self.person = Person()
        self._learner, self._recorder = acting, recorder
        self._steps: list[TensorDictBase] = []
        super().__init__(obj, samples, env, policy, seed=seed)

    # ------------------------------------------------------------------------------------------- what a person does

    def drag(self, position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> None:
        """Take over: from the next step on the hand is driven towards this pose of the suction tip in the world.

        Args:
            position: [3], m.
            wxyz: quaternion [4]; the spin about the hand's axis does not matter.

        Raises:
            UserError: no trial runs.
        """
        if self.trial is None or self.trial.done:
            raise UserError("no trial runs in which the hand could be dragged; press Step or Play")
        self.person.drag(torch.as_tensor(np.concatenate([position, wxyz]), dtype=torch.float64))
        self._picked = None
        self.moment = self._moment()

    def release(self) -> None:
        """Hand back: the learner acts from the next step on, and the expert chooses its contact point anew."""
        if not self.person.in_charge:
            return
        self.person.release()
        self._picked = None
        if self.trial is not None:
            self._frame["policy"] = FlowPolicy.choose_anew(self._frame["policy"])
        self.moment = self._moment()

    def pick(self, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> None:
        """Take over: the expert drives the hand to the point of the part that a ray hits, and pulls it from there.

        See :meth:`Session.pick`.
        """
        super().pick(origin, direction)
        self.person.point()
        self.moment = self._moment()  # without what a drag has hidden

    # ------------------------------------------------------------------------------------------------------ a trial

    @torch.no_grad()
    def step(self) -> None:
        """See :meth:`Session.step`; a trial's last step hands its episode to the recorder.

        Raises:
            UserError: as there, or the episode cannot be kept.
        """
        super().step()
        if self.trial is not None and self.trial.done:
            self.person.release()
            self._end()

    def _acting(self, flow_policy: FlowPolicy) -> SharedPolicy:
        return SharedPolicy(flow_policy, self._learner, self.person)

    def _begin(self) -> None:
        if self._recorder is not None:
            self._recorder.require_room()
        super()._begin()
        self._running = self._trial

    def _made(self, frame: TensorDictBase) -> None:
        acts = bool(frame["expert", "acts"])
        self._by = "person" if self.person.in_charge else "expert" if acts else "learner"
        if self._recorder is not None:
            self._steps.append(frame.select(*self._recorder.keys))

    def _end(self) -> None:
        """Hand the steps of the trial, if there are any, to the recorder."""
        steps, self._steps = self._steps, []
        if steps and self._recorder is not None:
            self._recorder.add(torch.cat(steps), self._running)

    def _observe(self) -> None:
        """A person's change ends a running trial; what it sets is seen also where the episode cannot be kept."""
        self.person.release()
        try:
            self._end()
        finally:
            super()._observe()

    def _contact(self) -> Contact | None:
        """None where the person drags: the expert heads for no point then."""
        return None if self.person.goal is not None else super()._contact()
