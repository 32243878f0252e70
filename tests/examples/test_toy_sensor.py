"""A sensor from outside the package: flow samples and the simulated task see through it."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.options import SENSORS, CameraOptions
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.camera.views import View
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.errors import UserError
from fb3d_rl.scene.posed import Posed

# ------------------------------------------------------------------------------------------------------------- the toy


class NoisyCamera(RaycastCamera):
    """Depth with Gaussian noise, which follows from the poses, so that a picture repeats bit for bit."""

    sigma = 0.01
    """Standard deviation of the depth, m."""

    def capture(
        self, poses: NDArray[np.float64], view: View, further: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        points, links = super().capture(poses, view, further)
        camera = self.pose(view)
        rays = points - camera[:3, 3]
        depth = rays @ camera[:3, 2]
        noise = np.random.default_rng(zlib.crc32(np.ascontiguousarray(poses))).normal(0.0, self.sigma, len(points))
        return points + rays * (noise / depth)[:, None], links


# ----------------------------------------------------------------------------------------------------------- its tests


@pytest.fixture
def optics(monkeypatch: pytest.MonkeyPatch) -> CameraOptions:
    monkeypatch.setitem(SENSORS, "noisy", f"{__name__}:NoisyCamera")
    return CameraOptions(resolution=48, kind="noisy")


def test_the_noise_is_along_the_rays_and_repeats(optics: CameraOptions, objects: dict[str, ArticulatedObject]) -> None:
    clean, noisy, again = (Posed(objects["Oven"], CameraOptions(48, kind=kind)) for kind in ("raycast", *["noisy"] * 2))
    view, poses = View(20.0, 30.0), clean.poses(clean.closed)
    (exact, links), (points, same) = clean.camera.capture(poses, view), noisy.camera.capture(poses, view)
    np.testing.assert_array_equal(links, same)
    pose = clean.camera.pose(view)
    there, off = exact - pose[:3, 3], points - exact
    np.testing.assert_allclose(np.cross(there, off), 0.0, atol=1e-9)
    assert np.std(off @ pose[:3, 2]) == pytest.approx(NoisyCamera.sigma, rel=0.1)
    np.testing.assert_array_equal(again.camera.capture(poses, view)[0], points)


def test_flow_samples_see_through_it(optics: CameraOptions, objects: dict[str, ArticulatedObject]) -> None:
    drawn = [
        draw_sample(Posed(objects["Oven"], camera), SampleOptions(points=128), np.random.default_rng(0))
        for camera in (CameraOptions(resolution=48), optics)
    ]
    clean, noisy = (sample for sample in drawn if sample is not None)
    contract.check(noisy, "sample")
    torch.testing.assert_close(noisy["observation", "part_mask"], clean["observation", "part_mask"])
    off = (noisy["observation", "points"] - clean["observation", "points"]).norm(dim=-1)
    assert 0.0 < off.max() < 6 * NoisyCamera.sigma and off[noisy["observation", "valid"]].min() > 0.0


def test_the_task_sees_through_it(optics: CameraOptions, objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Oven"]
    seen = []
    for camera in (CameraOptions(resolution=48), optics):
        env = make_env([obj], EnvOptions(points=128, camera=camera), [default_trial(obj)])
        seen.append(env.reset())
        env.close()
    clean, noisy = seen
    contract.check(noisy, "observation")
    off = (noisy["observation", "points"] - clean["observation", "points"]).norm(dim=-1)
    assert 0.0 < off.max() < 6 * NoisyCamera.sigma
    assert torch.equal(noisy["observation", "part_mask"], clean["observation", "part_mask"])


def test_a_configuration_names_it(optics: CameraOptions, config: Callable[[str, list[str]], Any]) -> None:
    assert config("evaluate", ["camera.kind=noisy"]).camera.kind == "noisy"
    with pytest.raises(UserError, match=r"camera\.kind=clear is unknown; choose from raycast, sapien, umpnet, noisy"):
        config("evaluate", ["camera.kind=clear"])
