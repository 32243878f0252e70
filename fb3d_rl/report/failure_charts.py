"""Where trials fail: the stages that they went through as a flow chart, and how they ended as stacked bars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from fb3d_rl.evaluation.failures import ENDS, HELD, NOT_FAR, SCHEDULED, TOUCHED, end, in_order, stages
from fb3d_rl.report.blocks import broken, literal
from fb3d_rl.report.page import Block, Choice, Figure, Grid, Legend, Titled
from fb3d_rl.rollout.rows import NEVER_HELD, NEVER_TOUCHED, TrialRow

_OTHER = "#7d8597"
"""Colour of an unknown end."""

_THROUGH = "rgba(128, 140, 158, 0.32)"
_STAGE = "#98a2b3"

_SHORT = {
    NEVER_HELD: "never held",
    NEVER_TOUCHED: "never touched",
    NOT_FAR: "not far enough",
}
"""Names of ends in the flow chart, short because the stage before is shown."""

_HEIGHT, _GAP = 270, 20
"""Height (pixels) of the flow chart, and of the gap between two nodes of it."""


def blocks(groups: Mapping[str, Sequence[TrialRow]]) -> list[Block]:
    """A flow chart for each group of trials, such as a policy's, and where there are several, bars beside each other.

    Args:
        groups: name -> its trials, at least one.
    """
    charts = [(name, flow_chart(f"stages-{i}", rows)) for i, (name, rows) in enumerate(groups.items())]
    if len(charts) > 2:
        # The expert's chart is the least interesting.
        chosen = sorted(charts, key=lambda chart: all(row.policy == "expert" for row in groups[chart[0]]))
        return [*bars("ends", groups), Choice("stages of the trials of", chosen)]
    titled = [Titled(name, chart) for name, chart in charts]
    return [Grid(titled)] * bool(charts) + (bars("ends", groups) if len(groups) > 1 else [])


def flow_chart(id_: str, rows: Sequence[TrialRow]) -> Figure:
    """The stages of one policy's trials: the width of a band is its number of trials."""
    steps: Counter[tuple[str, str]] = Counter()
    for row in rows:
        passed = stages(row)
        steps.update(zip(passed, passed[1:], strict=False))
    through = [name for name in (SCHEDULED, TOUCHED, HELD) if any(name in step for step in steps)]
    ends = in_order([end(row) for row in rows])
    entered = {name: sum(count for step, count in steps.items() if step[1] == name) for name in (*through, *ends)}
    counts = entered | {SCHEDULED: len(rows)}
    names = list(counts)
    x, y = _places(steps, counts)
    order = sorted(steps, key=lambda step: (names.index(step[1]), names.index(step[0])))
    plot = go.Figure(
        go.Sankey(
            arrangement="fixed",
            node={
                "label": [f"{literal(_SHORT.get(name, name))} {count}" for name, count in counts.items()],
                "color": [_STAGE if name in through else ENDS.get(name, _OTHER) for name in names],
                "align": "left",
                "x": x,
                "y": y,
                "pad": _GAP,
                "thickness": 10,
                "line": {"width": 0},
                "hovertemplate": "%{label}<extra></extra>",
            },
            link={
                "source": [names.index(a) for a, _ in order],
                "target": [names.index(b) for _, b in order],
                "value": [steps[step] for step in order],
                "color": [_THROUGH if b in through else _faint(ENDS.get(b, _OTHER)) for _, b in order],
                "customdata": [literal(f"{a} → {b}: {steps[a, b]} of {len(rows)}") for a, b in order],
                "hovertemplate": "%{customdata}<extra></extra>",
            },
        )
    )
    plot.update_layout(template="none", height=_HEIGHT + 30, margin={"l": 4, "r": 4, "t": 15, "b": 15})
    return Figure.of(id_, plot)


def _places(steps: Mapping[tuple[str, str], int], counts: Mapping[str, int]) -> tuple[list[float], list[float]]:
    """Centres of the chart's nodes, shares of its width and height: from the best to the worst at every stage.

    The last stage has the most room, since the names of its ends stand before them. Plotly's own layout leaves too
    little of it on a phone, and crosses bands.
    """
    column = {SCHEDULED: 0, TOUCHED: 1, HELD: 2}
    for before, after in steps:
        column.setdefault(after, column[before] + 1)
    members = [[name for name in counts if column[name] == k] for k in range(4)]
    scale = min((_HEIGHT - _GAP * (len(m) - 1)) / max(1, sum(counts[name] for name in m)) for m in members)
    centre = {}
    for names in members:
        top = 0.0
        for name in names:
            centre[name] = (top + 0.5 * scale * counts[name]) / _HEIGHT
            top += scale * counts[name] + _GAP
    return [(0.001, 0.29, 0.515, 0.999)[column[name]] for name in counts], [centre[name] for name in counts]


def _faint(shade: str) -> str:
    red, green, blue = (int(shade[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red}, {green}, {blue}, 0.5)"


def bars(id_: str, groups: Mapping[str, Sequence[TrialRow]]) -> list[Block]:
    """How the trials of each group ended: a stacked bar each, as shares of its trials.

    Args:
        id_: of the figure.
        groups: name -> its trials, at least one.
    """
    labels = [broken(name) for name in groups]
    counted = {name: in_order([end(row) for row in rows]) for name, rows in groups.items()}
    found = in_order([name for counts in counted.values() for name in counts])
    lines = max(1 + label.count("<br>") for label in labels)
    plot = go.Figure()
    for name in found:
        counts = [of_group.get(name, 0) for of_group in counted.values()]
        plot.add_bar(
            orientation="h",
            name=literal(name),
            y=labels,
            x=[count / len(rows) for count, rows in zip(counts, groups.values(), strict=True)],
            # No number where it is wider than its piece of the bar.
            text=[str(n) if n > 0.04 * len(rows) else "" for n, rows in zip(counts, groups.values(), strict=True)],
            textposition="inside",
            insidetextanchor="middle",
            textangle=0,
            textfont={"color": "#fff"},
            constraintext="none",
            marker={"color": ENDS.get(name, _OTHER), "line": {"width": 0}},
            customdata=counts,
            hovertemplate="%{y}: %{customdata} (%{x:.0%})<extra>" + literal(name) + "</extra>",
        )
    plot.update_layout(
        template="none",
        barmode="stack",
        bargap=0.3,
        height=52 + max(30, 10 + 16 * lines) * len(groups),
        margin={"l": 8, "r": 16, "t": 8, "b": 40},
        showlegend=False,
        xaxis={"tickformat": ".0%", "range": [0, 1.02], "title": {"text": "share of trials"}},
        yaxis={"autorange": "reversed", "automargin": True, "ticksuffix": "  "},
    )
    return [Legend([(name, ENDS.get(name, _OTHER)) for name in found]), Figure.of(id_, plot)]
