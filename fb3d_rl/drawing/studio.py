"""Shaded pictures on the CPU: Embree rays, a soft key light, a bright sky and a ground that catches shadows.

No Vulkan and no GPU. A :class:`Studio` has one camera and the bodies that do not move, whose colours and shadows are
computed once. A picture then only costs the rays at moving bodies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.drawing.bodies import F32, GAMMA, SIGN, Body, Placed, Surface, dot, spread, unit
from fb3d_rl.drawing.camera import Camera

TILE = 4
"""Side (pixels) of the square in which every pixel samples other directions of the light."""

SKY_RAYS = 3
"""Directions in which a pixel samples the sky."""

KEY, SKY = 0.62, 0.52
"""Light of the key light on a surface that faces it, and of the whole sky."""

KEY_AZIMUTH, KEY_ELEVATION, KEY_WIDTH = 42.0, 48.0, 6.0
"""Direction of the key light (degrees, to the left of the camera and above the horizon), and half its angular size,
which makes its shadows soft."""

SHADOW = 0.75
"""Darkness of the ground in full shadow; 1 is black."""

OCCLUSION = 0.35
"""Distance (m) within which other surfaces block the sky's light."""

BACKDROP = (0.985, 0.988, 0.992), (0.90, 0.915, 0.93)
"""Colours (sRGB) of the background in the middle and in the corners of the image."""

SUBPIXELS = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]])
"""Points (x, y) in a pixel of the rays that smooth an edge."""

GHOST = 0.3
"""Opacity of a sign behind other bodies."""

FAR = 1e6
"""Distance (m) of the empty background."""

GROUND, NOTHING = -1, -2
"""Numbers of the ground and of the empty background among those of bodies."""


class Studio:
    """One camera before bodies that do not move.

    Args:
        camera: the camera.
        still: the static bodies, in the world's frame.
    """

    def __init__(self, camera: Camera, still: Body) -> None:
        self.camera = camera
        self._still: Placed = (still, np.eye(4))
        width, height = camera.size
        y, x = np.divmod(np.arange(width * height), width)
        self._rays = camera.rays(np.stack([x, y], axis=-1) + 0.5)
        self._eye = camera.pose[:3, 3]
        self._cell = (y % TILE) * TILE + x % TILE
        self._key, self._key_rays, self._sky_offsets = self._light_directions()
        self._backdrop = self._gradient(x, y)
        self._base = self._empty(self._rays, self._backdrop)
        self._base.put(*still.hit(np.eye(4), self._eye, self._rays), 0)
        self._points = self._points_of(self._base, np.arange(width * height))
        self._base_light = np.mean([
            self._passed([self._still], self._points, self._base.normal, (self._cell + shift) % TILE**2)
            for shift in range(0, TILE * TILE, TILE)
        ], axis=0)  # fmt: skip
        self._fine_of = np.full(width * height, -1)
        edges = self._edges(self._base)
        self._fine_of[edges] = np.arange(len(edges))
        self._fine = self._finely(edges)

    def _empty(self, rays: F32, backdrop: F32) -> Surface:
        """Where ``rays`` [S, 3] hit the ground, and the background elsewhere."""
        distance, normal = np.full(len(rays), FAR, np.float32), np.zeros((len(rays), 3), np.float32)
        body = np.full(len(rays), NOTHING, dtype=np.int16)
        down = np.flatnonzero((rays[:, 2] < -1e-3) & (self._eye[2] > 0))
        distance[down], normal[down], body[down] = -self._eye[2] / rays[down, 2], (0, 0, 1), GROUND
        return Surface(distance, normal, backdrop.copy(), body, np.zeros_like(normal))

    def _points_of(self, seen: Surface, where: NDArray[np.intp]) -> F32:
        """The points that the rays ``where`` hit, moved a little off the surface."""
        return self._eye.astype(np.float32) + self._rays[where] * seen.distance[where, None] + 1e-3 * seen.normal[where]

    def _light_directions(self) -> tuple[F32, F32, F32]:
        """Where the light comes from.

        Returns:
            The direction of the key light [3]. For each pixel of a tile the direction of one of its points [16, 3], and
            points [16, K, 3] spread over the unit sphere: added to a surface's normal they give directions that are as
            dense as the sky's light counts there, by the cosine to the normal.
        """
        count = TILE * TILE
        back = -self.camera.pose[:3, 2]
        azimuth = np.arctan2(back[1], back[0]) - np.radians(KEY_AZIMUTH)
        elevation = np.radians(KEY_ELEVATION)
        key = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        side = np.cross(key, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        # Ordered dither: pixels that are near each other get points that are far from each other.
        order = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]).reshape(-1)
        disc = spread(2 * count)[order, :2] * np.tan(np.radians(KEY_WIDTH))
        rays = key + disc[:, :1] * side + disc[:, 1:] * np.cross(side, key)
        sphere = spread(SKY_RAYS * count)[np.arange(SKY_RAYS) * count + order[:, None]]
        return key.astype(np.float32), unit(rays.astype(np.float32)), (0.98 * sphere).astype(np.float32)

    def _gradient(self, x: NDArray[np.intp], y: NDArray[np.intp]) -> F32:
        width, height = self.camera.size
        middle, corner = (np.power(color, GAMMA) for color in BACKDROP)
        away = np.hypot(x / width - 0.5, y / height - 0.5) / np.hypot(0.5, 0.5)
        return (middle + (away**2)[:, None] * (corner - middle)).astype(np.float32)

    def _passed(self, bodies: Sequence[Placed], points: F32, normals: F32, cell: NDArray[np.intp]) -> F32:
        """Shares [P, 2] of the key light and of the sky that bodies let through to ``points`` [P, 3]."""
        passed = np.ones((len(points), 2), dtype=np.float32)
        columns = np.ascontiguousarray(points.T)
        for body, pose in bodies:
            if body.sign:
                continue
            which = body.shades(pose, columns, self._key, np.tan(np.radians(KEY_WIDTH)))
            passed[which, 0] *= ~body.blocks(pose, points[which], self._key_rays[cell[which]], np.inf)
            which = body.near(pose, columns, normals, OCCLUSION)
            origins, normal, at = points[which], normals[which], cell[which]
            free = np.zeros(len(which), dtype=np.float32)
            for k in range(SKY_RAYS):
                free += ~body.blocks(pose, origins, normal + self._sky_offsets[at, k], OCCLUSION)
            passed[which, 1] *= free / SKY_RAYS
        return passed

    def picture(self, moving: Sequence[Placed] = ()) -> NDArray[np.uint8]:
        """The image [H, W, 3] with the ``moving`` bodies, signs last, at their T_world_body [4, 4]."""
        width, height = self.camera.size
        seen, points, light = self._base.copy(), self._points.copy(), self._base_light.copy()
        changed = np.zeros(width * height, dtype=bool)
        for number, (body, pose) in enumerate(moving, start=1):
            (left, top), (right, bottom) = self._window(body, pose)
            window = (np.arange(top, bottom)[:, None] * width + np.arange(left, right)).reshape(-1)
            which, surface = body.hit(pose, self._eye, self._rays[window])
            changed[seen.put(window[which], surface, number + body.rank)] = True
        fresh = np.flatnonzero(changed)
        points[fresh] = self._points_of(seen, fresh)
        light[fresh] = self._passed([self._still], points[fresh], seen.normal[fresh], self._cell[fresh])
        light *= self._passed(moving, points, seen.normal, self._cell)
        smooth = self._smooth(seen, light)
        image = self._shade(seen, self._rays, smooth)
        edges = self._edges(seen)
        image[edges] = self._antialias(edges, seen, smooth, moving)
        return _encode(image).reshape(height, width, 3)

    def _window(self, body: Body, pose: NDArray[np.float64]) -> NDArray[np.intp]:
        """The corners [2, 2] (x, y) of a rectangle of pixels that holds all that the body may cover."""
        size = np.array(self.camera.size)
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        corners = (body.centre + body.half * signs) @ pose[:3, :3].T + pose[:3, 3]
        if ((corners - self._eye) @ self.camera.pose[:3, 2] <= 0).any():
            return np.array([[0, 0], size])
        ends = self.camera.project(corners)
        return np.clip([np.floor(ends.min(0)), np.ceil(ends.max(0))], 0, size).astype(np.intp)

    def _smooth(self, seen: Surface, light: F32) -> F32:
        """Mean light [P, 2] (key, sky) over the tile around each pixel, within one smooth surface."""
        width, height = self.camera.size
        shape = (height, width)
        value = np.ascontiguousarray(light.T).reshape(2, *shape)
        body, distance = seen.body.reshape(shape), seen.distance.reshape(shape)
        normal = [seen.normal[:, k].reshape(shape) for k in range(3)]
        for axis in (0, 1):
            kernels = []
            for step in range(1, TILE // 2 + 1):
                ahead = (slice(step, None), slice(None))[:: 1 - 2 * axis]
                behind = (slice(None, -step), slice(None))[:: 1 - 2 * axis]
                same = body[ahead] == body[behind]
                same &= sum(n[ahead] * n[behind] for n in normal) > 0.9
                same &= np.abs(distance[ahead] - distance[behind]) < 0.02 * distance[behind]
                kernels.append((ahead, behind, same * np.float32(0.5 if 2 * step == TILE else 1.0)))
            # Twice: once makes the mean over a tile, the second time blurs where that mean jumps.
            for _ in range(2):
                total, weight = value.copy(), np.ones(shape, dtype=np.float32)
                for ahead, behind, kernel in kernels:
                    for one, two in ((ahead, behind), (behind, ahead)):
                        total[(slice(None), *one)] += kernel * value[(slice(None), *two)]
                        weight[one] += kernel
                value = total / weight
        return np.ascontiguousarray(value.reshape(2, -1).T)

    def _shade(self, seen: Surface, rays: F32, light: F32) -> F32:
        """Linear colours [S, 3] of surfaces that get the shares ``light`` [S, 2] of key light and sky."""
        normal = seen.normal
        head = -dot(normal, rays)
        key = KEY * np.maximum(dot(normal, np.broadcast_to(self._key, normal.shape)), 0) * light[:, 0]
        sky = SKY * light[:, 1]
        amount = key + sky * (0.72 + 0.2 * normal[:, 2] + 0.12 * head)
        shadow = 1 - SHADOW * (1 - (key + sky) / (KEY * self._key[2] + SKY))
        amount = np.select(
            [seen.body >= SIGN, seen.body >= 0, seen.body == GROUND], [0.6 + 0.4 * head, amount, shadow], 1
        )
        image = seen.color * amount.astype(np.float32)[:, None]
        veiled = np.flatnonzero(seen.behind[:, 0])
        image[veiled] += GHOST * (seen.behind[veiled] - image[veiled])
        return image

    def _edges(self, seen: Surface) -> NDArray[np.intp]:
        """Pixels that differ from one beside them."""
        width, height = self.camera.size
        shape = (height, width)
        body, edge = seen.body.reshape(shape), np.zeros(shape, dtype=bool)
        normal = [seen.normal[:, k].reshape(shape) for k in range(3)]
        distance = seen.distance.reshape(shape)
        color, veil = seen.color[:, 2].reshape(shape), seen.behind[:, 2].reshape(shape)
        for ahead, behind in (
            ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
            ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ):
            other = body[ahead] != body[behind]
            other |= veil[ahead] != veil[behind]
            inner = color[ahead] != color[behind]
            inner |= sum(n[ahead] * n[behind] for n in normal) < 0.95
            inner |= np.abs(distance[ahead] - distance[behind]) > 0.02 * distance[behind]
            other |= inner & (body[ahead] >= 0)
            edge[ahead] |= other
            edge[behind] |= other
        return np.flatnonzero(edge)

    def _finely(self, pixels: NDArray[np.intp]) -> Surface:
        """The surfaces that several rays through each of ``pixels`` [E] hit without the moving bodies, [E * 4]."""
        rays = self._fine_rays(pixels)
        seen = self._empty(rays, np.repeat(self._backdrop[pixels], len(SUBPIXELS), axis=0))
        body, pose = self._still
        seen.put(*body.hit(pose, self._eye, rays), 0)
        return seen

    def _fine_rays(self, pixels: NDArray[np.intp]) -> F32:
        y, x = np.divmod(pixels, self.camera.size[0])
        return self.camera.rays((np.stack([x, y], axis=-1)[:, None] + SUBPIXELS).reshape(-1, 2))

    def _antialias(self, edges: NDArray[np.intp], seen: Surface, light: F32, moving: Sequence[Placed]) -> F32:
        """Colours [E, 3] of the pixels ``edges``: the mean of several rays through each."""
        width, height = self.camera.size
        count = len(SUBPIXELS)
        y, x = np.divmod(edges, width)
        rays = self._fine_rays(edges)
        slot = self._fine_of[edges]
        new = np.flatnonzero(slot < 0)
        slot[new] = len(self._fine.body) // count + np.arange(len(new))
        fine = self._fine.joined(self._finely(edges[new])).take((slot[:, None] * count + np.arange(count)).reshape(-1))
        for number, (body, pose) in enumerate(moving, start=1):
            (left, top), (right, bottom) = self._window(body, pose)
            inside = np.flatnonzero((x >= left) & (x < right) & (y >= top) & (y < bottom))
            inside = (inside[:, None] * count + np.arange(count)).reshape(-1)
            which, surface = body.hit(pose, self._eye, rays[inside])
            fine.put(inside[which], surface, number + body.rank)
        # The light is that of the pixel, or of a neighbour that shows the same surface.
        share = np.repeat(light[edges], count, axis=0)
        left = np.arange(len(rays))
        for dy, dx in ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)):
            pixel = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
            pixel = np.repeat(pixel, count)[left]
            same = (seen.body[pixel] == fine.body[left]) & (dot(fine.normal[left], seen.normal[pixel]) > 0.9)
            share[left[same]] = light[pixel[same]]
            left = left[~same]
        return self._shade(fine, rays, share).reshape(len(edges), count, 3).mean(1)


_TABLE = np.round(255 * (np.arange(4096) / 4095) ** (1 / GAMMA)).astype(np.uint8)


def _encode(linear: F32) -> NDArray[np.uint8]:
    return _TABLE[(np.clip(linear, 0, 1) * 4095 + 0.5).astype(np.int32)]
