"""Trials as a report's page shows them: films of some, a list of all, and filters that hold for both."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.failures import end, in_order
from fb3d_rl.evaluation.runs import Run
from fb3d_rl.evaluation.tables import DISTANCE
from fb3d_rl.report import page
from fb3d_rl.report.page import text
from fb3d_rl.rollout.rows import TrialRow, film_name

VIDEO_BYTES = 5_000_000
"""Videos inside the page: base64 makes a third more of it, and plotly.js takes another 5 MB."""

STRIP_BYTES = 1_000_000
"""Filmstrips inside the page, of films whose video would be too much."""

_STRIP_WIDTH = 1200
"""Width (pixels) of a filmstrip inside the page."""


@dataclass(frozen=True)
class Shown:
    """A trial of the page.

    Attributes:
        row: the trial.
        policy: the name of its policy on the page.
        color: of the policy.
        film: path of its video and its filmstrip without their suffixes, if it was filmed.
        seed: of the run.
    """

    row: TrialRow
    policy: str
    color: str
    film: Path | None
    seed: int | None


def films(run: Run) -> dict[TrialRow, Path]:
    """Paths without suffix of the films of a run's trials."""
    folder = run.path / "videos"
    names = {path.name[:-4] for path in folder.glob("*.*") if path.suffix in (".mp4", ".png")}
    named = {row: film_name(row) for row in run.rows}
    return {row: folder / name for row, name in named.items() if name in names}


def gallery(trials: Sequence[Shown]) -> str:
    """Films and the list of all trials below one bar of filters; nothing without trials.

    Raises:
        UserError: a film cannot be read.
    """
    if not trials:
        return ""
    filmed = {number: trial.film for number, trial in enumerate(trials) if trial.film is not None}
    inside = _inside(filmed)
    cards = [_card(number, trials[number], film) for number, film in inside.items()]
    more = len(filmed) - len(inside)
    body = page.grid(cards, "small") if cards else ""
    body += f'<p class="soft">{more} more in the folder videos/ of the run.</p>' if more else ""
    title = "<h3>All trials</h3>" if filmed else ""
    return page.filters(_fields(trials), "trials", body + title + _list(trials, inside))


def _fields(trials: Sequence[Shown]) -> list[tuple[str, str, list[tuple[str, Mapping[str, int]]]]]:
    """What :func:`fb3d_rl.report.page.filters` lets choose; no list where there is but one choice."""
    success = Counter(_success(trial) for trial in trials)
    ends = in_order([end(trial.row) for trial in trials if not trial.row.success])
    outcome: list[tuple[str, Mapping[str, int]]] = [
        ("success", {name: success[name] for name in ("opened", "failed") if name in success}),
        ("reason", ends),
    ]
    category = Counter(trial.row.category for trial in trials)
    policy = Counter(trial.policy for trial in trials)
    fields: list[tuple[str, str, list[tuple[str, Mapping[str, int]]]]] = [
        ("outcome", "all outcomes", outcome),
        ("category", "all categories", [("category", dict(sorted(category.items())))]),
        ("policy", "all policies", [("policy", policy)]),
    ]
    return [field for field in fields if sum(len(choices) for _, choices in field[2]) > 1]


def _success(trial: Shown) -> str:
    return "opened" if trial.row.success else "failed"


def _item(number: int, trial: Shown) -> str:
    fields = {"success": _success(trial), "category": trial.row.category, "policy": trial.policy}
    return page.item(number, fields if trial.row.success else fields | {"reason": end(trial.row)})


# ----------------------------------------------------------------------------------------------------------- films


def _inside(filmed: Mapping[int, Path]) -> dict[int, str]:
    """The videos that fit into :data:`VIDEO_BYTES`, filmstrips of the others as :data:`STRIP_BYTES` hold them."""
    found = {}
    videos, strips = VIDEO_BYTES, STRIP_BYTES
    try:
        for number, film in filmed.items():
            video, picture = (film.parent / f"{film.name}{suffix}" for suffix in (".mp4", ".png"))
            if video.is_file() and video.stat().st_size <= videos:
                content = video.read_bytes()
                videos -= len(content)
                found[number] = page.video(content)
            elif picture.is_file():
                content = _small(picture)
                if len(content) <= strips:
                    strips -= len(content)
                    found[number] = page.strip("moments of the trial, side by side", content)
    except OSError as error:
        raise UserError(f"Cannot read {film.parent}: {error}") from error
    return found


def _small(picture: Path) -> bytes:
    """A filmstrip as a small WebP file."""
    out = io.BytesIO()
    with Image.open(picture) as image:
        height = round(image.height * _STRIP_WIDTH / image.width)
        image.convert("RGB").resize((_STRIP_WIDTH, height)).save(out, "webp", quality=70)
    return out.getvalue()


def _outcome(trial: Shown) -> str:
    """The outcome in a word, with what a crashed trial crashed with."""
    row = trial.row
    if row.success:
        return '<span class="good">opened</span>'
    error = f'<span class="soft wrapped">{text(row.error)}</span>' if row.error else ""
    return f'<span class="error">{text(end(row))}</span>{error}'


def _card(number: int, trial: Shown, film: str) -> str:
    row = trial.row
    wide = " wide-film" if film.startswith("<div") else ""
    return (
        f'<figure class="panel{wide}" id="film-{number}" {_item(number, trial)}>{film}<figcaption>'
        f"<b>{text(row.category)} {text(row.object)}</b>, {text(row.semantic)}<br>"
        f"{page.swatch(trial.color)}{text(trial.policy)}<br>"
        f"{_outcome(trial)} · {row.steps} steps · {DISTANCE.show(row.normalized_distance)} left</figcaption></figure>"
    )


# ------------------------------------------------------------------------------------------------------------ list


def _list(trials: Sequence[Shown], filmed: Collection[int]) -> str:
    """A row for each trial, with a link to its film if that is on the page."""
    several_runs = len({trial.seed for trial in trials}) > 1
    several_splits = len({trial.row.split for trial in trials}) > 1
    columns: list[tuple[str, bool, Callable[[Shown], object]]] = [
        ("policy", True, lambda trial: page.swatch(trial.color) + text(trial.policy)),
        ("object", True, lambda trial: text(f"{trial.row.category} {trial.row.object}")),
        ("part", True, lambda trial: text(f"{trial.row.link} ({trial.row.semantic})")),
        ("outcome", True, _outcome),
        ("distance", False, lambda trial: DISTANCE.show(trial.row.normalized_distance)),
        ("steps", False, lambda trial: trial.row.steps),
        *[("split", True, lambda trial: text(trial.row.split))] * several_splits,
        *[("run's seed", False, lambda trial: "–" if trial.seed is None else trial.seed)] * several_runs,
        ("seed", False, lambda trial: trial.row.seed),
    ]
    head = "".join(f"<th{_class(word)}>{text(name)}</th>" for name, word, _ in columns)
    rows = ""
    for number, trial in enumerate(trials):
        cells = "".join(f"<td{_class(word)}>{show(trial)}</td>" for _, word, show in columns)
        film = f'<a href="#film-{number}">film</a>' if number in filmed else ""
        rows += f"<tr {_item(number, trial)}><td>{trial.row.trial}</td>{cells}<td>{film}</td></tr>"
    return page.table(f"<tr><th>trial</th>{head}<th></th></tr>", rows, scroll=True)


def _class(word: bool) -> str:
    return " class=text" if word else ""
