"""The live page on which a learner acts and a person takes over: a handle at the hand, and a button that hands back."""

from __future__ import annotations

from typing import Any

import numpy as np

from fb3d_rl.live.moment import Moment
from fb3d_rl.live.page import Page
from fb3d_rl.live.shared import SharedSession

WHO = {
    "learner": "The **learner** acts.",
    "expert": "The **expert** drives to the contact point.",
    "": "The **learner** acts as soon as you press Play or Step.",
}
"""What is said about who makes the steps while the person does not."""

HOW = "To take over drag the handle at the hand, or click a contact point on the blue part."
"""What is said as long as the person may take over."""


class SharedPage(Page):
    """The :class:`~fb3d_rl.live.page.Page` of a :class:`~fb3d_rl.live.shared.SharedSession`.

    The handle stays at the hand, or while the person drags where it was dragged, and the hand follows.

    Args:
        server: a ``viser.ViserServer``.
        session: the session to show.
    """

    def __init__(self, server: Any, session: SharedSession) -> None:
        self._shared = session
        # Without sliders, which cannot be told from the arrows, and drawn over the hand that it stands in.
        self._handle = server.scene.add_transform_controls(
            "/handle", scale=0.12 * session.size, disable_sliders=True, depth_test=False, visible=False
        )
        self._handle.on_update(lambda _: self._dragged())
        super().__init__(server, session)

    def _dragged(self) -> None:
        position, wxyz = (np.array(value, dtype=np.float64) for value in (self._handle.position, self._handle.wxyz))
        self._request("drag", lambda: self._shared.drag(position, wxyz))

    def _controls(self) -> None:
        gui = self._server.gui
        with gui.add_folder("A person takes over"):
            self._who = gui.add_markdown("")
            self._release = gui.add_button("Release", disabled=True)
            self._release.on_click(lambda _: self._request("release", self._shared.release))
        super()._controls()
        self._acts_on.visible = False  # the learner acts on what it was trained with

    def _place(self, moment: Moment) -> None:
        super()._place(moment)
        self._handle.visible = moment.trial is not None and not moment.trial.done
        if self._shared.person.goal is None:
            self._handle.position, self._handle.wxyz = moment.tip[:3], moment.tip[3:]

    def _write(self, moment: Moment) -> None:
        super()._write(moment)
        self._measured.content = "The expert labels each step by the true flow."
        person, trial = self._shared.person, moment.trial
        self._release.disabled = not person.in_charge
        if trial is not None and trial.done:
            self._who.content = "The trial is over; press Reset for another one."
        elif person.in_charge:
            what = "the expert drives to your point" if person.pointed else "the hand follows the handle"
            self._who.content = f"**You** act: {what}, until you press Release."
        else:
            self._who.content = f"{WHO[trial.by if trial is not None and trial.by in WHO else '']} {HOW}"
