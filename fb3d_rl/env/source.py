"""The objects that an environment's trials may be of, and the trials that it draws of them by itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.env.model import Model
from fb3d_rl.env.options import EnvOptions, Trial, default_trial, drawn_fraction
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.scene.observer import find_view


class TrialSource:
    """Objects, each computed once, and trials of them.

    Args:
        objects: the objects.
        link: name of the link to open; any unless given.
        options: the task's constants.

    Raises:
        UserError: there is no object, or none has something to open.
    """

    def __init__(self, objects: Iterable[ArticulatedObject], link: str | None, options: EnvOptions) -> None:
        self.objects = {obj.id: obj for obj in objects}
        self.link = link
        self._options = options
        self._models: dict[str, Model] = {}
        if not self.objects:
            raise UserError("the environment has no object; give it at least one")
        if not any(self._to_open(obj, openable_links(obj)) for obj in self.objects.values()):
            raise self._nothing_opens()

    def model(self, name: str) -> Model:
        """The object of this id.

        Raises:
            UserError: there is none.
        """
        if name not in self.objects:
            raise UserError(f"the trial's object {name!r} is not among the environment's {len(self.objects)} objects")
        if name not in self._models:
            self._models[name] = Model(self.objects[name], self._options)
        return self._models[name]

    def draw(self, rng: np.random.Generator, name: str | None = None, view: View | None = None) -> Trial:
        """Draw a trial, from a view that shows the part if one is found.

        Args:
            rng: the generator that draws.
            name: id of the object; any unless given.
            view: the view; drawn unless given.

        Raises:
            UserError: nothing of the object can be opened.
        """
        names = list(self.objects) if name is None else [name]
        for i in rng.permutation(len(names)):
            model = self.model(names[i])
            links = self._to_open(model.obj, model.openable)
            if links:
                break
        else:
            raise self._nothing_opens()
        link, seed = int(rng.choice(links)), int(rng.integers(2**31))
        trial = default_trial(model.obj, link, None, seed, drawn_fraction(self._options.start, rng))
        views = self._options.views if view is None else ViewRange((view.azimuth,) * 2, (view.elevation,) * 2)
        # Here a part is visible if the whole picture shows enough of it.
        return replace(trial, view=find_view(model, link, trial.start, views, rng, count=None)[0])

    def _to_open(self, obj: ArticulatedObject, links: Sequence[int]) -> list[int]:
        """Those of an object's openable links that the environment opens."""
        return [i for i in links if self.link in (None, obj.links[i].name)]

    def _nothing_opens(self) -> UserError:
        what = "no part that opens" if self.link is None else f"no part that opens and is called {self.link!r}"
        return UserError(f"the objects have {what}; choose other objects: {', '.join([*self.objects][:5])}")
