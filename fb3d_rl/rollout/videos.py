"""Videos and filmstrips of trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.drawing.bodies import TARGET
from fb3d_rl.drawing.signs import FAINT, FREE, HOLDING, INK, TRACK, font, hex_color
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

CAPTION = 40
"""Height (pixels) of the caption below them."""

STRIP_WIDTH = 1600
"""Width (pixels) of a filmstrip."""

HOLD = 1.0
"""How long (s) the last picture of a video is shown."""


def _title(film: Film) -> str:
    return f"{film.obj.category} {film.obj.id} · {film.obj.links[film.link].semantic} · {film.policy}"


def _state(film: Film, t: int) -> str:
    return f"step {t // film.per_step} · {100 * film.opened[t]:.0f} % {film.aim[0]}"


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
    width, height = size
    small, usual = font(12), font(13)
    middle = height + CAPTION // 2 + 2
    for t in range(len(film)):
        image = Image.new("RGB", (width, height + CAPTION), "white")
        image.paste(Image.fromarray(shot.picture(t)))
        draw = ImageDraw.Draw(image)
        draw.text((10, 8), _title(film), FAINT, small)
        draw.rectangle((0, height, width, height + 3), TRACK)
        draw.rectangle((0, height, round(width * float(film.opened[t])), height + 3), hex_color(TARGET))
        _draw_actors(draw, film, (0, 0, width, 5), t)
        draw.text((10, middle), _state(film, t), INK, usual, anchor="lm")
        word = "holding" if film.attached[t] else "not holding"
        draw.text((width - 10, middle), word, INK, usual, anchor="rm")
        x = width - 24 - draw.textlength(word, usual)
        draw.ellipse((x - 5, middle - 5, x + 5, middle + 5), hex_color(HOLDING if film.attached[t] else FREE))
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
    gap, line = width // 130, width // 70
    side = (width - gap * (len(shown) - 1)) // len(shown)
    shot = Shot(film, 2 * side, view=view)
    tall = shot.camera.size[1] // 2
    bold, usual = font(width // 100, bold=True), font(width // 114)
    top = round(1.4 * line)
    image = Image.new("RGB", (width, top + tall + 3 * line), "white")
    draw = ImageDraw.Draw(image)
    draw.text((0, 0), _title(film), FAINT, usual)
    for place, (name, t) in enumerate(shown):
        left, below = place * (side + gap), top + tall + line // 3
        picture = Image.fromarray(shot.picture(t)).resize((side, tall), Image.Resampling.BOX)
        image.paste(picture, (left, top))
        draw.text((left, below), name, INK, bold)
        draw.text((left, below + round(1.1 * line)), _state(film, t), FAINT, usual)
    if film.expert_acts is not None:
        _draw_actors(draw, film, (0, image.height - 8, width, image.height), len(film) - 1)
        share = 100 * film.expert_acts.mean()
        said = (
            f"below: who acted, from the first step to the last: the expert (dark, {share:.0f} %), the learner (light)"
        )
        draw.text((width, 0), said, FAINT, usual, anchor="ra")
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
