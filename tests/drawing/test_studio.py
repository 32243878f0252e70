"""Pictures: what is where, what hides what, where light falls; drawing only what moved gives the same picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike, NDArray

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.camera.views import View
from fb3d_rl.drawing.bodies import Body, Color, Part, Placed
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.studio import GHOST, Studio

RED, GREEN, BLUE, DARK = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.05, 0.05, 0.05)
FRONT, SIDE = View(0.0, 20.0), View(-35.0, 25.0)
SIZE = (96, 72)
WORLD = np.eye(4)


def mesh_of(made: trimesh.Trimesh, at: ArrayLike = (0, 0, 0)) -> Mesh:
    return Mesh(np.array(made.vertices) + np.array(at, dtype=float), np.array(made.faces, dtype=np.int64))


def box(extents: ArrayLike, at: ArrayLike = (0, 0, 0)) -> Mesh:
    return mesh_of(trimesh.creation.box(extents=extents), at)


def body(color: Color, *meshes: Mesh, sign: bool = False) -> Body:
    return Body([Part(meshes, color)], sign)


def at(x: float, y: float, z: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


ROOM = np.array([(x, y, z) for x in (-0.8, 0.8) for y in (-0.8, 0.8) for z in (0.0, 1.2)])
"""What the tests' camera has in view."""


def camera(view: View = SIDE, size: tuple[int, int] = SIZE) -> Camera:
    return Camera.fitting(view, ROOM, size)


def shoot(still: Body, *moving: Placed, view: View = SIDE, size: tuple[int, int] = SIZE) -> NDArray[np.int64]:
    return Studio(camera(view, size), still).picture(moving).astype(np.int64)


def is_color(image: NDArray[np.int64], color: Color) -> NDArray[np.bool_]:
    """Pixels [H, W] whose strongest channel stands out as in ``color``."""
    strong = int(np.argmax(color))
    others = np.delete(image, strong, axis=-1).max(-1)
    return np.asarray(image[..., strong] > others + 60)


@pytest.mark.parametrize("view", [FRONT, SIDE, View(130.0, 60.0), View(20.0, -10.0)])
@pytest.mark.parametrize("size", [(80, 40), (40, 80)])
def test_the_fitted_camera_has_all_points_in_its_image_and_no_nearer_one_has(view: View, size: tuple[int, int]) -> None:
    points = np.random.default_rng(0).normal(size=(60, 3)) * [0.3, 1.0, 0.5]
    fitted = Camera.fitting(view, points, size, margin=0.1)
    ends = fitted.project(points) / size
    assert ends.min() > 0.1 - 1e-9 and ends.max() < 0.9 + 1e-9
    gaps = np.array([ends.min(0) - 0.1, 0.9 - ends.max(0)])
    assert (gaps.max(0) < 1e-9).any(), "some pair of opposite edges is touched"
    nearer = replace(fitted, pose=fitted.pose.copy())
    nearer.pose[:3, 3] += 0.05 * fitted.pose[:3, 2]
    ends = nearer.project(points) / size
    assert ends.min() < 0.1 or ends.max() > 0.9


def test_rays_go_through_the_points_that_they_are_projected_to() -> None:
    cam = camera()
    points = np.random.default_rng(1).uniform(-0.5, 0.5, size=(20, 3))
    to_points = points - cam.pose[:3, 3]
    to_points /= np.linalg.norm(to_points, axis=-1, keepdims=True)
    np.testing.assert_allclose(cam.rays(cam.project(points)), to_points, atol=1e-6)
    above = cam.project(np.array([[0, 0, 0.0], [0, 0, 1.0]]))
    assert above[1, 1] < above[0, 1], "up in the world is up in the image"


@pytest.mark.parametrize("swap", [False, True])
def test_what_is_nearer_hides_what_is_farther(swap: bool) -> None:
    near, far = body(RED, box((0.1, 0.6, 0.6))), body(GREEN, box((0.1, 0.6, 0.6)))
    places = [(near, at(-0.5, 0, 0.5)), (far, at(0.5, 0, 0.5))]
    image = shoot(Body([]), *(places[::-1] if swap else places), view=FRONT)
    middle = tuple(np.round(camera(FRONT).project(np.array([[-0.55, 0, 0.5]]))[0]).astype(int)[::-1])
    assert is_color(image, RED)[middle]
    assert is_color(image, RED).sum() > 2 * is_color(image, GREEN).sum() > 0, "of the far one, the top is seen"
    # Whether a body is still or moving makes no difference to what hides what.
    for still, moving in (((near, RED), (far, 0.5)), ((far, GREEN), (near, -0.5))):
        put = Body([Part([box((0.1, 0.6, 0.6))], still[1], at(-0.5 if still[0] is near else 0.5, 0, 0.5))])
        again = shoot(put, (moving[0], at(moving[1], 0, 0.5)), view=FRONT)
        assert (is_color(again, RED) == is_color(image, RED)).mean() > 0.995
        assert (is_color(again, GREEN) == is_color(image, GREEN)).mean() > 0.995


def test_drawing_what_moved_gives_the_picture_of_drawing_everything() -> None:
    table, thing = box((0.8, 0.8, 0.1), (0, 0, 0.4)), mesh_of(trimesh.creation.icosphere(radius=0.2))
    pose = at(-0.1, 0.1, 0.7)
    apart = shoot(body(BLUE, table), (body(GREEN, thing), pose))
    whole = shoot(Body([Part([table], BLUE), Part([thing], GREEN, pose)]))
    difference = np.abs(apart - whole).max(-1)
    # The light on still bodies is sampled more finely.
    assert difference.mean() < 1.0 and np.quantile(difference, 0.99) < 12
    # Where a body was before leaves no trace.
    studio, mover = Studio(camera(), body(BLUE, table)), body(GREEN, thing)
    before = studio.picture([(mover, pose)])
    studio.picture([(mover, at(0.4, -0.3, 0.9))])
    np.testing.assert_array_equal(studio.picture([(mover, pose)]), before)
    np.testing.assert_array_equal(Studio(camera(), body(BLUE, table)).picture([(mover, pose)]), before)


def test_bodies_darken_the_ground_away_from_the_light_and_the_ground_is_bright_elsewhere() -> None:
    empty = shoot(Body([]))
    assert empty.min() > 210 and np.ptp(empty, axis=(0, 1)).max() < 30
    image = shoot(body(RED, box((0.3, 0.3, 0.6), (0, 0, 0.3))))
    ground = ~is_color(image, RED)
    darker = (empty - image).max(-1) * ground
    assert darker.max() > 40
    assert image[0].min() > 200 and image[:, 0].min() > 200, "far from the box nothing changes"
    columns = np.arange(SIZE[0])
    shadow = (darker.sum(0) * columns).sum() / darker.sum()
    thing = (is_color(image, RED).sum(0) * columns).sum() / is_color(image, RED).sum()
    assert shadow > thing + 3, "the light comes from the left"


def test_a_gap_between_two_walls_is_darker_than_their_outsides() -> None:
    walls = [box((0.5, 0.05, 0.5), (0, y, 0.25)) for y in (-0.12, 0.12)]
    floor = box((0.8, 1.2, 0.02))
    image = shoot(body((0.8, 0.8, 0.8), floor, *walls), view=View(0.0, 60.0)).mean(-1)
    cam = camera(View(0.0, 60.0))

    def brightness(y: float) -> float:
        column, row = np.floor(cam.project(np.array([[0.0, y, 0.01]]))[0]).astype(int)
        return float(image[row, column])

    assert brightness(0.0) < min(brightness(-0.45), brightness(0.45)) - 15


def test_the_sense_in_which_faces_turn_makes_no_difference() -> None:
    ball = mesh_of(trimesh.creation.icosphere(radius=0.4), (0, 0, 0.5))
    some = np.random.default_rng(0).random(len(ball.faces)) < 0.5
    mixed = Mesh(ball.vertices, np.where(some[:, None], ball.faces[:, ::-1], ball.faces))
    difference = np.abs(shoot(body(BLUE, ball)) - shoot(body(BLUE, mixed)))
    assert difference.max() <= 3


def test_round_things_are_shaded_smoothly_and_boxes_keep_their_edges() -> None:
    ball = mesh_of(trimesh.creation.icosphere(subdivisions=2, radius=0.5))
    normals = body(BLUE, ball).normals
    radial = ball.vertices[ball.faces] / 0.5
    np.testing.assert_allclose(np.abs((normals * radial).sum(-1)), 1.0, atol=0.01)
    cube = box((1, 1, 1))
    corners = body(BLUE, cube).normals
    assert np.allclose(np.abs(corners).max(-1), 1.0) and np.allclose(np.abs(corners).sum(-1), 1.0)


def test_edges_are_smoothed() -> None:
    pose = at(0, 0, 0.6)
    pose[:3, :3] = trimesh.transformations.rotation_matrix(0.2, [1, 0, 0])[:3, :3]
    image = shoot(Body([]), (body(DARK, box((0.02, 0.8, 0.5))), pose), view=FRONT).mean(-1)
    between = (image > 90) & (image < 200)
    inside = image < 60
    assert inside.sum() > 300
    around = 2 * (np.ptp(np.nonzero(inside)[0]) + np.ptp(np.nonzero(inside)[1]))
    assert 0.25 * around < between.sum() < 1.5 * around


def test_signs_neither_throw_shadows_nor_hide_behind_things() -> None:
    wall = body((0.8, 0.8, 0.8), box((0.05, 0.8, 0.8), (0, 0, 0.4)))
    sign = body(GREEN, box((0.1, 0.2, 0.2)), sign=True)
    plain = shoot(wall, view=FRONT)
    shown = shoot(wall, (sign, at(-0.5, 0, 0.4)), view=FRONT)
    changed = (shown != plain).any(-1)
    assert is_color(shown, GREEN)[changed].mean() > 0.7, "only the sign and its edge change"
    hidden = shoot(wall, (sign, at(0.5, 0, 0.4)), view=FRONT)
    changed = (hidden != plain).any(-1)
    assert changed.sum() > 50 and 0 < GHOST < 1
    tint = (hidden - plain)[changed]
    assert (tint[:, 1] > tint[:, 0]).all() and not is_color(hidden, GREEN).all()
    opaque = Body([Part([box((0.05, 0.8, 0.8))], (0.8, 0.8, 0.8))], opaque=True)
    shown = shoot(Body([]), (opaque, at(0, 0, 0.4)), (sign, at(0.5, 0, 0.4)), view=FRONT)
    np.testing.assert_array_equal(shown, shoot(Body([]), (opaque, at(0, 0, 0.4)), view=FRONT))
    body_of_it = body(GREEN, box((0.1, 0.2, 0.2)))
    np.testing.assert_array_equal(
        is_color(shoot(wall, (body_of_it, at(0.5, 0, 0.4)), view=FRONT), GREEN), np.zeros(SIZE[::-1], dtype=bool)
    )


def test_the_horizon_and_what_is_beyond_the_image_do_no_harm() -> None:
    thing = body(RED, box((0.3, 0.3, 0.3)))
    level = shoot(Body([]), (thing, at(0, 0, 0.3)), view=View(0.0, 1.0))
    assert is_color(level, RED).sum() > 100 and level[0].min() > 200
    studio = Studio(camera(), Body([]))
    empty = studio.picture()
    np.testing.assert_array_equal(studio.picture([(thing, at(0, 50.0, 0.3)), (Body([]), WORLD)]), empty)
    behind = camera().pose[:3, 3] - 3 * camera().pose[:3, 2]
    assert not is_color(studio.picture([(thing, at(*behind))]).astype(np.int64), RED).any()
