"""One flow sample: a random object, joint state and viewpoint, seen by the depth camera, with its true flow."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.camera.views import View
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.flow.articulation_flow import articulation_flow, normalize_flow
from fb3d_rl.kinematics.opening import openable_links, opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree
from fb3d_rl.perception.cloud import MIN_VISIBLE, sample_cloud


class ObjectView:
    """An object ready to be looked at: kinematic tree, camera, opening ranges; poses are in the world."""

    def __init__(self, obj: ArticulatedObject, camera: CameraOptions) -> None:
        self.obj = obj
        self.tree = KinematicTree.from_object(obj)
        self.camera = RaycastCamera(obj, options=camera)
        self.closed, self.open = opening_range(obj)
        self.base = torch.as_tensor(standing_pose(obj))
        self.openable = openable_links(obj)

    def direction(self, *links: int) -> NDArray[np.float64]:
        """Opening signs [J]: of the joints of ``links`` alone, or of all joints unless given.

        Endless ones turn forwards.
        """
        signs = np.where(self.open < self.closed, -1.0, 1.0)
        if links:
            signs[[other not in links for other in self.obj.movable]] = 0.0
        return signs

    def cloud(
        self, qpos: NDArray[np.float64], view: View, points: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The cloud [N, 3] and link of each point [N] at joint state ``qpos`` [J]."""
        return sample_cloud(*self.camera.capture(self.poses(qpos).numpy(), view), points, rng)

    def poses(self, qpos: NDArray[np.float64]) -> torch.Tensor:
        """T_world_link [L, 4, 4] at joint state ``qpos`` [J]."""
        return self.base @ self.tree.forward(torch.as_tensor(qpos))

    def flow(
        self,
        points: NDArray[np.float32],
        links: NDArray[np.int64],
        qpos: NDArray[np.float64],
        direction: NDArray[np.float64],
    ) -> torch.Tensor:
        """Normalised ground-truth flow [N, 3] float32 of a cloud."""
        raw = articulation_flow(
            self.tree,
            torch.as_tensor(points),
            torch.as_tensor(links),
            self.poses(qpos),
            torch.as_tensor(direction),
        )
        return normalize_flow(raw)

    def sample(
        self, links: NDArray[np.int64], points: NDArray[np.float32], qpos: NDArray[np.float64], *targets: int
    ) -> TensorDict:
        """The sample (contract group "sample") of a cloud whose targets are these links, or all movable parts.

        Its "target" is the link if it is one, else -1.
        """
        direction = self.direction(*targets)
        moving = (direction != 0).astype(np.float64) @ self.tree.descendants.numpy().astype(np.float64) > 0
        valid = torch.as_tensor(links >= 0)
        return TensorDict(
            {
                "observation": {
                    "points": torch.as_tensor(points),
                    "valid": valid,
                    "part_mask": torch.as_tensor(moving[links]) & valid,
                },
                "privileged": {"flow": self.flow(points, links, qpos, direction)},
                "target": torch.tensor(targets[0] if len(targets) == 1 else -1),
            },
            batch_size=[],
        )


def draw_sample(
    view: ObjectView, options: SampleOptions, rng: np.random.Generator, tries: int = 8
) -> TensorDict | None:
    """Draw one sample of an object, or None if no openable part shows itself within ``tries`` views."""
    for _ in range(tries):
        link = int(rng.choice(view.openable))
        qpos = np.where(rng.random(len(view.closed)) < options.others_closed, 0.0, rng.random(len(view.closed)))
        target = view.obj.movable.index(link)
        qpos[target] = 0.0 if rng.random() < options.closed_share else rng.random()
        qpos = view.closed + qpos * (view.open - view.closed)
        points, links = view.cloud(qpos, options.views.sample(rng), options.points, rng)
        share = rng.random()
        carried = view.obj.descendants(link)
        if np.isin(links, carried).sum() >= MIN_VISIBLE:
            targets: tuple[int, ...] = (link,) if share >= options.all_parts_share else ()
            if targets and share < options.all_parts_share + options.some_parts_share:
                targets += tuple(other for other in view.obj.movable if other != link and rng.random() < 0.5)
            return view.sample(links, points, qpos, *targets)
    return None
