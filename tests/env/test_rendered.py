"""The task with SAPIEN's renderer: the same clouds as by ray casting, and pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.sapien import require_renderer
from fb3d_rl.camera.views import View
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.errors import UserError

from .conftest import links_called, velocity

EVERY_POINT = 96 * 96


@pytest.fixture(scope="module", autouse=True)
def _renderer() -> None:
    try:
        require_renderer()
    except UserError as error:
        pytest.skip(str(error))


def test_both_cameras_see_the_same(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Table"]
    trial = default_trial(obj, links_called(obj, "drawer")[0], View(20.0, 35.0))
    clouds = []
    for kind in ("raycast", "sapien"):
        env = OpenArticulatedEnv([obj], EnvOptions(points=EVERY_POINT, camera=CameraOptions(kind=kind)))
        env.reset(options={"trials": [trial]})
        for _ in range(6):
            obs, *_ = env.step(velocity(x=0.4, y=0.2))
        clouds.append({key: value[0] for group in obs.values() for key, value in group.items()})
    ours, theirs = clouds
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert value.shape == theirs[key].shape and value.dtype == theirs[key].dtype, key
    distance, nearest = cKDTree(ours["points"][ours["valid"]]).query(theirs["points"][theirs["valid"]])
    assert np.median(distance) < 0.002 and np.quantile(distance, 0.99) < 0.02
    same = (ours["link"][ours["valid"]][nearest] == theirs["link"][theirs["valid"]]).float().mean()
    assert same > 0.97, "edges included"
    flow = (ours["flow"][ours["valid"]][nearest] - theirs["flow"][theirs["valid"]]).norm(dim=-1)
    assert float(flow.median()) < 1e-3


def test_the_rendered_camera_repeats_bit_for_bit_and_moves_with_the_view(
    objects: dict[str, ArticulatedObject],
) -> None:
    obj = objects["Laptop"]
    env = OpenArticulatedEnv([obj], EnvOptions(points=256, camera=CameraOptions(kind="sapien")))

    def points(view: View) -> torch.Tensor:
        obs, _ = env.reset(options={"trials": [default_trial(obj, view=view)]})
        return obs["observation"]["points"]

    first = points(View(0.0, 30.0))
    assert not torch.equal(points(View(30.0, 50.0)), first)
    assert torch.equal(points(View(0.0, 30.0)), first)


def test_colour_and_depth_show_the_object_and_the_gripper(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["StorageFurniture"]
    env = OpenArticulatedEnv([obj], obs_mode="rgbd", render_mode="rgb_array")
    obs, _ = env.reset(options={"trials": [default_trial(obj)]})
    rgb, depth = obs["observation"]["rgb"][0], obs["observation"]["depth"][0]
    assert rgb.shape == (96, 96, 3) and rgb.dtype == torch.uint8
    assert depth.shape == (96, 96, 1) and depth.dtype == torch.float32
    seen = depth[..., 0] > 0
    assert 0.1 < float(seen.float().mean()) < 0.9
    eye = obs["observation"]["camera_position"][0]
    assert abs(float(depth[seen].median()) - float((eye - torch.tensor([0.0, 0.0, 0.5])).norm())) < 1.0
    assert len(torch.unique(rgb[seen], dim=0)) > 5, "links have colours, faces have shades"
    picture = env.render()
    assert picture.shape == (1, 512, 512, 3) and picture.dtype == torch.uint8 and int(picture.float().std()) > 5
