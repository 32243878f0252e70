"""A page as plain data, and the file that the templates make of it.

All HTML is in the folder templates/, where every string is escaped; the blocks here hold text and numbers. A page
loads nothing: style, scripts (the folder web/) and plotly.js stand inside, and a content security policy forbids every
request.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import plotly.graph_objects as go
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.failures import end
from fb3d_rl.evaluation.tables import DISTANCE
from fb3d_rl.files import write_text
from fb3d_rl.rollout.rows import TrialRow

PALETTE = (
    "#3b7dd8", "#e0782f", "#2f9e77", "#a45bd0", "#c9a227", "#d1495b", "#4fa3b5", "#7d8597", "#9c6b3f", "#d96fb0",
    "#7aa43a", "#5b5fc7", "#c28f86", "#2aa8e0",
)  # fmt: skip
"""Colours of policies and runs, readable on light and dark ground."""


def color(index: int) -> str:
    """Colour of the policy or run with this place."""
    return PALETTE[index % len(PALETTE)]


# ---------------------------------------------------------------------------------------------------------- blocks


@dataclass(frozen=True)
class Heading:
    """A title within a section."""

    text: str


@dataclass(frozen=True)
class Note:
    """A sentence, such as how to read what follows, or what is wrong."""

    text: str
    wrong: bool = False


@dataclass(frozen=True)
class Source:
    """The text of a file."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Names and their values; a button copies the values of the names in ``copied``."""

    entries: Sequence[tuple[str, object]]
    copied: Container[str] = ()


@dataclass(frozen=True)
class Cards:
    """Headline numbers: (name, value, lines of small print) each."""

    entries: Sequence[tuple[str, str, Sequence[str]]]


@dataclass(frozen=True)
class Legend:
    """Names with their colours, for several figures."""

    entries: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Figure:
    """A plotly figure; ``id`` is unique on the page."""

    id: str
    content: Mapping[str, Any]

    @classmethod
    def of(cls, id_: str, plot: go.Figure) -> Figure:
        """The figure as plain data, in which NaN is None."""
        return cls(id_, json.loads(plot.to_json()))


@dataclass(frozen=True)
class Picker:
    """A line that says which box the points span that were clicked in the figures, as an option to copy.

    Attributes:
        prefix: what stands before its two corners.
    """

    prefix: str


@dataclass(frozen=True)
class Viewer:
    """Two linked 3D scenes, true next to predicted flow, on a narrow page one above the other.

    Attributes:
        clouds: per cloud "title"; "rest" and "part": coordinates of the points, three lists of n; "true" and
            "predicted": {"start", "vector"}, lists of a triples; "box": range of each axis, three pairs; "size":
            length (m) at which a flow of norm 1 is drawn.
    """

    clouds: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
        text: what it says; a line break in it stays one.
        small: small print below.
        word: whether it is aligned left, as words are.
        first: the first of a group of columns.
        color: of the policy or run that it names.
        columns: number of columns that it spans.
        rows: number of rows that it spans.
    """

    text: str
    small: str = ""
    word: bool = False
    first: bool = False
    color: str = ""
    columns: int = 1
    rows: int = 1


@dataclass(frozen=True)
class Row:
    """A row of a table, bold but for its small print where it holds means."""

    cells: Sequence[Cell]
    mean: bool = True


@dataclass(frozen=True)
class Table:
    """A table that sorts by the column whose head is clicked.

    Attributes:
        head: its rows of heads, of which those that span columns stand above the columns' own.
        bodies: the first body is what sorts, those below it (means) stay where they are.
        scroll: as high as a screen at most.
    """

    head: Sequence[Sequence[Cell]]
    bodies: Sequence[Sequence[Row]]
    scroll: bool = False

    @classmethod
    def plain(cls, names: Sequence[str], rows: Sequence[Row]) -> Table:
        """A table with these heads, of which the first column is words."""
        return cls([[Cell(name, word=i == 0) for i, name in enumerate(names)]], [rows])


@dataclass(frozen=True)
class Titled:
    """A block with a title of its own, in a grid."""

    title: str
    block: Block


@dataclass(frozen=True)
class Grid:
    """Blocks side by side, as many as fit."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class Choice:
    """One of several titled blocks, whichever a list of their titles names; the first to begin with."""

    label: str
    options: Sequence[tuple[str, Block]]


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

    @property
    def outcome(self) -> str:
        """What filters call a success or a failure."""
        return "opened" if self.row.success else "failed"

    @property
    def end(self) -> str:
        """How it ended, failures by their reason."""
        return end(self.row)

    @property
    def distance(self) -> str:
        """The normalized distance that is left, for people."""
        return DISTANCE.show(self.row.normalized_distance)


@dataclass(frozen=True)
class Film:
    """A film inside the page: an MP4 file, or a wide WebP picture of moments side by side."""

    content: bytes
    video: bool


Filter: TypeAlias = tuple[str, str, Sequence[tuple[str, Mapping[str, int]]]]
"""What a list chooses, the title of "all", and groups of choices: a field with the number of trials of each value."""


@dataclass(frozen=True)
class Gallery:
    """Films and the list of all trials below one bar of filters, which hold for both.

    Attributes:
        trials: all trials.
        films: films of the trials with these places.
        more: number of films that are not on the page.
        filters: lists that choose which trials are shown.
    """

    trials: Sequence[Shown]
    films: Mapping[int, Film]
    more: int
    filters: Sequence[Filter]


Block: TypeAlias = (
    Heading
    | Note
    | Source
    | Facts
    | Cards
    | Legend
    | Figure
    | Picker
    | Viewer
    | Table
    | Titled
    | Grid
    | Choice
    | Gallery
)
"""What a section is made of: the template blocks.html has a macro for each."""


# ------------------------------------------------------------------------------------------------------------ pages


@dataclass(frozen=True)
class Section:
    """A titled section; a page leaves out those without any block."""

    title: str
    blocks: Sequence[Block]

    @property
    def id(self) -> str:
        """What links name it by."""
        return re.sub(r"\W+", "-", self.title.lower())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _web(name: str) -> str:
    return Path(__file__).with_name("web").joinpath(name).read_text("utf-8")


_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters |= {"base64": _base64, "kind": lambda block: type(block).__name__}
_TEMPLATES.globals |= {"web": _web, "plotly_js": get_plotlyjs}
_TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False}


def render(template: str, **content: object) -> str:
    """The whole page that a template makes of ``content``."""
    return _TEMPLATES.get_template(template).render(content)


def write(path: Path, title: str, heading: str, header: Sequence[Block], sections: Sequence[Section]) -> Path:
    """Write a report's page.

    Args:
        path: where.
        title: of the browser's window.
        heading: of the page.
        header: blocks below the heading.
        sections: what follows.

    Raises:
        UserError: it cannot be written.
    """
    shown = [section for section in sections if section.blocks]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, render("report.html", title=title, heading=heading, header=header, sections=shown))
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror}.") from error
    return path
