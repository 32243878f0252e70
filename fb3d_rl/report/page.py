"""The look of the reports: one self-contained HTML page with figures that follow the light or dark scheme.

The page loads nothing: style, scripts (the folder web/) and plotly.js stand inside, and a content security policy
forbids every request. Whatever is called body, block or cell is HTML already; :func:`text` makes strings from outside
harmless.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from importlib import resources
from typing import Any

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

PALETTE = (
    "#3b7dd8", "#e0782f", "#2f9e77", "#a45bd0", "#c9a227", "#d1495b", "#4fa3b5", "#7d8597", "#9c6b3f", "#d96fb0",
    "#7aa43a", "#5b5fc7", "#c28f86", "#2aa8e0",
)  # fmt: skip
"""Colours of policies and runs, readable on light and dark ground."""


def color(index: int) -> str:
    """Colour of the policy or run with this place."""
    return PALETTE[index % len(PALETTE)]


TRUE, PREDICTED, PART, STATIC = "#2f9e77", "#e0782f", "#3b7dd8", "#98a2b3"
"""Colours of the viewer: true flow, predicted flow, points of the target part, other points."""

_CSP = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; media-src data:"


def text(value: object) -> str:
    """A string from outside as HTML that shows it literally."""
    return html.escape(str(value))


def _json(value: object) -> str:
    # "<" would let a string close the script element.
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


# --------------------------------------------------------------------------------------------------------- figures


def figure(id_: str, plot: go.Figure) -> str:
    """A plotly figure as a block of the page."""
    return (
        f'<div class="panel"><div id="{id_}"></div></div>'
        f'<script type="application/json" data-figure="{id_}">{_safe_figure(plot)}</script>'
    )


def _safe_figure(plot: go.Figure) -> str:
    content: str = plot.to_json()  # turns NaN to null, unlike json
    return content.replace("<", "\\u003c")


def viewer(clouds: Sequence[dict[str, Any]]) -> str:
    """Two linked 3D scenes, true next to predicted flow, on a narrow page one above the other.

    Args:
        clouds: per cloud "title"; "rest" and "part": coordinates of the points, three lists of n; "true" and
            "predicted": {"start", "vector"}, lists of a triples; "box": range of each axis, three pairs; "size":
            length (m) at which a flow of norm 1 is drawn.
    """
    colors = {"rest": STATIC, "part": PART, "true": TRUE, "predicted": PREDICTED}
    names = (("part to open", PART), ("other points", STATIC), ("true flow", TRUE), ("predicted flow", PREDICTED))
    content = _json({"clouds": list(clouds), "colors": colors})
    return (
        '<div class="panel"><div class="bar"><button id="cloud-back" aria-label="previous cloud">‹</button>'
        '<select id="cloud-choice" aria-label="cloud"></select>'
        '<button id="cloud-next" aria-label="next cloud">›</button>'
        f'<button id="cloud-reset">reset view</button></div>{legend(names)}<div id="viewer"></div></div>'
        f'<script type="application/json" id="clouds">{content}</script>'
    )


# ---------------------------------------------------------------------------------------------------------- tables


def cell(value: str, small: str = "") -> str:
    """A cell with small print below."""
    return f"<td>{value}<small>{small}</small></td>"


def named(name: str, shade: str) -> str:
    """A cell with the name (plain text) and the colour of a policy or run."""
    return f'<td class="text named">{swatch(shade)}{text(name)}</td>'


def table(head: str, *bodies: str, scroll: bool = False) -> str:
    """A table that sorts by the column whose head is clicked.

    Args:
        head: its rows of heads, of which those with a ``colspan`` stand above the columns' own.
        bodies: rows; the first body is what sorts, those below it (means) stay where they are.
        scroll: as high as a screen at most.
    """
    content = "".join(f"<tbody>{body}</tbody>" for body in bodies)
    return (
        f'<div class="panel {"scroll" if scroll else "wide"}"><table class="sortable"><thead>{head}</thead>'
        f"{content}</table></div>"
    )


def plain_table(head: Sequence[str], body: str) -> str:
    """A table with these heads, plain text, of which the first column is text."""
    first, *others = head
    cells = f'<th class="text">{text(first)}</th>' + "".join(f"<th>{text(name)}</th>" for name in others)
    return table(f"<tr>{cells}</tr>", body)


# ----------------------------------------------------------------------------------------------- choices and filters


def choice(label: str, blocks: Sequence[tuple[str, str]]) -> str:
    """One of several titled blocks, whichever a list of their titles (plain text) names; the first to begin with."""
    if len(blocks) == 1:
        return blocks[0][1]
    options = "".join(f"<option>{text(title)}</option>" for title, _ in blocks)
    content = "".join(
        f'<div class="chosen"{" hidden" if i else ""}>{block}</div>' for i, (_, block) in enumerate(blocks)
    )
    return (
        f'<div class="choice"><div class="bar"><label>{text(label)} <select>{options}</select></label></div>'
        f"{content}</div>"
    )


def filters(fields: Iterable[tuple[str, str, Sequence[tuple[str, Mapping[str, int]]]]], noun: str, body: str) -> str:
    """Lists that choose which of a body's elements are shown, and the count of these.

    Args:
        fields: (what the list chooses, title of "all", groups of choices) of each list. A group is (field, choices
            with how many there are of each), plain text; it chooses elements with that ``data-<field>``.
        noun: what is counted, such as "trials".
        body: has the elements, those with a ``data-item``; the elements of one item share its value.
    """
    lists = ""
    for label, everything, groups in fields:
        options = f'<option value="">{text(everything)}</option>'
        for field, choices in groups:
            options += "".join(
                f'<option value="{text(f"{field}:{value}")}">{text(value)} ({count})</option>'
                for value, count in choices.items()
            )
        lists += f'<select aria-label="{text(label)}">{options}</select>'
    return f'<div class="filters"><div class="bar">{lists}<output data-noun="{text(noun)}"></output></div>{body}</div>'


def item(number: int, fields: Mapping[str, str]) -> str:
    """The attributes that make an element one of those that :func:`filters` shows or hides."""
    return f'data-item="{number}" ' + " ".join(f'data-{name}="{text(value)}"' for name, value in fields.items())


# ----------------------------------------------------------------------------------------------------------- others


def grid(blocks: Iterable[str], size: str = "") -> str:
    """Blocks side by side, as many as fit; ``size`` "small" fits more of them."""
    return f'<div class="grid {size}">{"".join(blocks)}</div>'


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def video(content: bytes) -> str:
    """An MP4 file inside the page."""
    source = _data("video/mp4", content)
    return f'<video controls muted loop playsinline preload="metadata" src="{source}"></video>'


def strip(title: str, content: bytes) -> str:
    """A wide WebP picture inside the page, which scrolls where the page is narrow; ``title`` is plain text."""
    return f'<div class="strip"><img alt="{text(title)}" src="{_data("image/webp", content)}"></div>'


def swatch(shade: str) -> str:
    """A dot in a policy's colour."""
    return f'<span class="dot" style="background:{shade}"></span>'


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """Names with their colours, for several figures; plain text."""
    return (
        f'<div class="legend">{"".join(f"<span>{swatch(shade)}{text(name)}</span>" for name, shade in entries)}</div>'
    )


def cards(entries: Iterable[tuple[str, str, Sequence[str]]]) -> str:
    """Headline numbers: (name, value, lines of small print) each, plain text."""
    return (
        '<div class="cards">'
        + "".join(
            f'<div class="card"><div class="name">{text(name)}</div><div class="value">{text(value)}</div>'
            f'<div class="more">{"<br>".join(map(text, more))}</div></div>'
            for name, value, more in entries
        )
        + "</div>"
    )


def facts(entries: Iterable[tuple[str, object]], copied: Container[str] = ()) -> str:
    """A list of names and values, plain text; values of the names in ``copied`` have a button that copies them."""
    shown = ""
    for name, value in entries:
        content = text(value)
        if name in copied:
            content = f'<code>{content}</code> <button class="copy" aria-label="copy {text(name)}">copy</button>'
        shown += f"<dt>{text(name)}</dt><dd>{content}</dd>"
    return f"<dl>{shown}</dl>"


# ------------------------------------------------------------------------------------------------------------ pages


def section(title: str, *blocks: str) -> str:
    """A titled section; nothing at all if every block is empty."""
    content = "".join(blocks)
    name = re.sub(r"\W+", "-", title.lower())
    return f'<section id="{name}"><h2>{text(title)}</h2>{content}</section>' if content else ""


def page(title: str, body: str) -> str:
    """The whole page. ``title`` is plain text, ``body`` HTML made by this module."""
    figures = "data-figure=" in body
    clouds = 'id="viewer"' in body
    scripts = [_web("tools.js")]
    if figures or clouds:
        scripts = [get_plotlyjs(), *scripts, _web("figures.js")]
    if clouds:
        scripts.append(_web("viewer.js"))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_CSP}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{_web('page.css')}</style></head>"
        f"<body>{_contents(body)}<main>{body}</main>"
        f"{''.join(f'<script>{script}</script>' for script in scripts)}</body></html>\n"
    )


def _contents(body: str) -> str:
    """A line of links to the sections of ``body``."""
    found = re.findall(r'<section id="([^"]+)"><h2>(.*?)</h2>', body)
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title in found)
    return f'<nav aria-label="sections"><div>{links}</div></nav>' if links else ""


def _web(name: str) -> str:
    return resources.files(__package__).joinpath("web", name).read_text("utf-8")
