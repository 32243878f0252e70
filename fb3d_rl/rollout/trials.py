"""The schedule of an evaluation: every trial is listed, with its view and seed, before the first one runs."""

from __future__ import annotations

import hashlib
import itertools
import json
import zlib
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.cache import content_digest
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import Trial, default_trial
from fb3d_rl.errors import UserError
from fb3d_rl.rollout.options import ScheduleOptions
from fb3d_rl.scene.observer import find_view
from fb3d_rl.scene.posed import Posed


@dataclass(frozen=True)
class Scheduled:
    """A trial with what its row tells about it."""

    trial: Trial
    category: str
    split: str
    link: str
    semantic: str
    joint_type: str
    repeat: int = 0


def trial_key(obj: ArticulatedObject, trial: Trial, hold: str) -> str:
    """What a trial is, as a digest (16 hexadecimal digits): two rows with the same key ran the same trial.

    Args:
        obj: the trial's object, of which the id and the content count.
        trial: the trial.
        hold: what suction may hold (:class:`~fb3d_rl.env.options.SuctionOptions`).
    """
    whole = [obj.id, content_digest(obj), *astuple(trial), hold]  # astuple: every field, those to come as well
    return hashlib.sha256(json.dumps(whole).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def schedule(
    objects: Sequence[tuple[ArticulatedObject, str]],
    options: SampleOptions,
    seed: int,
    limit: int | None = None,
    how: ScheduleOptions | None = None,
) -> tuple[list[Scheduled], int]:
    """List one trial for every part that opens and can be seen.

    The view of a trial is drawn until the cloud shows the part (:func:`~fb3d_rl.scene.observer.find_view`). A trial
    depends on (seed, object, link, repetition) alone, not on the other objects.

    Args:
        objects: objects with their splits.
        options: points of a cloud, views and camera.
        seed: base seed.
        limit: at most this many trials, taken from the categories in turn.
        how: starts, goals and repetitions; the reference's, once, unless given.

    Returns:
        The trials, by category, object, link and repetition, and how many were left out because no view showed the
        part.
    """
    how = how or ScheduleOptions()
    found: dict[str, list[Scheduled]] = {}
    hidden = 0
    order = np.random.default_rng([seed, 2]).permutation(len(objects)).tolist()
    for obj, split in (objects[i] for i in order):
        if limit is not None and len(found.get(obj.category, ())) >= limit:
            continue
        posed = Posed(obj, options.camera)
        for link, repeat in itertools.product(posed.openable, range(how.repeats)):
            trial = _visible_trial(posed, link, options, seed, how, repeat)
            if trial is None:
                hidden += 1
                continue
            part = obj.links[link]
            item = Scheduled(trial, obj.category, split, part.name, part.semantic, obj.joint_of(link).type, repeat)
            found.setdefault(obj.category, []).append(item)
    turns = itertools.chain.from_iterable(itertools.zip_longest(*(found[c] for c in sorted(found))))
    chosen = [item for item in turns if item is not None][:limit]
    return sorted(chosen, key=lambda s: (s.category, s.trial.object, s.trial.link, s.repeat)), hidden


def _visible_trial(
    posed: Posed,
    link: int,
    options: SampleOptions,
    seed: int,
    how: ScheduleOptions = ScheduleOptions(),
    repeat: int = 0,
) -> Trial | None:
    rng = np.random.default_rng([seed, 3, zlib.crc32(posed.obj.id.encode()), link, *[repeat] * (repeat > 0)])
    number = int(rng.integers(2**31))
    drawn = how.draw(rng)
    trial = default_trial(posed.obj, link, None, number, **drawn)
    view, shown = find_view(posed, link, trial.start, options.views, rng, options.points)
    return replace(trial, view=view) if shown else None


BARREN = 100
"""Drawn trials in succession that bring nothing at which collecting them ends: fewer may just be bad luck."""


def draw_trials(objects: Sequence[Posed], options: SampleOptions, rng: np.random.Generator, count: int) -> list[Trial]:
    """Draw trials to train on: a category, an object of it and a part of that, each with equal odds, then a view.

    Args:
        objects: the objects.
        options: points of a cloud and views.
        rng: the named generator that draws.
        count: number of trials.

    Raises:
        UserError: no part opens, or the camera sees too little of every one.
    """
    by_category: dict[str, list[Posed]] = {}
    for posed in objects:
        if posed.openable:
            by_category.setdefault(posed.obj.category, []).append(posed)
    categories = sorted(by_category)
    if not categories:
        raise UserError("the objects have no part that opens; choose other objects")
    trials: list[Trial] = []
    for _ in range(100 * count):
        those = by_category[categories[rng.integers(len(categories))]]
        posed = those[rng.integers(len(those))]
        link = posed.openable[rng.integers(len(posed.openable))]
        trial = _visible_trial(posed, link, options, int(rng.integers(2**31)))
        if trial is not None:
            trials.append(trial)
        if len(trials) == count:
            return trials
    raise UserError("the camera sees too little of the parts that open; choose other objects or views")
