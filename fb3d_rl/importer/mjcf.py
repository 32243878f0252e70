"""Read an MJCF: the bodies, shapes and joints of the model that MuJoCo compiles from it.

docs/objects.md lists the rules. The text is made safe before (:mod:`fb3d_rl.importer.mjcf_text`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import Joint, JointType, Link, Mesh, Mimic
from fb3d_rl.assets.cache import Parsed
from fb3d_rl.assets.shapes import completed, each_once, solid
from fb3d_rl.assets.urdf_joints import FARTHEST, followed, held, limited
from fb3d_rl.errors import UserError
from fb3d_rl.importer.files import Source
from fb3d_rl.importer.mjcf_text import Composer, Text
from fb3d_rl.importer.names import part_name

EXTRA = "mujoco"
"""The extra of this package that installs MuJoCo."""

TYPES: dict[str, JointType] = {"hinge": "revolute", "slide": "prismatic"}
"""The joints of one degree of freedom; those of several are read as fixed."""

BOUNDED = ("body_pos", "body_quat", "geom_pos", "geom_quat", "jnt_pos", "jnt_axis", "qpos0", "eq_data")
"""Arrays of the compiled model of which no value may be beyond measure."""

SHOWN = 3
"""MuJoCo draws the geoms of the groups below unless it is told otherwise."""

HIDES = 0.1
"""What is seen only hides a shape that is touched if its box holds it, enlarged by this share of its diagonal."""

TURN = 2 * math.pi
"""Angles in no named unit are radians if all of them are smaller: hardly any part turns by six degrees at most."""

LISTED = 20
"""At most so many bodies are listed."""


class MjcfReader:
    """Reads one MJCF.

    Args:
        source: the file.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.dropped: list[str] = []
        self.lost: list[str] = []

    def fail(self, what: str) -> NoReturn:
        raise UserError(f"object {self.source.id}: {what}; correct or remove {self.source.path}")

    def read(self) -> Parsed:
        """The links, parents first, and the remarks on what was read.

        Raises:
            UserError: something is missing or broken, or the package mujoco is.
            ParseError, DefusedXmlException: the file is no well-formed XML or holds entities.
        """
        text = Composer(self.source, self.fail, self.dropped.append, self.lost.append).compose()
        try:
            import mujoco
        except ImportError as error:
            raise UserError(
                f"object {self.source.id}: {self.source.path} is an MJCF, which the package mujoco reads ({error}): "
                f"pip install 'fb3d_rl[{EXTRA}]'"
            ) from error
        self.mujoco: Any = mujoco
        self.model = self.compiled(text)
        for key in BOUNDED:
            values = abs(getattr(self.model, key))
            if not (values <= FARTHEST).all():
                self.fail(f"it compiles to a {key} of {values.max():.3g}, where {FARTHEST:g} is the most that is read")
        links = limited(self.links(), self.dropped.append)
        lost = tuple(dict.fromkeys(self.lost))
        return links, (*lost, *dict.fromkeys(self.dropped)), lost

    def compiled(self, text: Text) -> Any:
        """The compiled model. Parts of models often rely on another file for the unit of angles: it is recognised."""
        model = self.compile(text.xml(), text)
        turning = [
            j for j in range(model.njnt) if model.jnt_limited[j] and self.kind("Joint", model.jnt_type[j]) == "hinge"
        ]
        largest = float(abs(np.degrees(model.jnt_range[turning])).max(initial=0.0))
        if text.unit_named or not 0.0 < largest < TURN or text.largest_turn > TURN:
            return model
        self.dropped.append(f"angles: in no named unit and at most {largest:.3g}, so they are taken as radians")
        return self.compile(text.xml("radian"), text)

    def compile(self, xml: str, text: Text) -> Any:
        # MuJoCo's own way is to write warnings into a file of the working folder.
        self.mujoco.set_mju_user_warning(self.dropped.append)
        try:
            with _quiet():
                return self.mujoco.MjModel.from_xml_string(xml, text.assets)
        except (ValueError, RuntimeError, self.mujoco.FatalError) as error:
            self.fail(f"MuJoCo cannot compile it ({' '.join(str(error).split())})")
        finally:
            self.mujoco.set_mju_user_warning(None)

    def kind(self, of: str, number: int) -> str:
        """The name of a type of joint, geom or equality."""
        return str(getattr(self.mujoco, f"mjt{of}")(number).name).rpartition("_")[2].lower()

    def links(self) -> list[Link]:
        """The links of the file, or of the body that was asked for, with the limits of the file."""
        model, first = self.model, self.body()
        taken = {first}
        for body in range(first + 1, model.nbody):  # parents have smaller numbers
            if model.body_parentid[body] in taken:
                taken.add(body)
        names = _named([model.body(i).name for i in range(model.nbody)], "body")
        joints = self.joints(names, taken)
        links = [Link("world", "", -1, None, *(self.shapes(0, np.eye(4)) if first == 0 else ((), ())))]
        stands = [(0, np.eye(4))]  # of each body: its last link, T_link_body
        for body in range(1, model.nbody):
            parent, pose = stands[model.body_parentid[body]]
            pose = pose @ _pose(model.body_pos[body], model.body_quat[body])
            for number, (joint, anchor) in enumerate(joints.get(body, []), 1):
                # Each joint moves what the next ones carry; only the last link has shapes.
                last = number == len(joints[body])
                name = names[body] if last else f"{names[body]}:{number}"
                origin = pose @ _moved(anchor) @ joint.origin
                pose = _moved(-anchor)
                visuals, collisions = self.shapes(body, pose) if last else ((), ())
                links.append(Link(name, part_name(name), parent, replace(joint, origin=origin), visuals, collisions))
                parent = len(links) - 1
            stands.append((parent, pose))
        return links

    def body(self) -> int:
        """The body that was asked for; 0, the world, for all of them.

        Raises:
            UserError: no body is called so.
        """
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        if self.source.body is None:
            free = [names[i] or f"body {i}" for i in range(1, len(names)) if self.model.body_parentid[i] == 0]
            if len(free) > 1:
                self.dropped.append(
                    f"the bodies {_listed(free)} stand side by side and are read as one object; assets.body=NAME takes "
                    "one body"
                )
            return 0
        if self.source.body not in names:
            raise UserError(
                f"object {self.source.id}: {self.source.path} has no body {self.source.body!r}; its bodies are "
                f"{_listed([name for name in names if name])}"
            )
        return names.index(self.source.body)

    def joints(
        self, bodies: Sequence[str], taken: Collection[int]
    ) -> dict[int, list[tuple[Joint, NDArray[np.float64]]]]:
        """Body of those taken -> its joints in the order in which they move it, each with its anchor [3] in its frame.

        A body that does not move has a fixed one. Positions count from where the file shows the model.
        """
        model = self.model
        names = _named([model.joint(j).name for j in range(model.njnt)], "joint")
        follows = self.equalities(names, taken)
        found: dict[str, tuple[str, Joint]] = {}
        places: dict[int, list[tuple[str, NDArray[np.float64]]]] = {}
        for j, name in enumerate(names):
            kind = self.kind("Joint", model.jnt_type[j])
            if model.jnt_bodyid[j] not in taken:
                continue
            if kind not in TYPES:
                self.dropped.append(f"joint {name}: {kind}, read as fixed")
                continue
            limits, joint_type = (-math.inf, math.inf), TYPES[kind]
            if model.jnt_limited[j]:
                lower, upper = model.jnt_range[j] - model.qpos0[model.jnt_qposadr[j]]
                limits = (float(lower), float(upper))
                if math.isnan(lower) or math.isnan(upper):
                    self.fail(f"joint {name} has limits that are no numbers")
            elif kind == "hinge":
                joint_type = "continuous"
                self.dropped.append(f"joint {name}: no range, so it turns without end and opens nothing")
            joint = Joint(name, joint_type, np.eye(4), np.array(model.jnt_axis[j]), limits, follows.get(name))
            found[name] = ("", held(joint, joint.mimic.offset) if joint.mimic and not joint.mimic.joint else joint)
            places.setdefault(int(model.jnt_bodyid[j]), []).append((name, np.array(model.jnt_pos[j])))
        found = followed(found, self.fail, self.dropped.append)
        moving = {body: [(found[name][1], anchor) for name, anchor in at] for body, at in places.items()}
        for body in set(taken) - {0}:
            fixed = Joint(f"{bodies[body]}:fixed", "fixed", np.eye(4), np.zeros(3), (0.0, 0.0))
            moving.setdefault(body, [(fixed, np.zeros(3))])
        return moving

    def equalities(self, names: Sequence[str], taken: Collection[int]) -> dict[str, Mimic]:
        """Joint -> the one that it follows, "" for none; MuJoCo counts both from where the file shows the model."""
        model, found = self.model, dict[str, Mimic]()
        for e in range(model.neq):
            one, other = (int(ids[e]) for ids in (model.eq_obj1id, model.eq_obj2id))
            offset, factor, *powers = (float(value) for value in model.eq_data[e, :5])
            if not model.eq_active0[e] or model.jnt_bodyid[one] not in taken:
                continue
            if any(powers) or names[one] in found:
                self.dropped.append(f"joint {names[one]}: an equality that is not linear or not the first is not read")
            elif other >= 0:
                found[names[one]] = Mimic(names[other], factor, offset)
            else:
                self.dropped.append(f"joint {names[one]}: an equality holds it, fixed at {offset:g}")
                found[names[one]] = Mimic("", 0.0, offset)
        return found

    def shapes(self, body: int, pose: NDArray[np.float64]) -> tuple[tuple[Mesh, ...], tuple[Mesh, ...]]:
        """What of a body is seen and what is touched, in its link's frame.

        Seen are the shapes that MuJoCo draws, without those that are touched and lie behind others that are not.

        Args:
            body: the body.
            pose: T_link_body [4, 4].
        """
        model, name = self.model, self.model.body(body).name or f"body_{body}"
        touched, drawn, alone = list[Mesh](), list[tuple[Mesh, bool]](), list[Mesh]()
        for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
            if self.kind("Geom", model.geom_type[geom]) == "plane":
                self.dropped.append(f"geom {model.geom(geom).name or f'of {name}'}: a plane, left out")
                continue
            mesh = self.surface(geom, pose @ _pose(model.geom_pos[geom], model.geom_quat[geom]))
            touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            touched += [mesh] * touches
            if model.geom_rgba[geom, 3] > 0 and model.geom_group[geom] < SHOWN:
                drawn.append((mesh, touches))
                alone += [mesh] * (not touches)
        seen = [mesh for mesh, touches in drawn if not (touches and alone and _hidden(mesh, alone))]
        return completed(name, tuple(seen), tuple(touched), self.dropped.append)

    def surface(self, geom: int, pose: NDArray[np.float64]) -> Mesh:
        """The mesh of a geom, moved by T_link_geom [4, 4]."""
        model, kind, size = self.model, self.kind("Geom", self.model.geom_type[geom]), self.model.geom_size[geom]
        if kind in ("mesh", "sdf"):
            of = model.geom_dataid[geom]
            vertices = model.mesh_vert[model.mesh_vertadr[of] :][: model.mesh_vertnum[of]].astype(np.float64)
            faces = model.mesh_face[model.mesh_faceadr[of] :][: model.mesh_facenum[of]].astype(np.int64)
            mesh = Mesh(*each_once(vertices @ pose[:3, :3].T + pose[:3, 3], faces))
        elif not size.max() <= FARTHEST:
            self.fail(f"a {kind} has the size {' '.join(f'{value:g}' for value in size)}")
        else:
            # MuJoCo gives half of the sides and lengths
            with np.errstate(invalid="ignore"):  # of next to no size
                mesh = solid(kind, size * {"box": (2, 2, 2), "ellipsoid": (1, 1, 1)}.get(kind, (1, 2, 1)), pose)
        if not abs(mesh.vertices).max() <= FARTHEST:
            self.fail(f"a {kind} reaches {abs(mesh.vertices).max():.3g} m from its body")
        return mesh


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep standard error clean: MuJoCo's Qhull writes pages there about a flat mesh, besides the error that it is."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _pose(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """T [4, 4] of a position [3] and a quaternion [4] (w first)."""
    transform = _moved(position)
    transform[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    return transform


def _moved(position: NDArray[np.float64]) -> NDArray[np.float64]:
    transform = np.eye(4)
    transform[:3, 3] = position
    return transform


def _hidden(mesh: Mesh, others: Sequence[Mesh]) -> bool:
    """Whether a mesh lies in the box of others, a little enlarged."""
    corners = np.concatenate([other.vertices for other in others])
    slack = HIDES * np.linalg.norm(np.ptp(corners, axis=0))
    inside = (mesh.vertices >= corners.min(0) - slack) & (mesh.vertices <= corners.max(0) + slack)
    return bool(inside.all())


def _named(names: Sequence[str], kind: str) -> list[str]:
    """The names, with others for those that are empty."""
    found = list(names)
    for i, name in enumerate(names):
        wanted = name or f"{kind}_{i}"
        while not name and wanted in found:
            wanted += "_"
        found[i] = wanted
    return found


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")
