"""What opens and which way, on hand-made objects whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.kinematics.opening import (
    openable_links,
    opening_range,
    standing_bounds,
    standing_pose,
    start_fraction,
    travel,
)
from fb3d_rl.kinematics.tree import KinematicTree

from .chains import box, joint, make, pose

CABINET = (-1, None, "", (box((1.0, 1.0, 1.0), (0.0, 0.0, 0.5)),))


def hinged_door(lower: float, upper: float) -> ArticulatedObject:
    """A door that lies in the cabinet's front (x = -0.5) at joint position 0, hinged at y = 0.5."""
    door = box((0.04, 0.98, 0.98), (0.02, -0.49, 0.5))
    return make(
        CABINET, (0, joint("revolute", (0, 0, 1), (lower, upper), pose((-0.5, 0.5, 0))), "rotation_door", (door,))
    )


def laptop(folded_at_zero: bool) -> ArticulatedObject:
    """A screen that lies on its base or stands on it at joint position 0, and folds with negative angles."""
    base = box((0.4, 0.6, 0.02), (0.0, 0.0, 0.01))
    screen = box((0.02, 0.6, 0.4), (0.0, 0.0, 0.2))
    limits = (0.0, 1.57) if folded_at_zero else (-1.57, 0.0)
    turn = Rotation.from_euler("y", -90, degrees=True) if folded_at_zero else None
    return make(
        (-1, None, "", (base,)),
        (0, joint("revolute", (0, 1, 0), limits, pose((0.2, 0.0, 0.02), turn)), "shaft", (screen,)),
    )


def check(obj: ArticulatedObject, closed: float, opened: float) -> None:
    assert [float(side[0]) for side in opening_range(obj)] == pytest.approx([closed, opened])


def test_a_door_opens_away_from_its_frame_either_way() -> None:
    check(hinged_door(0.0, 1.57), 0.0, 1.57)
    check(hinged_door(-1.57, 0.0), 0.0, -1.57)


def test_a_folding_screen_is_closed_where_it_is_folded() -> None:
    check(laptop(folded_at_zero=False), -1.57, 0.0)
    check(laptop(folded_at_zero=True), 0.0, 1.57)


def test_a_sash_that_slides_in_its_frame_is_closed_as_modelled() -> None:
    frame = box((0.1, 2.0, 1.0))
    sash = box((0.04, 0.9, 0.9), (0.0, 0.5, 0.0))
    for lower, upper, closed, opened in ((-0.9, 0.0, 0.0, -0.9), (0.0, 0.4, 0.0, 0.4)):
        obj = make((-1, None, "", (frame,)), (0, joint("prismatic", (0, 1, 0), (lower, upper)), "window", (sash,)))
        check(obj, closed, opened)


def test_a_drawer_that_comes_out_backwards_is_closed_inside() -> None:
    drawer = box((0.9, 0.8, 0.3), (-0.02, 0.0, 0.5))
    for lower, upper, closed, opened in ((-0.7, 0.0, 0.0, -0.7), (-0.7, 0.1, -0.7, 0.1)):
        slide = joint("prismatic", (1, 0, 0), (lower, upper))
        check(make(CABINET, (0, slide, "drawer", (drawer,))), closed, opened)


def test_the_neighbours_do_not_change_which_end_is_closed() -> None:
    door, lid = hinged_door(-1.57, 0.0), laptop(folded_at_zero=False)
    both = make(
        CABINET,
        (0, door.links[1].joint, "rotation_door", door.links[1].visuals),
        (0, joint("prismatic", (1, 0, 0), (-5.0, 0.0)), "drawer", (box((0.9, 0.8, 0.3), (0, 0, 0.5)),)),
    )
    closed, opened = opening_range(both)
    np.testing.assert_allclose(closed, [0.0, 0.0])
    np.testing.assert_allclose(opened, [-1.57, -5.0])
    check(lid, -1.57, 0.0)


def test_a_lid_on_a_turning_base_is_judged_with_its_own_shape() -> None:
    base = box((0.4, 0.6, 0.02), (0.0, 0.0, 0.01))
    screen = box((0.02, 0.6, 0.4), (0.0, 0.0, 0.2))
    obj = make(
        (-1, None, "", ()),
        (0, joint("continuous", (0, 0, 1)), "turntable", (base,)),
        (1, joint("revolute", (0, 1, 0), (-1.57, 0.0), pose((0.2, 0.0, 0.02))), "screen", (screen,)),
    )
    closed, opened = opening_range(obj)
    assert (closed[1], opened[1]) == pytest.approx((-1.57, 0.0))


def test_a_part_whose_mesh_hangs_on_a_fixed_child_opens() -> None:
    door = box((0.04, 0.98, 0.98), (0.02, -0.49, 0.5))
    obj = make(
        CABINET,
        (0, joint("revolute", (0, 0, 1), (0.0, 1.57), pose((-0.5, 0.5, 0))), "rotation_door", ()),
        (1, joint("fixed"), "panel", (door,)),
    )
    assert openable_links(obj) == [1]
    assert travel(obj, 0) > 1.0


def test_an_endless_joint_has_no_range() -> None:
    for kind, limits in (("continuous", (-np.inf, np.inf)), ("revolute", (-np.inf, 0.0)), ("prismatic", (0.0, np.inf))):
        obj = make(CABINET, (0, joint(kind, (0, 0, 1), limits), "door", (box((1, 1, 1)),)))
        check(obj, 0.0, 0.0)
        assert openable_links(obj) == [] and travel(obj, 0) == 0.0


def test_every_part_of_a_range_is_within_the_limits(procedural_objects: dict[str, ArticulatedObject]) -> None:
    for obj in procedural_objects.values():
        closed, opened = opening_range(obj)
        np.testing.assert_array_equal(np.sort(np.stack([closed, opened], axis=1)), obj.limits)
        np.testing.assert_array_equal(closed, 0.0)  # procedural objects are closed at 0
        assert openable_links(obj)


def test_controls_do_not_count_unless_there_is_nothing_else() -> None:
    plate = (box((0.04, 0.9, 0.9), (0, 0.5, 0)),)
    door = (0, joint("revolute", (0, 0, 1), (0.0, 1.5)), "rotation_door", plate)
    button = (0, joint("prismatic", (1, 0, 0), (0.0, 0.02)), "button", plate)
    knob = (0, joint("revolute", (1, 0, 0), (0.0, 3.0)), "knob", plate)
    assert openable_links(make(CABINET, button, door, knob)) == [2]
    assert openable_links(make(CABINET, button, knob)) == [1, 2]


def test_parts_that_hardly_move_do_not_count() -> None:
    plate = (box((0.04, 0.9, 0.9), (0, 0.5, 0)),)
    sliding = joint("prismatic", (1, 0, 0), (0.0, 0.01))
    turning = joint("revolute", (0, 0, 1), (0.0, 0.05))
    thin = (0, joint("revolute", (0, 0, 1), (0.0, 1.5)), "door", (box((0.004, 0.004, 0.9)),))
    fixed = (0, joint("fixed"), "door", plate)
    assert openable_links(make(CABINET, (0, sliding, "door", plate), (0, turning, "door", plate), thin, fixed)) == []


def test_travel_bounds_how_far_points_move() -> None:
    obj = hinged_door(-1.0, 0.5)
    tree = KinematicTree.from_object(obj)
    vertices = obj.links[1].visuals[0].vertices
    ends = [tree.forward(torch.tensor([q]))[1].numpy() for q in (-1.0, 0.5)]
    moved = [vertices @ end[:3, :3].T + end[:3, 3] for end in ends]
    straight = np.linalg.norm(moved[0] - moved[1], axis=-1).max()
    assert straight <= travel(obj, 0) <= 1.5 * np.hypot(0.98, 0.04) + 1e-9
    drawer = make(CABINET, (0, joint("prismatic", (1, 0, 0), (-0.2, 0.3)), "drawer", (box((1, 1, 1)),)))
    assert travel(drawer, 0) == pytest.approx(0.5)


def standing_vertices(obj: ArticulatedObject) -> np.ndarray:
    closed, _ = opening_range(obj)
    poses = standing_pose(obj) @ KinematicTree.from_object(obj).forward(torch.as_tensor(closed)).numpy()
    return np.concatenate(
        [m.vertices @ poses[i, :3, :3].T + poses[i, :3, 3] for i, part in enumerate(obj.links) for m in part.visuals]
    )


def test_objects_stand_on_the_ground(procedural_objects: dict[str, ArticulatedObject]) -> None:
    deep = make(
        (-1, None, "", (box((1, 1, 1)),)),
        # Its closed end hangs below the body, its modelled pose does not.
        (0, joint("prismatic", (0, 0, 1), (-2.0, 1.0)), "drawer", (box((0.2, 0.2, 0.2)),)),
    )
    for obj in (deep, *procedural_objects.values()):
        vertices = standing_vertices(obj)
        assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(standing_bounds(obj), [vertices.min(0), vertices.max(0)], atol=1e-9)
        turned = standing_pose(obj)
        np.testing.assert_array_equal(turned[:3, :3], np.eye(3))
        np.testing.assert_array_equal(turned[:2, 3], 0.0)
    assert standing_pose(deep)[2, 3] == pytest.approx(2.1)


def test_the_reference_protocols_start() -> None:
    assert {start_fraction(c) for c in ("Door", "Box", "Table", "Phone", "Bucket")} == {0.2}
    assert {start_fraction(c) for c in ("Oven", "Laptop", "StorageFurniture", "unknown")} == {0.0}
