"""A contact sheet of objects: each closed and open, with the axes of its joints."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.drawing.bodies import Body, Part, link_colors, srgb
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.signs import FAINT, INK, arrow_mesh, font
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.files import write_bytes
from fb3d_rl.kinematics.opening import openable_links, opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree
from fb3d_rl.report.page import render

SIZE = (220, 190)
"""Width and height (pixels) of one picture; an object has two of them, side by side."""

COLUMNS = 4
"""Objects in a row of a sheet."""

VIEW = View(azimuth=-32.0, elevation=26.0)
"""Where the pictures are taken from."""

AXIS = srgb("#e5383b")
"""Joint axes."""


def picture(obj: ArticulatedObject) -> NDArray[np.uint8]:
    """The object closed and open beside each other [H, 2 W, 3], from one camera; what opens is blue, its axes are red.

    An arrow lies on the axis of a hinge, which opens counter-clockwise about it, and points where a slider goes.
    """
    tree, stand = KinematicTree.from_object(obj), standing_pose(obj)
    openable = openable_links(obj)
    closed, opened = opening_range(obj)
    moves = np.array([link in openable for link in obj.movable], dtype=bool)
    states = [closed, np.where(moves, opened, closed)]
    poses = [stand @ tree.forward(torch.as_tensor(state)).numpy() for state in states]
    colors = link_colors(obj, *openable)
    bodies = [
        Body(Part(link.visuals, *look) for link, *look in zip(obj.links, colors, pose, strict=True)) for pose in poses
    ]
    length = 0.3 * float(np.linalg.norm(np.ptp(bodies[0].outline(), axis=0)))
    arrows = [_axes(obj, pose, openable, np.sign(opened - closed), length) for pose in poses]
    signs = [
        Body([Part(arrow_mesh(starts, ways, 0.05 * length), AXIS)] if len(starts) else [], sign=True)
        for starts, ways in arrows
    ]
    camera = Camera.fitting(VIEW, np.concatenate([body.outline() for body in (*bodies, *signs)]), SIZE)
    return np.concatenate(
        [Studio(camera, body).picture([(sign, np.eye(4))]) for body, sign in zip(bodies, signs, strict=True)], axis=1
    )


def _axes(
    obj: ArticulatedObject, poses: NDArray[np.float64], links: Sequence[int], sign: NDArray[np.float64], length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the arrows of these links' joints start and how they run, each [K, 3], m, world frame.

    The arrow of a hinge extends beyond its part at both ends, that of a slider starts at its part's middle.
    """
    starts, ways = [], []
    for link in links:
        joint, pose = obj.joint_of(link), poses[link]
        axis = sign[obj.movable.index(link)] * (pose[:3, :3] @ joint.axis)
        points = np.concatenate(
            [mesh.vertices @ poses[i][:3, :3].T + poses[i][:3, 3] for i in obj.descendants(link)
             for mesh in obj.links[i].visuals] or [pose[:3, 3][None]]
        )  # fmt: skip
        middle = 0.5 * (points.min(0) + points.max(0))
        if joint.type == "prismatic":
            starts.append(middle)
            ways.append(length * axis)
        else:
            along = (points - pose[:3, 3]) @ axis
            starts.append(pose[:3, 3] + (along.min() - 0.2 * length) * axis)
            ways.append((np.ptp(along) + 0.6 * length) * axis)
    return np.reshape(starts, (-1, 3)), np.reshape(ways, (-1, 3))


def _caption(obj: ArticulatedObject) -> str:
    """Such as "45135 · 2 drawer, 1 rotation_door"."""
    names = [obj.links[link].semantic for link in openable_links(obj)]
    counted = [f"{len(list(same))} {name}" for name, same in groupby(sorted(names))]
    return f"{obj.id} · {', '.join(counted) or 'nothing that opens'}"


def write_sheet(
    objects: Sequence[ArticulatedObject], out: Path, title: str, pictures: Sequence[NDArray[np.uint8]]
) -> None:
    """Write ``pictures``, one of each object, by category: a .png image, or a .html page that loads nothing.

    Args:
        objects: in the order of their categories.
        out: the file, .png or .html.
        title: the page's.
        pictures: as :func:`picture` makes them.
    """
    named = list(zip(objects, pictures, strict=True))
    groups = [(category, list(group)) for category, group in groupby(named, lambda item: item[0].category)]
    if all(len(group) == 1 for _, group in groups):  # a row for each would leave most of the sheet empty
        groups = [("One of each category", named)]
    if out.suffix == ".html":
        content = _html(groups, title).encode()
    else:
        buffer = io.BytesIO()
        _image(groups).save(buffer, "png")
        content = buffer.getvalue()
    write_bytes(out, content)


Groups = list[tuple[str, list[tuple[ArticulatedObject, NDArray[np.uint8]]]]]


def _image(groups: Groups) -> Image.Image:
    width, height, gap, head, foot = 2 * SIZE[0], SIZE[1], 12, 34, 20
    rows = [(1 + (len(group) - 1) // COLUMNS) for _, group in groups]
    columns = min(COLUMNS, max(len(group) for _, group in groups))
    sheet = Image.new(
        "RGB",
        (columns * (width + gap) + gap, sum(head + n * (height + foot + gap) for n in rows) + gap),
        "white",
    )
    draw, bold, small, y = ImageDraw.Draw(sheet), font(16, bold=True), font(11), 0
    for (category, group), count in zip(groups, rows, strict=True):
        draw.text((gap, y + head - 8), category, INK, bold, anchor="ls")
        y += head
        for k, (obj, image) in enumerate(group):
            at = (gap + k % COLUMNS * (width + gap), y + k // COLUMNS * (height + foot + gap))
            sheet.paste(Image.fromarray(image), at)
            draw.text((at[0], at[1] + height + 4), _caption(obj), FAINT, small)
        y += count * (height + foot + gap)
    return sheet


def _html(groups: Groups, title: str) -> str:
    tiles = [(name, [(_caption(obj), _webp(image)) for obj, image in group]) for name, group in groups]
    return render("sheet.html", title=title, groups=tiles)


def _webp(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "webp", quality=85)
    return buffer.getvalue()
