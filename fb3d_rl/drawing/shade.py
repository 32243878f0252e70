"""Shaded pictures on the CPU: Embree rays, a soft key light, a bright sky and a ground that catches shadows.

No Vulkan and no GPU. A :class:`Studio` has one camera and the bodies that stay where they are: what they look like,
and which light they take from each other, is found once. A picture then only costs the rays at what moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.embree import triangle_scene
from fb3d_rl.camera.views import View, look_at

F32 = NDArray[np.float32]
Color = tuple[float, float, float]

CREASE = 40.0
"""Faces that meet at less than this angle (degrees) are shaded as one smooth surface."""

TILE = 4
"""Side (pixels) of the square in which every pixel looks for light in other directions."""

SKY_RAYS = 3
"""Directions in which a pixel looks for the sky."""

KEY, SKY = 0.62, 0.52
"""Light of the key light on a surface that faces it, and of a sky that nothing hides."""

KEY_AZIMUTH, KEY_ELEVATION, KEY_WIDTH = 42.0, 48.0, 6.0
"""Where the key light stands (degrees, to the left of the camera and above the horizon), and half the angle under which
it is seen, which makes its shadows soft."""

SHADOW = 0.75
"""How dark the ground gets where no light comes; 1 is black."""

OCCLUSION = 0.35
"""How far (m) a surface looks for others that keep the sky's light from it."""

BACKDROP = (0.985, 0.988, 0.992), (0.90, 0.915, 0.93)
"""Colours (sRGB) of the background in the middle and in the corners of the image."""

GAMMA = 2.2
"""Colours are sRGB numbers; light adds up in their powers of this."""

SUBPIXELS = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]])
"""Where (x, y) in a pixel the rays go that smooth an edge."""

GHOST = 0.3
"""How much of a sign is seen through what hides it."""

FAR = 1e6
"""Distance (m) of the empty background."""

GROUND, NOTHING, OPAQUE, SIGN = -1, -2, 1000, 2000
"""Numbers of the ground and of the empty background among those of bodies, and the first of opaque ones and signs."""


def srgb(code: str) -> Color:
    """The color of a code such as "#3f7fd0"."""
    red, green, blue = (int(code[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


STATIC, MOVABLE, TARGET, GRIPPER = srgb("#cdd2d9"), srgb("#aebccd"), srgb("#3f7fd0"), srgb("#3a3f47")


def link_colors(obj: ArticulatedObject, *links: int) -> list[Color]:
    """Colors of the object's links: what ``links`` carry, what else can move, what stands."""
    target = {i for each in links for i in obj.descendants(each)}
    movable = {i for each in obj.movable for i in obj.descendants(each)}
    return [TARGET if i in target else MOVABLE if i in movable else STATIC for i in range(len(obj.links))]


@dataclass(frozen=True, eq=False)
class Part:
    """Meshes of one colour [3] (sRGB, 0 to 1) at T_body_part [4, 4] in a body's frame."""

    meshes: Sequence[Mesh]
    color: Color
    pose: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


class Body:
    """A rigid body made of parts, with one static Embree scene in its own frame.

    The sense in which faces turn does not matter: both of their sides are seen.

    Args:
        parts: the parts.
        sign: this is a sign such as an arrow: it neither takes light from others nor do they from it, and it shimmers
            through what hides it.
        opaque: no sign shimmers through this.
    """

    def __init__(self, parts: Iterable[Part], sign: bool = False, opaque: bool = False) -> None:
        self.sign = sign
        self.rank = SIGN if sign else OPAQUE if opaque else 0
        corners, normals, colors = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
        for part in parts:
            rotation, shift = part.pose[:3, :3], part.pose[:3, 3]
            for mesh in (mesh for mesh in part.meshes if len(mesh.faces)):
                corners.append(mesh.vertices[mesh.faces] @ rotation.T + shift)
                normals.append(_corner_normals(mesh) @ rotation.T)
                colors.append(np.tile(np.power(part.color, GAMMA), (len(mesh.faces), 1)))
        triangles = np.concatenate(corners).astype(np.float32)
        self._points: F32 = triangles.reshape(-1, 3)
        self.normals: F32 = np.concatenate(normals).astype(np.float32)
        """Unit normals [F, 3, 3] at the corners of all faces."""
        self._colors: F32 = np.concatenate(colors).astype(np.float32)
        self.centre, self.half = np.zeros(3), np.zeros(3)
        self._scene = None
        if len(triangles):
            low, high = (ends.astype(np.float64) for ends in (self._points.min(0), self._points.max(0)))
            self.centre, self.half = 0.5 * (low + high), 0.5 * (high - low)
            """Centre [3] and half extents [3] (m) of the bounding box in the body's frame."""
            self._scene = triangle_scene(triangles)
        self.radius = float(np.linalg.norm(self.half))

    def outline(self) -> NDArray[np.float64]:
        """Points [64, 3] (m) of the body that reach furthest, in its own frame; none of an empty body."""
        if not len(self._points):
            return np.zeros((0, 3))
        return self._points[(self._points @ _spread(64).T.astype(np.float32)).argmax(0)].astype(np.float64)

    def hit(self, pose: NDArray[np.float64], eye: NDArray[np.float64], rays: F32) -> tuple[NDArray[np.intp], _Surface]:
        """Which of the unit ``rays`` [R, 3] from ``eye`` [3] hit the body at T_world_body ``pose``, and what there."""
        if self._scene is None or not len(rays):
            none = np.zeros((0, 3), dtype=np.float32)
            return np.zeros(0, dtype=np.intp), _Surface(none[:, 0], none, none, np.zeros(0, dtype=np.int16), none)
        rotation = pose[:3, :3].astype(np.float32)
        origin = (pose[:3, :3].T @ (eye - pose[:3, 3])).astype(np.float32)
        found = self._scene.run(np.tile(origin, (len(rays), 1)), rays @ rotation, output=True)
        which = np.flatnonzero(found["primID"] >= 0)
        triangle, u, v = (found[key][which] for key in ("primID", "u", "v"))
        corners = self.normals[triangle]
        normal = corners[:, 0] * (1 - u - v)[:, None] + corners[:, 1] * u[:, None] + corners[:, 2] * v[:, None]
        normal = _unit(normal) @ rotation.T
        normal *= np.where(_dot(normal, rays[which]) > 0, -1, 1).astype(np.float32)[:, None]
        body = np.zeros(len(which), dtype=np.int16)
        return which, _Surface(found["tfar"][which], normal, self._colors[triangle], body, np.zeros_like(normal))

    def blocks(self, pose: NDArray[np.float64], origins: F32, rays: F32, reach: float) -> NDArray[np.bool_]:
        """Whether the body at ``pose`` lies within ``reach`` m on each of the unit ``rays`` [R, 3] from ``origins``."""
        if self._scene is None or not len(rays):
            return np.zeros(len(rays), dtype=bool)
        rotation = pose[:3, :3].astype(np.float32)
        starts = (origins - pose[:3, 3].astype(np.float32)) @ rotation
        limits = np.full(len(rays), reach, dtype=np.float32)
        return np.asarray(self._scene.run(starts, rays @ rotation, limits, query="OCCLUDED") >= 0)

    def shades(self, pose: NDArray[np.float64], points: F32, direction: F32, slope: float) -> NDArray[np.intp]:
        """Which of ``points`` [3, P] may have the body in the cone of that ``slope`` about the ``direction`` [3]."""
        x, y, z = (pose[:3, :3] @ self.centre + pose[:3, 3]).astype(np.float32)[:, None] - points
        along = x * direction[0] + y * direction[1] + z * direction[2]
        limit = self.radius + slope * np.maximum(along, 0)
        return np.flatnonzero((x * x + y * y + z * z - along * along < limit * limit) & (along > -self.radius))

    def near(self, pose: NDArray[np.float64], points: F32, normals: F32, reach: float) -> NDArray[np.intp]:
        """Which of ``points`` [3, P] may have the body within ``reach`` m on the side of their ``normals`` [P, 3]."""
        centre = (pose[:3, :3] @ self.centre + pose[:3, 3]).astype(np.float32)
        x, y, z = points - centre[:, None]
        within = np.flatnonzero(x * x + y * y + z * z < (self.radius + reach) ** 2)
        to_body, half = pose[:3, :3].T.astype(np.float32), self.half.astype(np.float32)[:, None]
        local, normal = to_body @ points[:, within] - (to_body @ centre)[:, None], to_body @ normals[within].T
        away = np.maximum(np.abs(local) - half, 0)
        # How far the bounding box's highest corner is above the surface.
        height = (np.abs(normal) * half - normal * local).sum(0)
        return within[((away * away).sum(0) < reach * reach) & (height > 0)]


Placed = tuple[Body, NDArray[np.float64]]
"""A body and its pose T_world_body [4, 4]."""


def _spread(count: int) -> NDArray[np.float64]:
    """Points [count, 3] spread over the unit sphere from its top to its bottom, on a golden spiral."""
    number = np.arange(count)
    z = 1.0 - 2.0 * (number + 0.5) / count
    angle, ring = np.pi * (3.0 - np.sqrt(5.0)) * number, np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)


def _dot(a: F32, b: F32) -> F32:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _unit(a: F32) -> F32:
    return np.divide(a, np.maximum(np.sqrt(_dot(a, a)), 1e-6)[:, None], dtype=np.float32)


def _corner_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals [F, 3, 3] at the faces' corners: area-weighted mean over the faces that meet smoothly there."""
    triangles = mesh.vertices[mesh.faces]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=-1, keepdims=True), 1e-12)
    _, welded = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    vertex = welded.reshape(-1)[mesh.faces].reshape(-1)
    order = np.argsort(vertex, kind="stable")
    _, start, count = np.unique(vertex[order], return_index=True, return_counts=True)
    # All pairs of corners at one vertex, in runs with the same first corner.
    number = np.repeat(count, count)
    begin = np.cumsum(number) - number
    second = np.repeat(np.repeat(start, count) - begin, number) + np.arange(number.sum())
    mine, other = np.repeat(order, number) // 3, order[second] // 3
    cosine = (unit[mine] * unit[other]).sum(-1)
    weight = np.where(np.abs(cosine) >= np.cos(np.radians(CREASE)), np.sign(cosine), 0.0)
    normals = np.empty((len(vertex), 3))
    normals[order] = np.add.reduceat(area[other] * weight[:, None], begin, axis=0)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return normals.reshape(-1, 3, 3)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        pose: T_world_camera [4, 4]; x right, y down, z forward.
        size: width and height of the image, pixels.
        fov: field of view across the width, degrees.
    """

    pose: NDArray[np.float64]
    size: tuple[int, int]
    fov: float

    @classmethod
    def fitting(
        cls, view: View, points: NDArray[np.float64], size: tuple[int, int], fov: float = 28.0, margin: float = 0.05
    ) -> Camera:
        """The nearest camera in the direction of ``view`` whose image has all ``points`` [P, 3] (m).

        ``margin`` is the share of the image that stays free on each side.
        """
        pose = look_at(view, np.zeros(3), 0.0)
        seen = points @ pose[:3, :3]
        slope = np.tan(np.radians(0.5 * fov)) * (1 - 2 * margin) * np.array([1.0, size[1] / size[0]])
        # All points lie between the planes through two opposite edges of the image: two bounds on the eye for each.
        right = (seen[:, :2] - slope * seen[:, 2:]).max(0)
        left = (-seen[:, :2] - slope * seen[:, 2:]).max(0)
        eye = np.append(0.5 * (right - left), (-0.5 * (right + left) / slope).min())
        pose[:3, 3] = pose[:3, :3] @ eye
        return cls(pose, size, fov)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(0.5 * self.size[0] / np.tan(np.radians(0.5 * self.fov)))

    def rays(self, at: NDArray[np.float64]) -> F32:
        """Unit rays [R, 3] in the world through the image points ``at`` [R, 2] (pixels; x right, y down)."""
        across = (at - 0.5 * np.array(self.size)) / self.focal
        rays = np.column_stack([across, np.ones(len(at))]) @ self.pose[:3, :3].T
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image points [P, 2] (pixels) of world points [P, 3] in front of the camera."""
        seen = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        return np.asarray(self.focal * seen[:, :2] / seen[:, 2:] + 0.5 * np.array(self.size))


@dataclass
class _Surface:
    """What S rays meet: distance (m), unit normal towards the eye, linear colour and the body's number.

    ``behind`` is the colour of a sign that this hides, black where there is none.
    """

    distance: F32
    normal: F32
    color: F32
    body: NDArray[np.int16]
    behind: F32

    def take(self, where: NDArray[np.intp]) -> _Surface:
        return _Surface(*(values[where] for values in vars(self).values()))

    def joined(self, other: _Surface) -> _Surface:
        return _Surface(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def put(self, where: NDArray[np.intp], other: _Surface, body: int) -> NDArray[np.intp]:
        """Take over what of ``other`` [len(where)] is nearer; return where that is so."""
        nearer = other.distance < self.distance[where]
        taken = where[nearer]
        self.distance[taken], self.normal[taken] = other.distance[nearer], other.normal[nearer]
        self.color[taken], self.body[taken] = other.color[nearer], body
        if body >= SIGN:
            veiled = ~nearer & (self.body[where] < OPAQUE)
            self.behind[where[veiled]] = other.color[veiled]
        return taken

    def copy(self) -> _Surface:
        return _Surface(*(values.copy() for values in vars(self).values()))


class Studio:
    """One camera before bodies that stay where they are.

    Args:
        camera: the camera.
        still: what does not move, in the world's frame.
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

    def _empty(self, rays: F32, backdrop: F32) -> _Surface:
        """The ground and the background behind it, as ``rays`` [S, 3] meet them."""
        distance, normal = np.full(len(rays), FAR, np.float32), np.zeros((len(rays), 3), np.float32)
        body = np.full(len(rays), NOTHING, dtype=np.int16)
        down = np.flatnonzero((rays[:, 2] < -1e-3) & (self._eye[2] > 0))
        distance[down], normal[down], body[down] = -self._eye[2] / rays[down, 2], (0, 0, 1), GROUND
        return _Surface(distance, normal, backdrop.copy(), body, np.zeros_like(normal))

    def _points_of(self, seen: _Surface, where: NDArray[np.intp]) -> F32:
        """Where the rays ``where`` meet what they see, a little before it."""
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
        disc = _spread(2 * count)[order, :2] * np.tan(np.radians(KEY_WIDTH))
        rays = key + disc[:, :1] * side + disc[:, 1:] * np.cross(side, key)
        sphere = _spread(SKY_RAYS * count)[np.arange(SKY_RAYS) * count + order[:, None]]
        return key.astype(np.float32), _unit(rays.astype(np.float32)), (0.98 * sphere).astype(np.float32)

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

    def _smooth(self, seen: _Surface, light: F32) -> F32:
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

    def _shade(self, seen: _Surface, rays: F32, light: F32) -> F32:
        """Linear colours [S, 3] of surfaces that get the shares ``light`` [S, 2] of key light and sky."""
        normal = seen.normal
        head = -_dot(normal, rays)
        key = KEY * np.maximum(_dot(normal, np.broadcast_to(self._key, normal.shape)), 0) * light[:, 0]
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

    def _edges(self, seen: _Surface) -> NDArray[np.intp]:
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

    def _finely(self, pixels: NDArray[np.intp]) -> _Surface:
        """What several rays through each of ``pixels`` [E] meet without the moving bodies, [E * 4]."""
        rays = self._fine_rays(pixels)
        seen = self._empty(rays, np.repeat(self._backdrop[pixels], len(SUBPIXELS), axis=0))
        body, pose = self._still
        seen.put(*body.hit(pose, self._eye, rays), 0)
        return seen

    def _fine_rays(self, pixels: NDArray[np.intp]) -> F32:
        y, x = np.divmod(pixels, self.camera.size[0])
        return self.camera.rays((np.stack([x, y], axis=-1)[:, None] + SUBPIXELS).reshape(-1, 2))

    def _antialias(self, edges: NDArray[np.intp], seen: _Surface, light: F32, moving: Sequence[Placed]) -> F32:
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
            same = (seen.body[pixel] == fine.body[left]) & (_dot(fine.normal[left], seen.normal[pixel]) > 0.9)
            share[left[same]] = light[pixel[same]]
            left = left[~same]
        return self._shade(fine, rays, share).reshape(len(edges), count, 3).mean(1)


_TABLE = np.round(255 * (np.arange(4096) / 4095) ** (1 / GAMMA)).astype(np.uint8)


def _encode(linear: F32) -> NDArray[np.uint8]:
    return _TABLE[(np.clip(linear, 0, 1) * 4095 + 0.5).astype(np.int32)]
