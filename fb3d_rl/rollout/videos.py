"""Videos and filmstrips of trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.drawing.caption import CAPTION, Still, captioned, filmstrip, still_width
from fb3d_rl.drawing.signs import FAINT, TRACK, font
from fb3d_rl.drawing.video import encode
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.files import replacing
from fb3d_rl.rollout.film import Film, record
from fb3d_rl.rollout.rows import TrialRow, film_name, own_policy
from fb3d_rl.rollout.shot import Shot, moments
from fb3d_rl.rollout.trials import Scheduled

EXPERT, LEARNER = "#3b4252", "#e8a33d"
"""Colours of the bar that says who acted."""

SIZE = (480, 360)
"""Width and height (pixels) of a video's pictures."""

STRIP_WIDTH = 1600
"""Width (pixels) of a filmstrip."""

HOLD = 1.0
"""How long (s) the last picture of a video is shown."""


def _title(film: Film) -> str:
    return f"{film.obj.category} {film.obj.id} · {film.obj.links[film.link].semantic} · {film.policy}"


def _state(film: Film, t: int) -> str:
    return f"{film.moment(t)} · {100 * film.opened[t]:.0f} % {film.aim[0]}"


def _draw_actors(draw: ImageDraw.ImageDraw, film: Film, box: tuple[int, int, int, int], until: int) -> None:
    """A bar over the episode, left to right, up to step ``until``: who acted when."""
    if film.expert_acts is None:
        return
    left, top, right, bottom = box
    draw.rectangle(box, TRACK)
    for step, expert in enumerate(film.expert_acts[:until]):
        ends = [left + round((right - left) * place / len(film.expert_acts)) for place in (step, step + 1)]
        draw.rectangle((ends[0], top, ends[1], bottom), EXPERT if expert else LEARNER)


def frames(film: Film, size: tuple[int, int] = SIZE, view: View | None = None) -> Iterator[NDArray[np.uint8]]:
    """The film's pictures of that ``size`` with a caption below each: one for each moment, [H + CAPTION, W, 3]."""
    shot = Shot(film, *size, view)
    for t in range(len(film)):
        image = captioned(shot.picture(t), _title(film), _state(film, t), float(film.opened[t]), bool(film.attached[t]))
        _draw_actors(ImageDraw.Draw(image), film, (0, 0, size[0], 5), t)
        yield np.asarray(image)


def write_video(film: Film, path: Path, size: tuple[int, int] = SIZE, view: View | None = None) -> None:
    """Write the film in real time, the last picture a while longer; see :func:`fb3d_rl.drawing.video.encode`.

    Args:
        film: the film.
        path: ends in ``.mp4`` or ``.gif``.
        size: width and height of the pictures, even numbers of pixels; the caption comes below.
        view: see :class:`Shot`.
    """
    encode(frames(film, size, view), path, (size[0], size[1] + CAPTION), film.rate, HOLD)


def write_filmstrip(film: Film, path: Path, width: int = STRIP_WIDTH, view: View | None = None) -> None:
    """Write a PNG of that ``width`` (pixels): the film's :func:`moments` side by side, with a caption below each."""
    shown = moments(film)
    shot = Shot(film, 2 * still_width(len(shown), width), view=view)
    image = filmstrip([Still(name, _state(film, t), shot.picture(t)) for name, t in shown], _title(film), width)
    draw = ImageDraw.Draw(image)
    if film.expert_acts is not None:
        _draw_actors(draw, film, (0, image.height - 8, width, image.height), len(film) - 1)
        share = 100 * film.expert_acts.mean()
        said = (
            f"below: who acted, from the first step to the last: the expert (dark, {share:.0f} %), the learner (light)"
        )
        draw.text((width, 0), said, FAINT, font(width // 114), anchor="ra")
    with replacing(path) as part:
        image.save(part)


def trials_to_film(rows: Sequence[TrialRow], count: int) -> list[int]:
    """Numbers of ``count`` trials, spread over the categories; half of them failed, if there are enough.

    Success is that of the run's own policy; its crashed trials are left out.
    """
    own = own_policy(rows)
    mine = [row for row in rows if row.policy == own and row.status == "ok"]
    failed, opened = (_in_turn([row for row in mine if row.success == success]) for success in (False, True))
    failures = max(min(len(failed), count // 2), count - len(opened))
    return sorted(failed[:failures] + opened[: count - len(failed[:failures])])


def _in_turn(rows: Sequence[TrialRow]) -> list[int]:
    """Numbers of the rows' trials, one of each category, then the next of each, and so on."""
    by_category: dict[str, list[int]] = {}
    for row in rows:
        by_category.setdefault(row.category, []).append(row.trial)
    return [trial for turn in zip_longest(*by_category.values()) for trial in turn if trial is not None]


def film_trials(
    folder: Path,
    rows: Sequence[TrialRow],
    count: int,
    policies: Mapping[str, TensorDictModuleBase],
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a video and a filmstrip of some trials with every policy below ``folder``.

    Args:
        folder: is made if it does not exist.
        rows: results of the trials; those that crashed are not filmed.
        count: how many trials, see :func:`trials_to_film`.
        policies: name -> policy, as the rows name them.
        objects: the objects that the trials name.
        scheduled: the trials.
        options: the task's constants.
        progress: called with the number of films that are done and of all films.
    """
    by_id = {obj.id: obj for obj in objects}

    def again(row: TrialRow) -> Film:
        return record(row.policy, policies[row.policy], by_id[row.object], scheduled[row.trial].trial, options)

    write_films(folder, rows, count, again, progress)


def write_films(
    folder: Path,
    rows: Sequence[TrialRow],
    count: int,
    again: Callable[[TrialRow], Film],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """As :func:`film_trials`, of trials that ``again`` runs and films."""
    chosen = set(trials_to_film(rows, count))
    wanted = [row for row in rows if row.trial in chosen and row.status == "ok"]
    views: dict[int, View] = {}
    folder.mkdir(parents=True, exist_ok=True)
    for done, row in enumerate(wanted):
        progress(done, len(wanted))
        film, name = again(row), film_name(row)
        # All policies are seen from the same side.
        if row.trial not in views:
            views[row.trial] = Shot(film, *SIZE).view
        write_video(film, folder / f"{name}.mp4", SIZE, views[row.trial])
        write_filmstrip(film, folder / f"{name}.png", view=views[row.trial])
    progress(len(wanted), len(wanted))
