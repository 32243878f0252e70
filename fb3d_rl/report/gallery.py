"""Trials as a report's page shows them: films of some, a list of all, and filters that hold for both."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.failures import in_order
from fb3d_rl.evaluation.runs import Run
from fb3d_rl.report.page import Block, Film, Filter, Gallery, Shown
from fb3d_rl.rollout.rows import TrialRow, film_name

VIDEO_BYTES = 5_000_000
"""Videos inside the page: base64 makes a third more of it, and plotly.js takes another 5 MB."""

STRIP_BYTES = 1_000_000
"""Filmstrips inside the page, of films whose video would be too much."""

_STRIP_WIDTH = 1200
"""Width (pixels) of a filmstrip inside the page."""


def films(run: Run) -> dict[TrialRow, Path]:
    """Paths without suffix of the films of a run's trials."""
    folder = run.path / "videos"
    names = {path.name[:-4] for path in folder.glob("*.*") if path.suffix in (".mp4", ".png")}
    named = {row: film_name(row) for row in run.rows}
    return {row: folder / name for row, name in named.items() if name in names}


def gallery(trials: Sequence[Shown]) -> list[Block]:
    """Films and the list of all trials below one bar of filters; nothing without trials.

    Raises:
        UserError: a film cannot be read.
    """
    if not trials:
        return []
    filmed = {number: trial.film for number, trial in enumerate(trials) if trial.film is not None}
    inside = _inside(filmed)
    return [Gallery(trials, inside, len(filmed) - len(inside), _filters(trials))]


def _filters(trials: Sequence[Shown]) -> list[Filter]:
    """Lists that choose trials; none where there is but one choice."""
    success = Counter(trial.outcome for trial in trials)
    ends = in_order([trial.end for trial in trials if not trial.row.success])
    outcome: list[tuple[str, Mapping[str, int]]] = [
        ("success", {name: success[name] for name in ("opened", "failed") if name in success}),
        ("reason", ends),
    ]
    category = Counter(trial.row.category for trial in trials)
    policy = Counter(trial.policy for trial in trials)
    found: list[Filter] = [
        ("outcome", "all outcomes", outcome),
        ("category", "all categories", [("category", dict(sorted(category.items())))]),
        ("policy", "all policies", [("policy", policy)]),
    ]
    return [one for one in found if sum(len(choices) for _, choices in one[2]) > 1]


def _inside(filmed: Mapping[int, Path]) -> dict[int, Film]:
    """The videos that fit into :data:`VIDEO_BYTES`, filmstrips of the others as :data:`STRIP_BYTES` hold them."""
    found = {}
    videos, strips = VIDEO_BYTES, STRIP_BYTES
    try:
        for number, film in filmed.items():
            video, picture = (film.parent / f"{film.name}{suffix}" for suffix in (".mp4", ".png"))
            if video.is_file() and video.stat().st_size <= videos:
                content = video.read_bytes()
                videos -= len(content)
                found[number] = Film(content, video=True)
            elif picture.is_file():
                content = _small(picture)
                if len(content) <= strips:
                    strips -= len(content)
                    found[number] = Film(content, video=False)
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
