"""SAPIEN's depth camera sees what the ray-casting camera sees."""

from __future__ import annotations

import colorsys
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions, RaycastCamera
from fb3d_rl.camera.views import View
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree

VIEW = View(25.0, 35.0)


@pytest.fixture(scope="module")
def module() -> Any:
    """The module under test; it imports the simulator."""
    pytest.importorskip("mani_skill")
    from fb3d_rl.camera import sapien

    return sapien


@pytest.fixture(scope="module")
def backend(module: Any) -> Any:
    """The renderer."""
    from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend

    try:
        return parse_sim_and_render_backend("physx_cpu", module.require_renderer())
    except UserError as error:
        pytest.skip(str(error))


class Scene:
    """An object in some joint state and a box before it, in one ManiSkill scene, with both cameras."""

    def __init__(self, module: Any, backend: Any, obj: ArticulatedObject, seed: int, shader: str = "minimal") -> None:
        import sapien
        from mani_skill.envs.scene import ManiSkillScene
        from mani_skill.sensors.camera import Camera
        from sapien.physx import PhysxCpuSystem

        self.options = CameraOptions(shader=shader)
        cube = trimesh.creation.box(extents=(0.3, 0.2, 0.1))
        hand = [Mesh(np.asarray(cube.vertices, dtype=np.float64), np.asarray(cube.faces, dtype=np.int64))]
        self.raycast = RaycastCamera(obj, [hand], self.options)
        closed, opened = opening_range(obj)
        share = 0.5 * np.random.default_rng(seed).random(len(closed))
        poses = (
            standing_pose(obj)
            @ KinematicTree.from_object(obj).forward(torch.as_tensor(closed + share * (opened - closed))).numpy()
        )
        before = np.eye(4)
        before[:3, 3] = self.raycast.centre + [-0.8 * self.raycast.radius, 0.1, 0.2]
        self.poses = np.concatenate([poses, before[None]])
        systems = [PhysxCpuSystem(), sapien.render.RenderSystem(backend.render_device)]
        scene = ManiSkillScene([sapien.Scene(systems)], device=backend.device, backend=backend)
        scene.set_ambient_light([1.0, 1.0, 1.0])
        self.entities = self.links(scene, obj) + [self.body(scene)]
        for index, (entity, meshes) in enumerate(
            zip(self.entities, [*(link.visuals for link in obj.links), hand], strict=True)
        ):
            module.add_visuals(entity, meshes, index)
        camera = self.raycast.pose(VIEW)[None]
        self.camera = module.SapienCamera(
            Camera(module.camera_config(self.options, camera), scene), self.options, camera, [self.entities]
        )

    def links(self, scene: Any, obj: ArticulatedObject) -> list[Any]:
        """An articulation whose links are fixed where they are."""
        import sapien

        builder = scene.create_articulation_builder()
        builder.initial_pose = sapien.Pose(self.poses[0])
        made: list[Any] = []
        for i, link in enumerate(obj.links):
            made.append(builder.create_link_builder(made[link.parent] if i else None))
            made[-1].set_name(link.name)
            offset = np.linalg.inv(self.poses[link.parent]) @ self.poses[i] if i else np.eye(4)
            made[-1].set_joint_properties("fixed", [], sapien.Pose(offset), sapien.Pose())
        articulation = builder.build(name="object", fix_root_link=True)
        articulation._objs[0].set_root_pose(sapien.Pose(self.poses[0]))  # and with it the other links'
        return [articulation.links_map[link.name]._objs[0].entity for link in obj.links]

    def body(self, scene: Any) -> Any:
        """A body that is in the scene already when it becomes visible."""
        import sapien

        builder = scene.create_actor_builder()
        builder.initial_pose = sapien.Pose(self.poses[-1])
        builder.add_box_collision(half_size=[0.15, 0.1, 0.05])
        return builder.build_kinematic(name="hand")._objs[0]

    def move_hand(self, to: Sequence[float]) -> None:
        import sapien

        self.poses[-1, :3, 3] = to
        self.entities[-1].set_pose(sapien.Pose(self.poses[-1]))

    def image(self, points: np.ndarray, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (infinite where nothing is) and body (-1) of each pixel."""
        n, pose = self.options.resolution, self.raycast.pose(VIEW)
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        column, row = (local[:, :2].T / local[:, 2] / self.options.slope + 1.0) * 0.5 * n - 0.5
        np.testing.assert_allclose([column, row], np.rint([column, row]), atol=1e-3)  # through the pixels' centres
        pixels = (np.rint(row).astype(int), np.rint(column).astype(int))
        assert (np.diff(pixels[0] * n + pixels[1]) > 0).all()  # row by row
        depth, body = np.full((n, n), np.inf), np.full((n, n), -1)
        depth[pixels], body[pixels] = local[:, 2], bodies
        return depth, body

    def compare(self, error: float) -> None:
        """Both cameras' clouds agree, but for pixels on the outline of a body or a step in depth.

        Real objects have coplanar faces of several links; that no exception is needed for them was found by trying.
        """
        self.camera.capture()
        ours, theirs = self.raycast.capture(self.poses, VIEW), self.camera.cloud()
        assert np.median(cKDTree(ours[0]).query(theirs[0])[0]) < error
        (depth, body), (other_depth, other_body) = self.image(*ours), self.image(*theirs)
        around = {"size": 3, "mode": "nearest"}
        uniform = ndimage.minimum_filter(body, **around) == ndimage.maximum_filter(body, **around)
        finite = np.where(np.isinf(depth), 99.0, depth)
        smooth = ndimage.maximum_filter(finite, **around) - ndimage.minimum_filter(finite, **around) < 0.1
        clear = uniform & smooth
        seen = clear & (body >= 0)
        assert seen.sum() > 300
        assert (body == other_body)[clear].mean() > 0.99
        both = seen & (other_body >= 0)
        assert (np.abs(depth[both] - other_depth[both]) < 0.002).mean() > 0.99
        assert (body == other_body).mean() > 0.98  # on all pixels


def test_both_cameras_see_the_same(module: Any, backend: Any, procedural_objects: dict[str, ArticulatedObject]) -> None:
    for seed, obj in enumerate(procedural_objects.values()):
        scene = Scene(module, backend, obj, seed)
        scene.compare(0.001)
        hidden = len(scene.raycast.capture(scene.poses, VIEW, further=False)[0])
        scene.move_hand(scene.raycast.centre + [0.0, 0.0, 9.0])
        scene.compare(0.001)
        assert len(scene.camera.cloud()[0]) > hidden  # what the box hid is back


@pytest.mark.parametrize("name", ["7179", "45213", "10797", "8877"])
def test_both_cameras_see_the_same_of_real_objects(module: Any, backend: Any, real_root: Path, name: str) -> None:
    if not (real_root / name).is_dir():
        pytest.skip(f"FB3D_PARTNET_MOBILITY holds no object {name}")
    Scene(module, backend, load_object(real_root / name), int(name)).compare(0.001)


@pytest.mark.slow
def test_the_default_shader_is_exact(
    module: Any, backend: Any, procedural_objects: dict[str, ArticulatedObject]
) -> None:
    Scene(module, backend, procedural_objects["Microwave"], 0, shader="default").compare(1e-5)


def test_pictures_show_the_bodies_in_their_colours(
    module: Any, backend: Any, procedural_objects: dict[str, ArticulatedObject]
) -> None:
    scene = Scene(module, backend, procedural_objects["StorageFurniture"], 3)
    scene.camera.capture()
    rgb, depth = scene.camera.rgbd()
    n = scene.options.resolution
    assert rgb.shape == (1, n, n, 3) and rgb.dtype == torch.uint8
    assert depth.shape == (1, n, n, 1) and depth.dtype == torch.float32
    expected, body = scene.image(*scene.camera.cloud())
    np.testing.assert_allclose(depth[0, ..., 0].numpy(), np.where(np.isinf(expected), 0.0, expected), atol=1e-5)
    hues = {index: 0.618034 * index % 1.0 for index in np.unique(body[body >= 0])}
    assert len(hues) >= 3
    for index, hue in hues.items():
        mean = rgb[0].numpy()[body == index].mean(0) / 255.0
        assert colorsys.rgb_to_hsv(*mean)[0] == pytest.approx(hue, abs=0.03)


class Recorded:
    """A sensor of two scenes whose pictures, of 2 x 2 pixels, are given."""

    def __init__(self, module: Any, **textures: torch.Tensor) -> None:
        config = module.camera_config(CameraOptions(resolution=2), np.eye(4)[None])
        names = dict.fromkeys(textures, [])
        self.config = SimpleNamespace(
            shader_config=SimpleNamespace(
                texture_names=names, texture_transforms=config.shader_config.texture_transforms
            )
        )
        self.textures, self.taken = textures, 0
        self.camera = SimpleNamespace(
            scene=SimpleNamespace(update_render=lambda **_: None),
            get_picture=lambda names: [self.textures[name] for name in names],
        )

    def capture(self) -> None:
        self.taken += 1


@pytest.mark.parametrize("minimal", [True, False])
def test_each_scene_has_its_own_bodies_and_pose(module: Any, minimal: bool) -> None:
    options = CameraOptions(resolution=2, fov=90.0)
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, 3] = (10.0, 0.0, 0.0)
    ids = torch.tensor([[[0, 3], [5, 7]], [[3, 0], [0, 900]]])  # 7 and 900 are no body of ours
    depth = torch.tensor([[[0.0, 1.0], [2.0, 3.0]], [[4.0, 0.0], [0.0, 5.0]]])
    if minimal:
        image = torch.zeros(2, 2, 2, 4, dtype=torch.int16)
        image[..., 2], image[..., 3] = (-1000 * depth).short(), ids.short()
        sensor = Recorded(module, PositionSegmentation=image, Color=torch.full((2, 2, 2, 4), 9, dtype=torch.uint8))
    else:
        position, labels = torch.zeros(2, 2, 2, 4), torch.zeros(2, 2, 2, 4, dtype=torch.int64)
        position[..., 2], labels[..., 1] = -depth, ids
        sensor = Recorded(module, Position=position, Segmentation=labels)
    bodies = [[SimpleNamespace(per_scene_id=i) for i in scene] for scene in ((5, 3), (3, 4))]
    camera = module.SapienCamera(sensor, options, poses, bodies)
    camera.capture()
    half = 0.0005 if minimal else 0.0
    points, links = camera.cloud(0)
    np.testing.assert_array_equal(links, [1, 0])
    np.testing.assert_allclose(points, [[0.5, -0.5, 1.0], [-1.0, 1.0, 2.0]], atol=1e-6 + half)
    points, links = camera.cloud(1)
    np.testing.assert_array_equal(links, [0])
    np.testing.assert_allclose(points, [[8.0, -2.0, 4.0]], atol=1e-6 + half)
    if minimal:
        rgb, far = camera.rgbd()
        assert rgb.shape == (2, 2, 2, 3) and (rgb == 9).all()
        np.testing.assert_allclose(far[..., 0], torch.where(ids > 0, depth + half, 0.0), atol=1e-6)


def test_a_failing_renderer_is_a_users_error(module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(device: str) -> None:
        raise RuntimeError(f"no {device}")

    monkeypatch.setattr(module, "_renderer", fail)
    with pytest.raises(UserError, match=r"camera\.kind=sapien needs Vulkan.*no cuda; no cpu.*lavapipe"):
        module.require_renderer()


@pytest.mark.slow
def test_a_machine_without_vulkan_says_so(module: Any) -> None:
    code = "from fb3d_rl.camera.sapien import require_renderer; require_renderer()"
    nowhere = {"VK_ICD_FILENAMES": "/nonexistent", "VK_DRIVER_FILES": "/nonexistent"}
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, **nowhere}, capture_output=True, text=True)
    assert done.returncode != 0 and "UserError: camera.kind=sapien needs Vulkan" in done.stderr
