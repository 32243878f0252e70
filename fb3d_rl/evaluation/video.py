"""Videos and filmstrips of trials, drawn on the CPU: the part to open in blue, its flow as orange arrows."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import imageio_ffmpeg
import matplotlib
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.shade import GRIPPER, TARGET, Body, Camera, Color, Part, Placed, Studio, link_colors, srgb
from fb3d_rl.camera.views import View, look_at
from fb3d_rl.children import withheld
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.film import Film, record
from fb3d_rl.evaluation.rows import TrialRow, film_name
from fb3d_rl.evaluation.tables import own_policy
from fb3d_rl.evaluation.trials import Scheduled
from fb3d_rl.files import replacing
from fb3d_rl.flow.opening import standing_bounds
from fb3d_rl.geometry.points import farthest_point_sample

SIZE = (480, 360)
"""Width and height (pixels) of a video's pictures."""

CAPTION = 40
"""Height (pixels) of the caption below them."""

STRIP_WIDTH = 1600
"""Width (pixels) of a filmstrip."""

HOLD = 1.0
"""How long (s) the last moment of a video stays."""

ARROWS = 26
"""Flow arrows on the part."""

VIEWS = tuple(
    View(azimuth, elevation) for elevation in (22.0, 34.0) for azimuth in (-35.0, 35.0, -20.0, 20.0, -55.0, 55.0)
)
"""Directions that a film may be drawn from, beside the one of the policy's camera."""


FREE, HOLDING, FLOW = srgb("#e5383b"), srgb("#14c99a"), srgb("#ff8c1a")
INK, FAINT, TRACK = "#22262b", "#6b7480", "#dfe4ea"


# ------------------------------------------------------------------------------------------------------ pictures


class Shot:
    """A film's bodies before a camera that sees all of what happens.

    Args:
        film: the film.
        width: of the pictures, pixels.
        height: of the pictures, pixels; between 0.8 and 1.3 times the width, as the scene calls for, unless given.
        view: direction to look from; the one that shows the part's motion best unless given.
    """

    def __init__(self, film: Film, width: int, height: int | None = None, view: View | None = None) -> None:
        self.film = film
        count = len(film.obj.links)
        # The suction cup, the last body, moves with the hand, the first after the links.
        poses = np.concatenate([film.poses, film.poses[:, [count]]], axis=1)
        meshes = [*(link.visuals for link in film.obj.links), *film.gripper, [cup_mesh(film.gripper)]]
        colors = [*link_colors(film.obj, film.link), *[GRIPPER] * 3]

        def bodies(groups: Sequence[Sequence[int]], cup: Color = FREE) -> list[tuple[Body, int]]:
            made = []
            for members in groups:
                to_body = np.linalg.inv(poses[0, members[0]])
                parts = [Part(meshes[i], [*colors, cup][i], to_body @ poses[0, i]) for i in members]
                made.append((Body(parts, opaque=members[0] >= count), members[0]))
            return made

        # The object's root stands still, and so does all that is fixed to it.
        standing, *sliding = _rigid_groups(poses, range(count))
        self._still = Body(Part(meshes[i], colors[i], poses[0, i]) for i in standing)
        self._parts = bodies(sliding)
        gripper = _rigid_groups(poses, range(count, count + 4))
        self._gripper = {held: bodies(gripper, HOLDING if held else FREE) for held in (False, True)}
        self._anchors = _anchors(film)
        bounds = standing_bounds(film.obj)
        self._centre, self._span = bounds.mean(0), float(np.linalg.norm(bounds[1] - bounds[0]))
        self._length = 0.14 * self._span
        self.view = view or self._best_view()
        extent = self._extent()
        if height is None:
            across, down = np.ptp(Camera.fitting(self.view, extent, (width, width)).project(extent), axis=0)
            height = round(width * float(np.clip(down / across, 0.8, 1.3)))
        self.camera = Camera.fitting(self.view, extent, (width, height))
        self._studio = Studio(self.camera, self._still)

    def _extent(self) -> NDArray[np.float64]:
        """Points [P, 3] (m) that have to be in the picture: the outlines of all bodies at all times, and arrows.

        A gripper that flies far off leaves the picture.
        """
        outlines = [self._still.outline()]
        around = np.linalg.norm(self.film.tips - self._centre, axis=-1) < 1.2 * self._span
        for _, t in moments(self.film):
            starts, flows = self.arrows(t)
            outlines.append(starts + self._length * flows)
        for body, leader in [*self._parts, *self._gripper[False]]:
            poses = self.film.poses[around if leader >= len(self.film.obj.links) else slice(None), leader]
            turned = np.einsum("tij,pj->tpi", poses[:, :3, :3], body.outline())
            outlines.append((turned + poses[:, None, :3, 3]).reshape(-1, 3))
        return np.concatenate(outlines)

    def _best_view(self) -> View:
        """The view that shows most of the flow, and the suction tip, at the film's moments."""
        film, views = self.film, (self.film.view, *VIEWS)
        scores = np.zeros(len(views))
        for _, t in moments(film):
            starts, flows = self.arrows(t)
            points = np.concatenate([film.tips[[t]], starts]).astype(np.float32)
            for number, view in enumerate(views):
                outward = -look_at(view, np.zeros(3), 1.0)[:3, 2].astype(np.float32)
                rays = np.tile(outward, (len(points), 1))
                hidden = self._still.blocks(np.eye(4), points + 0.02 * rays, rays, np.inf)
                # The gripper is left out: it hides little of the part, and the tip is its own.
                for body, leader in self._parts:
                    hidden |= body.blocks(film.poses[t, leader], points + 0.02 * rays, rays, np.inf)
                across = np.linalg.norm(np.cross(flows, outward), axis=-1)
                shown = float(~hidden[0]) + (across * ~hidden[1:]).sum() / max(len(flows), 1)
                # The root prefers a view that always shows something to one that shows much at times.
                scores[number] += np.sqrt(shown)
        return views[int(scores.argmax())]

    def arrows(self, t: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the flow's arrows start [A, 3] (m, on the part) and the flow there [A, 3], at moment ``t``."""
        film, pose = self.film, self.film.poses[t, self.film.link]
        starts = self._anchors @ pose[:3, :3].T + pose[:3, 3]
        points, flow = film.points[t][film.part[t]], film.flow[t][film.part[t]]
        if not len(points) or not len(starts):
            return np.zeros((0, 3)), np.zeros((0, 3))
        nearest = np.linalg.norm(starts[:, None] - points, axis=-1)
        chosen = nearest.argsort(axis=1, kind="stable")[:, :3]
        flows = flow[chosen].mean(1).astype(np.float64)
        # Arrows stand where the camera of the policy sees the part.
        seen = (nearest.min(1) < 0.08) & (np.linalg.norm(flows, axis=-1) > 0.12)
        return starts[seen], flows[seen]

    def picture(self, t: int) -> NDArray[np.uint8]:
        """The image [H, W, 3] of moment ``t``."""
        starts, flows = self.arrows(t)
        signs = Body([Part(arrow_mesh(starts, self._length * flows, 0.13 * self._length), FLOW)], sign=True)
        bodies = [*self._parts, *self._gripper[bool(self.film.attached[t])]]
        moving: list[Placed] = [(body, self.film.poses[t, leader]) for body, leader in bodies]
        return self._studio.picture([*moving, (signs, np.eye(4))])


def _rigid_groups(poses: NDArray[np.float64], among: Iterable[int], slack: float = 2e-3) -> list[list[int]]:
    """Bodies ``among`` those of ``poses`` [T, B, 4, 4], in groups whose members keep their places in the first's frame.

    The ``slack`` (m, or rad) is less than a pixel; the fingers have as much play.
    """
    groups: list[list[int]] = []
    for i in among:
        for group in groups:
            relative = np.linalg.inv(poses[:, group[0]]) @ poses[:, i]
            if np.ptp(relative, axis=0).max() < slack:
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def _anchors(film: Film) -> NDArray[np.float64]:
    """Points [A, 3] in the part's frame, spread over all of it that the policy's camera sees at some time."""
    seen = []
    for t in np.unique(np.linspace(0, len(film) - 1, 6).astype(int)):
        pose = film.poses[t, film.link]
        seen.append((film.points[t][film.part[t]] - pose[:3, 3]) @ pose[:3, :3])
    points = np.concatenate(seen)
    if not len(points):
        return points
    chosen = points[farthest_point_sample(torch.from_numpy(points)[None], ARROWS)[0].numpy()]
    gaps = np.linalg.norm(chosen[:, None] - chosen, axis=-1)
    return chosen[[bool((gaps[i, :i] > 0.01).all()) for i in range(len(chosen))]]


def _turned(profile: Sequence[tuple[float, float]], sections: int) -> Mesh:
    """The surface that a line of points (radius, height) makes when it turns about the z axis."""
    made = trimesh.creation.revolve(np.array(profile), sections=sections)
    return Mesh(np.asarray(made.vertices, dtype=np.float64), np.asarray(made.faces, dtype=np.int64))


def cup_mesh(gripper: Sequence[Sequence[Mesh]]) -> Mesh:
    """A suction cup at the fingers' ends, about the hand's x axis: only to be seen, not felt."""
    end = max(float(mesh.vertices[:, 0].max()) for meshes in gripper for mesh in meshes)
    made = _turned([(0, -0.06), (0.014, -0.06), (0.016, -0.04), (0.036, 0.002), (0, 0.002)], 24)
    return Mesh(made.vertices[:, [2, 0, 1]] + [end, 0, 0], made.faces)


_ARROW = _turned([(0, 0), (0.32, 0), (0.32, 1), (1, 1), (0, 2)], 8)
"""Shaft from height 0 to 1, head from 1 to 2; stretched for each arrow."""


def arrow_mesh(starts: NDArray[np.float64], vectors: NDArray[np.float64], radius: float) -> list[Mesh]:
    """A mesh of solid arrows with that head ``radius`` from ``starts`` [A, 3] along ``vectors`` [A, 3], m."""
    length = np.linalg.norm(vectors, axis=-1)[:, None]
    size = np.minimum(radius, length / 3)
    head = 2.2 * size
    along = vectors / length
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    x, y, z = _ARROW.vertices.T
    forward = np.minimum(z, 1) * (length - head) + np.maximum(z - 1, 0) * head + 0.02 * length
    vertices = starts[:, None] + forward[..., None] * along[:, None]
    vertices += size[..., None] * (x[:, None] * side[:, None] + y[:, None] * np.cross(along, side)[:, None])
    faces = _ARROW.faces + len(_ARROW.vertices) * np.arange(len(starts))[:, None, None]
    return [Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))]


# ------------------------------------------------------------------------------------------------------ captions


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """A font that comes with matplotlib, so that pictures are the same on all machines."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def _title(film: Film) -> str:
    return f"{film.obj.category} {film.obj.id} · {film.obj.links[film.link].semantic} · {film.policy}"


def _state(film: Film, t: int) -> str:
    return f"step {t} · {100 * film.opened[t]:.0f} % opened"


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
        draw.rectangle((0, height, round(width * float(film.opened[t])), height + 3), _hex(TARGET))
        draw.text((10, middle), _state(film, t), INK, usual, anchor="lm")
        word = "holding" if film.attached[t] else "not holding"
        draw.text((width - 10, middle), word, INK, usual, anchor="rm")
        x = width - 24 - draw.textlength(word, usual)
        draw.ellipse((x - 5, middle - 5, x + 5, middle + 5), _hex(HOLDING if film.attached[t] else FREE))
        yield np.asarray(image)


def _hex(color: Color) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)


def moments(film: Film) -> list[tuple[str, int]]:
    """Up to six moments that tell the film's story, in order, each with its name."""
    last = len(film) - 1
    if film.attached.any():
        contact = int(film.attached.argmax())
        far = np.linalg.norm(film.tips[:contact] - film.tips[contact], axis=-1) > 0.1
        before = int(np.flatnonzero(far)[-1]) if far.any() else 0
        gain = film.opened[last] - film.opened[contact]
        found = [("start", 0), ("pre-contact", before), ("contact", contact)]
        for name, share in (("one third", 1 / 3), ("two thirds", 2 / 3)):
            if gain > 0.3:
                reached = film.opened[contact:] - film.opened[contact] >= share * gain
                found.append((name, contact + int(reached.argmax())))
            else:
                t = contact + round(share * (last - contact))
                found.append((f"step {t}", t))
    else:
        found = [("start", 0)] + [(f"step {t}", t) for t in np.linspace(0, last, 6).round().astype(int)[1:-1].tolist()]
    end = ("opened" if film.success else "end", last)
    return [item for item, after in zip(found, [*found[1:], end], strict=True) if item[1] < after[1]] + [end]


# --------------------------------------------------------------------------------------------------------- files


def require_encoder() -> None:
    """Look for ffmpeg, so that a machine without it says so before any work.

    Raises:
        UserError: there is no ffmpeg.
    """
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError("videos need ffmpeg; install it, or leave videos out: evaluation.videos=0") from error


_ENCODERS: dict[str, tuple[str, str, list[str]]] = {
    # The colour matrix is named in the file: players guess differently.
    ".mp4": ("libx264", "yuv420p", ["-preset", "medium", "-crf", "20", "-movflags", "+faststart",
                                    "-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+bitexact,"
                                    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"]),
    ".gif": ("gif", "pal8", ["-vf", "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer"]),
}  # fmt: skip


def write_video(film: Film, path: Path, size: tuple[int, int] = SIZE, view: View | None = None) -> None:
    """Write the film in real time, the last moment held: H.264 that browsers play, or by its suffix a GIF.

    The same film gives the same bytes: one thread encodes, and neither date nor version goes into the file.

    Args:
        film: the film.
        path: ends in ``.mp4`` or ``.gif``.
        size: width and height of the pictures, even numbers of pixels; the caption comes below.
        view: see :class:`Shot`.
    """
    codec, pixels, options = _ENCODERS[path.suffix]
    same = [
        "-threads",
        "1",
        "-filter_threads",
        "1",
        "-map_metadata",
        "-1",
        "-fflags",
        "+bitexact",
        "-flags",
        "+bitexact",
    ]
    with replacing(path) as part:
        writer = imageio_ffmpeg.write_frames(
            part,
            (size[0], size[1] + CAPTION),
            fps=film.rate,
            codec=codec,
            pix_fmt_out=pixels,
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="error",
            output_params=options + same,
        )
        with withheld():
            writer.send(None)  # starts ffmpeg
        for image in frames(film, size, view):
            writer.send(image)
        for _ in range(round(HOLD * film.rate)):
            writer.send(image)
        writer.close()


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
    with replacing(path) as part:
        image.save(part)


def trials_to_film(rows: Sequence[TrialRow], count: int) -> list[int]:
    """Numbers of ``count`` trials, spread over the categories: half of them failed, where there are as many.

    What counts is how the run's own policy did; its crashed trials are left out.
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
        folder: is made if need be.
        rows: what became of the trials; those that crashed are not filmed.
        count: how many trials, see :func:`trials_to_film`.
        policies: name -> policy, as the rows name them.
        objects: the objects that the trials name.
        scheduled: the trials.
        options: the task's constants.
        progress: called with how many films are done, and of how many.
    """
    chosen = set(trials_to_film(rows, count))
    wanted = [row for row in rows if row.trial in chosen and row.status == "ok"]
    by_id = {obj.id: obj for obj in objects}
    views: dict[int, View] = {}
    folder.mkdir(parents=True, exist_ok=True)
    for done, row in enumerate(wanted):
        progress(done, len(wanted))
        film = record(row.policy, policies[row.policy], by_id[row.object], scheduled[row.trial].trial, options)
        name = film_name(row)
        # All policies are seen from the same side.
        if row.trial not in views:
            views[row.trial] = Shot(film, *SIZE).view
        write_video(film, folder / f"{name}.mp4", SIZE, views[row.trial])
        write_filmstrip(film, folder / f"{name}.png", view=views[row.trial])
    progress(len(wanted), len(wanted))
