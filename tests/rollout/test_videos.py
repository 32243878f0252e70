"""Films of trials: the same episode again, pictures that show what happened, files that play and repeat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.drawing import bodies, signs, video
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.rollout import videos
from fb3d_rl.rollout.film import Film, record
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.rollout.run import run_trials
from fb3d_rl.rollout.shot import Shot, moments
from fb3d_rl.rollout.trials import schedule
from fb3d_rl.rollout.videos import (
    CAPTION,
    HOLD,
    film_trials,
    frames,
    trials_to_film,
    write_filmstrip,
    write_video,
)

SMALL = (160, 120)
OPENING = 0.5
CAMERA = CameraOptions(resolution=48)
OPTIONS = EnvOptions(points=300, camera=CAMERA, horizon=150)
LIMITS = VelocityLimits(OPTIONS.gripper.v_max, OPTIONS.gripper.w_max)


def box(extents: tuple[float, ...], at: tuple[float, ...] = (0, 0, 0)) -> Mesh:
    made = trimesh.creation.box(extents=extents)
    return Mesh(np.array(made.vertices) + at, np.array(made.faces, dtype=np.int64))


def drawer() -> ArticulatedObject:
    """A body of 1 m with a front before it, which slides out along -x."""
    slide = Joint("j", "prismatic", np.eye(4), np.array([-1.0, 0, 0]), (0.0, OPENING))
    links = (
        Link("body", "body", -1, None, (box((1, 1, 1), (0, 0, 0.5)),), ()),
        Link("front", "drawer", 0, slide, (box((0.1, 0.8, 0.4), (-0.55, 0, 0.5)),), ()),
    )
    return ArticulatedObject("made", "Test", Path("none"), links)


def made_film(flow: tuple[float, float, float] = (-1.0, 0.0, 0.0), rows: int = 4) -> Film:
    """Ten steps towards the drawer's front, which is held from step 10 on and opens by the end, at step 20."""
    steps = np.arange(21)
    opened = np.clip((steps - 10) / 10, 0, 1)
    poses = np.tile(np.eye(4), (21, 5, 1, 1))
    poses[:, 1, 0, 3] = -OPENING * opened
    tips = np.stack([-1.2 + 0.06 * np.minimum(steps, 10) - OPENING * opened, 0 * steps, 0.5 + 0 * steps], axis=-1)
    poses[:, 2:, :3, 3] = (tips - [0.12, 0, 0])[:, None]
    y, z = (a.reshape(-1) for a in np.meshgrid(np.linspace(-0.3, 0.3, rows), np.linspace(0.35, 0.65, rows)))
    points = np.zeros((21, len(y) + 1, 3))
    points[:, :-1] = np.stack([-0.6 + 0 * y, y, z], axis=-1) - np.array([1, 0, 0]) * OPENING * opened[:, None, None]
    part = np.ones(points.shape[:2], dtype=bool)
    part[:, -1] = False  # padding
    return Film(
        policy="made",
        obj=drawer(),
        link=1,
        view=View(20.0, 30.0),
        gripper=[
            [box((0.06, 0.05, 0.06), (0.01, 0, 0))],
            *[[box((0.08, 0.01, 0.02), (0.08, side, 0))] for side in (-0.005, 0.005)],
        ],
        poses=poses,
        tips=tips.astype(np.float32),
        points=points.astype(np.float32),
        part=part,
        flow=np.where(part[..., None], np.array(flow), 0.0).astype(np.float32),
        attached=steps >= 10,
        distance=(1 - opened).astype(np.float32),
        success=True,
        rate=20,
    )  # fmt: skip


@pytest.fixture(scope="module")
def film() -> Film:
    return made_film()


def matches(image: NDArray[np.uint8], color: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Pixels [H, W] with nearly the hue of ``color``."""
    pixels = image.astype(float)
    flat = pixels - pixels.mean(-1, keepdims=True)
    wanted = np.array(color) - np.mean(color)
    cosine = (flat @ wanted) / (np.linalg.norm(flat, axis=-1) * np.linalg.norm(wanted) + 1e-9)
    return np.asarray((cosine > 0.97) & (np.linalg.norm(flat, axis=-1) > 60))


def centre(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    assert mask.any()
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


# ------------------------------------------------------------------------------------------------------ pictures


def test_the_part_to_open_is_blue_and_moves_as_its_joint_opens(film: Film) -> None:
    shot = Shot(film, *SMALL)
    seen = [centre(matches(shot.picture(t), bodies.TARGET)) for t in (10, 15, 20)]
    moved = shot.camera.project(np.array([[-0.6, 0, 0.5], [-0.6 - OPENING, 0, 0.5]]))
    wanted = moved[1] - moved[0]
    for before, after in zip(seen, seen[1:], strict=False):
        step = after - before
        assert step @ wanted > 0.9 * np.linalg.norm(step) * np.linalg.norm(wanted)
    assert np.linalg.norm(seen[2] - seen[0]) == pytest.approx(np.linalg.norm(wanted), rel=0.35)


@pytest.mark.parametrize("flow", [(-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-0.5, -0.5, 0.5)])
def test_an_arrow_points_where_the_flow_points_in_the_image(flow: tuple[float, float, float]) -> None:
    film = made_film(flow, rows=1)
    shot = Shot(film, *SMALL, view=View(-30.0, 25.0))
    starts, flows = shot.arrows(0)
    assert len(starts) == 1
    np.testing.assert_allclose(starts[0], film.points[0, 0], atol=1e-6)
    np.testing.assert_allclose(flows[0], flow, atol=1e-6)
    ends = shot.camera.project(np.stack([starts[0], starts[0] + 0.1 * flows[0]]))
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    arrow = matches(shot.picture(0), signs.FLOW)
    offset = centre(arrow) - ends[0]
    # The head is wide, so the arrow's centre lies well ahead of its start.
    assert offset @ direction > 3 and np.abs(offset - (offset @ direction) * direction).max() < 2.5


def test_arrows_stand_on_the_part_and_move_with_it(film: Film) -> None:
    shot = Shot(film, *SMALL)
    early, late = shot.arrows(10)[0], shot.arrows(20)[0]
    assert len(early) == len(late) == 16
    np.testing.assert_allclose(late - early, np.tile([-OPENING, 0, 0], (16, 1)), atol=1e-5)
    hidden = replace(film, part=np.zeros_like(film.part))
    assert len(Shot(hidden, *SMALL).arrows(0)[0]) == 0, "no arrows where the policy sees nothing of the part"
    Shot(hidden, *SMALL).picture(0)


def test_the_gripper_is_seen_and_its_tip_changes_colour_when_it_holds(film: Film) -> None:
    shot = Shot(replace(film, flow=np.zeros_like(film.flow)), *SMALL, view=View(-50.0, 20.0))
    for t in (0, 5, 12, 20):
        image = shot.picture(t)
        column, row = shot.camera.project(film.poses[t, 2, :3, 3][None])[0].astype(int)
        around = image[row - 2 : row + 3, column - 2 : column + 3].max(-1)
        assert around.min() < 90, f"the dark hand at step {t}"
        held, free = (matches(image, color).sum() for color in (signs.HOLDING, signs.FREE))
        assert (held > free) == film.attached[t] and max(held, free) > 3
    aside = replace(film, poses=film.poses.copy())
    aside.poses[:, 2:, 0, 3] += 100.0
    assert not matches(Shot(aside, *SMALL).picture(0), signs.FREE).any()


def test_all_that_happens_is_in_the_picture_but_a_gripper_that_flies_off(film: Film) -> None:
    shot = Shot(film, *SMALL)
    ends = shot.camera.project(np.concatenate([film.tips, film.points[:, :-1].reshape(-1, 3)]))
    assert (ends > 0).all() and (ends < SMALL).all()
    off = replace(film, poses=film.poses.copy(), tips=film.tips.copy())
    off.poses[15:, 2:, 2, 3] += 20.0
    off.tips[15:, 2] += 20.0
    assert Shot(off, *SMALL).camera.pose[2, 3] < 1.5 * shot.camera.pose[2, 3]


def test_the_view_shows_the_flow() -> None:
    """The front slides along -x: seen from the very front the arrows would be dots, from behind nothing would."""
    film = replace(made_film(), view=View(0.0, 20.0))
    shot = Shot(film, *SMALL)
    assert 20 <= abs(shot.view.azimuth) <= 60
    assert Shot(film, *SMALL, view=View(5.0, 6.0)).view == View(5.0, 6.0)


def test_a_frame_for_each_moment_with_a_bar_of_how_far_the_part_is_open(film: Film) -> None:
    made = list(frames(film, SMALL))
    assert len(made) == len(film) == 21
    for t, image in enumerate(made):
        assert image.shape == (SMALL[1] + CAPTION, SMALL[0], 3) and image.dtype == np.uint8
        bar = matches(image, bodies.TARGET)[SMALL[1] + 1]
        assert bar.sum() == pytest.approx(SMALL[0] * film.opened[t], abs=1.5)
        assert bar[: bar.sum()].all()
    assert (made[9][-CAPTION:] != made[10][-CAPTION:]).any(), "the caption says whether suction holds"


# ------------------------------------------------------------------------------------------------------- moments


def test_moments_tell_the_story(film: Film) -> None:
    assert moments(film) == [
        ("start", 0), ("pre-contact", 8), ("contact", 10), ("one third", 14), ("two thirds", 17), ("opened", 20)
    ]  # fmt: skip


def test_moments_of_films_without_a_story(film: Film) -> None:
    never = replace(film, attached=np.zeros(21, dtype=bool), success=False, distance=np.ones(21, dtype=np.float32))
    assert moments(never)[0] == ("start", 0) and moments(never)[-1] == ("end", 20) and len(moments(never)) == 6
    stuck = replace(film, success=False, distance=np.ones(21, dtype=np.float32))
    assert moments(stuck)[3:] == [("step 13", 13), ("step 17", 17), ("end", 20)]
    for length in (2, 3):
        cut = {name: getattr(film, name)[:length] for name in ("poses", "tips", "points", "part", "flow", "distance")}
        for held in (np.zeros(length, dtype=bool), np.ones(length, dtype=bool)):
            times = [t for _, t in moments(replace(film, **cut, attached=held))]
            assert times[-1] == length - 1 and (np.diff(times) > 0).all()


# --------------------------------------------------------------------------------------------------------- files


def decode(path: Path) -> NDArray[np.uint8]:
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert meta["fps"] == 20
    width, height = meta["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_has_all_frames_holds_the_last_and_repeats_bit_for_bit(film: Film, suffix: str, tmp_path: Path) -> None:
    path, again = tmp_path / f"a{suffix}", tmp_path / "b" / f"other{suffix}"
    again.parent.mkdir()
    write_video(film, path, SMALL)
    write_video(made_film(), again, SMALL)
    assert path.read_bytes() == again.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == [path.name], "nothing else is left behind"
    shown, drawn = decode(path).astype(int), np.stack(list(frames(film, SMALL))).astype(int)
    assert shown.shape == (21 + HOLD * 20, SMALL[1] + CAPTION, SMALL[0], 3)
    assert np.abs(shown[:21] - drawn).mean() < 4, "colours survive"
    assert np.abs(shown[21:] - drawn[-1]).mean() < 4
    nearest = [int(np.abs(drawn - frame).mean((1, 2, 3)).argmin()) for frame in shown[:21]]
    assert nearest == list(range(21))


def test_browsers_can_start_a_video_before_all_of_it_is_there(film: Film, tmp_path: Path) -> None:
    write_video(film, tmp_path / "a.mp4", SMALL)
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")
    assert b"Lavf" not in content and b"x264" in content


def test_a_filmstrip_has_a_panel_for_each_moment(film: Film, tmp_path: Path) -> None:
    write_filmstrip(film, tmp_path / "a.png", width=600)
    image = np.asarray(Image.open(tmp_path / "a.png"))
    assert image.shape[1] == 600 and image.shape[2] == 3
    # Between two panels there is white from top to bottom.
    inked = (image[image.shape[0] // 4 : image.shape[0] // 2] < 255).any((0, 2))
    starts = np.flatnonzero(np.diff(inked.astype(int), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(inked.astype(int), append=0) == -1)
    assert len(starts) == len(ends) == len(moments(film)) == 6
    assert len(set((ends - starts).tolist())) == 1, "all of one width"
    last, first = image[:, starts[-1] : ends[-1]], image[:, starts[0] : ends[0]]
    assert centre(matches(last, bodies.TARGET))[0] != pytest.approx(centre(matches(first, bodies.TARGET))[0], abs=2)
    write_filmstrip(film, tmp_path / "b.png", width=600)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_without_ffmpeg_it_says_so_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    video.require_encoder()
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(UserError, match="evaluation.videos=0"):
        video.require_encoder()


# -------------------------------------------------------------------------------------------------------- trials


def row(trial: int, category: str, success: bool, policy: str = "mine", **more: str) -> TrialRow:
    return TrialRow(trial, policy, "o", category, "s", "l", "door", "revolute", 0, success=success, **more)


def test_filmed_trials_are_spread_and_half_of_them_failed() -> None:
    rows = [row(i, "ABC"[i // 4], success=i % 4 != 3) for i in range(12)]
    expert = [row(i, "ABC"[i // 4], success=True, policy="expert") for i in range(12)]
    assert trials_to_film(expert + rows, 0) == []
    assert trials_to_film(expert + rows, 2) == [0, 3]
    assert trials_to_film(expert + rows, 4) == [0, 3, 4, 7]
    assert trials_to_film(expert, 4) == [0, 1, 4, 8], "no failures"
    assert trials_to_film([row(i, "A", False) for i in range(5)], 3) == [0, 1, 2], "no successes"
    assert trials_to_film(rows, 100) == list(range(12))
    crashed = [row(0, "A", False, status="error"), row(1, "A", True)]
    assert trials_to_film(crashed, 2) == [1]


class Predictor(TensorDictModuleBase):
    """Stands still and predicts a flow of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys = [("observation", "points")]
        self.out_keys = ["action", ("prediction", "flow")]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        td["action"] = torch.zeros(*td.batch_size, 8)
        td["prediction", "flow"] = 2.0 * td["observation", "points"]
        return td


@pytest.fixture(scope="module")
def microwave(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedObject:
    out = tmp_path_factory.mktemp("objects")
    return load_object(out / procedural.generate(out, ["Microwave"], 1, 3)[0])


def test_a_film_is_the_same_episode_again(microwave: ArticulatedObject) -> None:
    items = schedule([(microwave, "s")], SampleOptions(points=300, camera=CAMERA), seed=0)[0][:1]
    (known,) = run_trials("expert", expert_policy(LIMITS), [microwave], items, OPTIONS)
    film = record("expert", expert_policy(LIMITS), microwave, items[0].trial, OPTIONS)
    assert known.success and len(film) == known.steps + 1
    assert (film.success, float(film.distance[-1])) == (known.success, known.normalized_distance)
    assert int(film.attached.argmax()) == known.attach_step + 1, "the state after that step"
    assert film.poses.shape == (len(film), len(microwave.links) + 3, 4, 4)
    np.testing.assert_allclose(film.poses[0, 0], film.poses[-1, 0], atol=1e-6)
    assert np.abs(film.poses[0, film.link] - film.poses[-1, film.link]).max() > 0.3
    tip = film.poses[:, -3] @ [0.12, 0, 0, 1]
    np.testing.assert_allclose(tip[:, :3], film.tips, atol=1e-5)
    # The part's points lie on its link, wherever that is.
    end = film.points[-1][film.part[-1]]
    assert len(end) > 10
    local = (end - film.poses[-1, film.link, :3, 3]) @ film.poses[-1, film.link, :3, :3]
    vertices = np.concatenate([mesh.vertices for mesh in microwave.links[film.link].visuals])
    assert (local > vertices.min(0) - 1e-3).all() and (local < vertices.max(0) + 1e-3).all()
    assert np.linalg.norm(film.flow[-1], axis=-1).max() == pytest.approx(1.0, abs=1e-5), "the truth"


class Threads(TensorDictModuleBase):
    """Flies on by what decides a sum's last bits: the number of threads, and whether denormal numbers are 0."""

    in_keys = [("observation", "points")]
    out_keys = ["action"]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        tiny = torch.tensor(torch.finfo(torch.float32).tiny)
        td["action"] = torch.zeros(*td.batch_size, 8)
        td["action"][:, 0] = 0.1 * torch.get_num_threads() + 0.5 * float(bool(tiny / 2 == 0))
        return td


def test_a_film_computes_as_its_row_did(microwave: ArticulatedObject) -> None:
    options = replace(OPTIONS, horizon=3)
    items = schedule([(microwave, "s")], SampleOptions(points=300, camera=CAMERA), seed=0)[0][:1]
    (row,) = run_trials("threads", Threads(), [microwave], items, options)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        film = record("threads", Threads(), microwave, items[0].trial, options)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert len(film) == row.steps + 1
    assert float(np.linalg.norm(np.diff(film.tips.astype(float), axis=0), axis=1).sum()) == row.path_length


def test_films_of_an_evaluation(microwave: ArticulatedObject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = replace(OPTIONS, horizon=2)
    items = schedule([(microwave, "s")], SampleOptions(points=300, camera=CAMERA), seed=0)[0][:1]
    film = record("predictor", Predictor(), microwave, items[0].trial, options)
    assert len(film) == 3 and not film.success
    np.testing.assert_array_equal(film.flow, 2.0 * film.points)
    rows = [
        TrialRow(0, name, microwave.id, "Microwave", "s", "../l 1", "door", "revolute", 0, status=status)  # type: ignore[arg-type]
        for name, status in (("predictor", "ok"), ("expert", "error"))
    ]
    monkeypatch.setattr(videos, "SIZE", SMALL)
    seen: list[tuple[int, int]] = []
    policies = {"predictor": Predictor(), "expert": expert_policy(LIMITS)}
    film_trials(tmp_path / "videos", rows, 1, policies, [microwave], items, options, lambda *done: seen.append(done))
    name = f"000_{microwave.id}_.._l_1_predictor"
    assert {path.name for path in tmp_path.rglob("*.*")} == {f"{name}.mp4", f"{name}.png"}, "crashed ones are left out"
    assert seen == [(0, 1), (1, 1)]
