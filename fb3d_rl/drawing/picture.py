"""A still picture of clouds with their flow, for READMEs and for machines without a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fb3d_rl.files import replacing

ARROWS = 60
"""Flow arrows drawn on a cloud: enough to read the motion, few enough to see the cloud."""

LENGTH = 0.35
"""Length (m) of an arrow of flow 1."""


def write_picture(run_dir: Path, columns: int = 4) -> Path:
    """Draw the first clouds of ``clouds.npz``: true flow above, predicted flow below; write ``flow.png``.

    Args:
        run_dir: a run folder with clouds.npz.
        columns: number of clouds.

    Returns:
        The picture's path.
    """
    with np.load(run_dir / "clouds.npz") as clouds:
        data = {key: clouds[key] for key in clouds.files}
    columns = min(columns, len(data["title"]))
    figure = Figure(figsize=(3.4 * columns, 6.6), dpi=110)
    for row, key in enumerate(("flow_true", "flow_predicted")):
        for column in range(columns):
            axes = figure.add_subplot(2, columns, row * columns + column + 1, projection="3d")
            valid = data["valid"][column]
            _draw(axes, data["points"][column][valid], data["part_mask"][column][valid], data[key][column][valid])
            if row == 0:
                axes.set_title("\n".join(str(data["title"][column]).split(", ")[:2]), fontsize=9)
            if column == 0:
                label = "true flow" if row == 0 else "predicted flow"
                axes.text2D(-0.02, 0.5, label, transform=axes.transAxes, rotation=90, va="center", fontsize=11)
    figure.subplots_adjust(left=0.03, right=0.99, top=0.92, bottom=0.01, wspace=0.02, hspace=0.02)
    path = run_dir / "flow.png"
    with replacing(path) as part:
        figure.savefig(part, format="png")
    return path


def _draw(axes: object, points: NDArray[np.float32], part: NDArray[np.bool_], flow: NDArray[np.float32]) -> None:
    """One cloud from the camera's side: object grey, part blue, flow as orange arrows."""
    still, moving = points[~part], points[part]
    axes.scatter(*still.T, s=2.5, c="#b8bec6", depthshade=False)  # type: ignore[attr-defined]
    axes.scatter(*moving.T, s=3.5, c="#2f6fb2", depthshade=False)  # type: ignore[attr-defined]
    shown = np.flatnonzero(part)[:: max(1, int(part.sum()) // ARROWS)]
    axes.quiver(*points[shown].T, *(LENGTH * flow[shown]).T, color="#e07b1a", linewidth=0.9, arrow_length_ratio=0.3)  # type: ignore[attr-defined]
    drawn = np.concatenate([points, points[shown] + LENGTH * flow[shown]])
    centre = 0.5 * (drawn.min(0) + drawn.max(0))
    reach = 0.5 * float((drawn.max(0) - drawn.min(0)).max())
    for name, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{name}lim")(middle - reach, middle + reach)
    axes.view_init(elev=25, azim=-150)  # type: ignore[attr-defined]
    axes.set_box_aspect((1, 1, 1), zoom=1.35)  # type: ignore[attr-defined]
    axes.set_axis_off()  # type: ignore[attr-defined]
