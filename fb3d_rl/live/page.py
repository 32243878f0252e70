"""The live page: the view of :class:`~fb3d_rl.live.session.Session` in the browser.

It is made with viser, which serves sliders and a 3D scene from Python, reports clicks on meshes, and brings its own
client, so that it works offline. Rerun's viewer takes no input; plotly with Dash sends the whole figure again for each
move of a slider.

viser calls back in threads of its own, but network and simulator run in one: a callback queues a request, and the loop
that owns the session runs it. Of a slider's many positions only the last one counts.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from trimesh.util import append_faces

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.assets.gripper import gripper_meshes
from fb3d_rl.camera.views import View, look_at
from fb3d_rl.drawing.bodies import GRIPPER, Color, link_colors, srgb
from fb3d_rl.drawing.signs import FLOW, FREE, HOLDING, arrow_mesh, cup_mesh
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import matrix_to_quaternion, quaternion_to_matrix
from fb3d_rl.live.moment import Moment, status
from fb3d_rl.live.server import HOST, start_server
from fb3d_rl.live.session import Session

COLORS: dict[str, Color] = {"predicted": FLOW, "true": srgb("#2c9f5b")}
"""Of the arrows of each flow."""

LABELS = {"predicted": "Predicted flow (orange)", "true": "True flow (green)"}
"""Of the boxes that show them."""

SEEN, PART, CONTACT, CAMERA = srgb("#868e99"), srgb("#1f4f8f"), srgb("#e0218a"), srgb("#5b6470")
"""Of points of the cloud, of those on the part, of the contact point and of the camera."""

ARROWS = 50
"""Arrows of each flow."""

LENGTH = 0.13
"""Length of an arrow of flow 1, in diameters of the object."""


def require_viser() -> Any:
    """The module viser.

    Raises:
        UserError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise UserError(f'the live page needs viser ({error}); install it: pip install "fb3d_rl[view]"') from error
    return viser


def serve(
    session: Session,
    port: int,
    until: Callable[[], bool] = lambda: False,
    page: Callable[[Any, Any], Page] | None = None,
) -> None:
    """Serve the page and run its requests, until Ctrl-C.

    Args:
        session: the session to show; it is closed at the end.
        port: the port, or if it is taken the next free one; it is printed.
        until: called between requests; True ends the page.
        page: makes the page from server and session; :class:`Page` unless given.

    Raises:
        UserError: viser is not installed.
    """
    require_viser()
    name = f"{session.obj.category} {session.obj.id}"
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # browsers open connections that they do not use
    server = start_server(port, name)
    try:
        served = (page or Page)(server, session)
        taken = "" if server.get_port() == port else f" (port {port} is taken)"
        print(f"{name}: http://{HOST}:{server.get_port()}{taken}; Ctrl-C ends it", flush=True)
        while not until():
            served.attend()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
        session.close()


class Page:
    """Controls and 3D scene of a session.

    Args:
        server: a ``viser.ViserServer``.
        session: the session to show.
    """

    def __init__(self, server: Any, session: Session) -> None:
        self._server, self._session = server, session
        self._requests: dict[object, Callable[[], None]] = {}
        self._wake = threading.Condition()
        self._playing = False
        self._part = -1
        self._bodies: list[Any] = []
        self._held: bool | None = None
        server.gui.configure_theme(
            control_layout="collapsible", control_width="large", show_logo=False, show_share_button=False
        )
        server.scene.set_up_direction("+z")
        server.scene.add_grid("/ground", width=6.0, height=6.0, cell_size=0.25, plane="xy")
        self._camera = server.scene.add_camera_frustum(
            "/camera", fov=session.field_of_view, aspect=1.0, scale=0.06 * session.size, color=CAMERA
        )
        server.on_client_connect(self._welcome)
        self._controls()
        self._draw()

    # -------------------------------------------------------------------------------------------------- requests

    def _request(self, key: object, request: Callable[[], None]) -> None:
        """Queue a request from any thread; it replaces an earlier one of the same key."""
        with self._wake:
            self._requests.pop(key, None)
            self._requests[key] = request
            self._wake.notify()

    def attend(self, patience: float = 0.5) -> None:
        """Run the queued requests; wait at most ``patience`` s for one, or make a control step while it plays."""
        with self._wake:
            if not self._requests and not self._playing:
                self._wake.wait(patience)
            requests, self._requests = list(self._requests.values()), {}
        begun = time.monotonic()
        if not requests and not self._playing:
            return
        try:
            self._say("")
            for request in requests:
                request()
            if self._playing:
                self._step()
        except UserError as error:
            self._playing = False
            self._say(f"**{error}**")
        self._draw()
        if self._playing:  # no faster than the robot
            with self._wake:
                if not self._requests:
                    self._wake.wait(max(0.0, begun + self._session.period - time.monotonic()))

    def _step(self) -> None:
        if self._session.trial is None and not self._session.loaded:
            self._say("Loading the simulator …")
        self._session.step()
        trial = self._session.trial
        self._playing &= trial is not None and not trial.done

    def _act(self, button: str) -> None:
        self._playing = button == "Play"
        if button == "Step":
            self._step()
        elif button == "Reset":
            self._session.reset()

    # ------------------------------------------------------------------------------------------------ controls

    def _controls(self) -> None:
        gui, session = self._server.gui, self._session

        def on_change(handle: Any, set_to: Callable[[Any], None]) -> None:
            @handle.on_update
            def _(event: Any) -> None:
                if event.client is not None:  # and not by this page itself
                    self._request(f"set {id(handle)}", lambda: self._change(lambda: set_to(event.target.value)))

        gui.set_panel_label(f"{session.obj.category} {session.obj.id}")
        names = {f"{session.obj.links[i].semantic} · {session.obj.links[i].name}": i for i in session.parts}
        self._part_names = {link: name for name, link in names.items()}
        self._part_control = gui.add_dropdown("Open", list(names), initial_value=self._part_names[session.link])
        on_change(self._part_control, lambda name: session.set_part(names[name]))
        with gui.add_folder("Policy"):
            self._acts_on = gui.add_dropdown(
                "Acts on", [f"{name} flow" for name in session.flows], initial_value=f"{session.flow} flow"
            )
            on_change(self._acts_on, lambda name: session.set_flow(name.removesuffix(" flow")))
            buttons = gui.add_button_group("Trial", ("Step", "Play", "Pause", "Reset"))

            @buttons.on_click
            def _(event: Any) -> None:
                button = str(event.target.value)
                self._request(object(), lambda: self._act(button))  # each press counts

            self._status = gui.add_markdown("")
            self._message = gui.add_markdown("")
        with gui.add_folder("Flow"):
            self._measured = gui.add_markdown("")
            self._shown = {name: gui.add_checkbox(LABELS[name], True) for name in reversed(session.flows)}
            self._shown["cloud"] = gui.add_checkbox("Points that the camera sees", True)
            for box in self._shown.values():
                box.on_update(lambda event: self._request("show", lambda: None))
        with gui.add_folder("Joints"):
            self._joints = []
            for j, (low, high) in enumerate(session.limits):
                link = session.obj.links[session.obj.movable[j]]
                slides = session.obj.joint_of(session.obj.movable[j]).type == "prismatic"
                unit, scale = ("cm", 100.0) if slides else ("°", 180 / np.pi)
                slider = gui.add_slider(
                    f"{link.semantic} · {link.name} ({unit})",
                    min=round(scale * low, 1),
                    max=max(round(scale * high, 1), round(scale * low, 1) + 0.1),
                    step=0.1,
                    initial_value=round(scale * float(session.moment.qpos[j]), 1),
                )
                on_change(slider, partial(self._set_joint, j, scale))
                self._joints.append((slider, scale))
        with gui.add_folder("Camera of the policy"):
            self._azimuth = gui.add_slider(
                "Azimuth (°)", min=-180, max=180, step=1, initial_value=round(session.view.azimuth)
            )
            self._elevation = gui.add_slider(
                "Elevation (°)", min=0, max=89, step=1, initial_value=round(session.view.elevation)
            )
            on_change(self._azimuth, lambda value: session.set_view(View(float(value), session.view.elevation)))
            on_change(self._elevation, lambda value: session.set_view(View(session.view.azimuth, float(value))))

    def _change(self, change: Callable[[], None]) -> None:
        self._playing = False
        change()

    def _set_joint(self, joint: int, scale: float, value: float) -> None:
        self._session.set_joint(joint, value / scale)

    def _say(self, text: str) -> None:
        if self._message.content != text:
            self._message.content = text

    def _welcome(self, client: Any) -> None:
        """Place a new visitor's camera so that the object, its open parts and the hand are in the picture."""
        session = self._session
        view = View(0.7 * session.view.azimuth - 15.0, 24.0)
        client.camera.up_direction = (0.0, 0.0, 1.0)
        client.camera.position = look_at(view, session.centre, 1.15 * session.size)[:3, 3]
        client.camera.look_at = session.centre

    # ------------------------------------------------------------------------------------------------- drawing

    def _draw(self) -> None:
        """Draw the session's present state."""
        moment = self._session.moment
        with self._server.atomic():
            if self._part != self._session.link:
                self._build()
            self._place(moment)
            self._arrows(moment)
            self._cloud(moment)
            self._aim(moment)
            self._write(moment)
        self._server.flush()

    def _mesh(self, name: str, meshes: Sequence[Mesh], color: Color, **style: Any) -> Any:
        """One node of all ``meshes``, or none in place of an empty one."""
        meshes = [mesh for mesh in meshes if len(mesh.faces)]
        if not meshes:
            self._server.scene.remove_by_name(name)
            return None
        vertices, faces = append_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
        return self._server.scene.add_mesh_simple(
            name, vertices.astype(np.float32), faces.astype(np.uint32), color=color, side="double", **style
        )

    def _build(self) -> None:
        """Draw the object's links; those of the part to open can be clicked."""
        session = self._session
        self._part = session.link
        carried = session.obj.descendants(session.link)
        self._bodies = []
        for i, (link, color) in enumerate(zip(session.obj.links, link_colors(session.obj, session.link), strict=True)):
            body = self._mesh(f"/object/{i}", link.visuals, color, flat_shading=True)
            if body is not None and i in carried:
                body.on_click(self._clicked)
            self._bodies.append(body)

    def _clicked(self, event: Any) -> None:
        self._request("pick", lambda: self._session.pick(*_ray(event.client.camera, event.screen_pos)))

    def _place(self, moment: Moment) -> None:
        """Put the bodies where they are; the gripper is there in a trial only."""
        links = len(self._session.obj.links)
        acting = len(moment.poses) > links
        if acting and len(self._bodies) == links:
            meshes = gripper_meshes()
            self._bodies += [self._mesh(f"/gripper/{i}", mesh, GRIPPER) for i, mesh in enumerate(meshes)]
        elif not acting and len(self._bodies) > links:
            for body in self._bodies[links:]:
                body.remove()
            del self._bodies[links:]
        held = moment.trial.attached if moment.trial is not None else None
        if acting and held != self._held:
            self._cup = self._mesh("/gripper/0/cup", [cup_mesh(gripper_meshes())], HOLDING if held else FREE)
        self._held = held
        for body, pose in zip([*self._bodies, self._camera], [*moment.poses, moment.camera], strict=True):
            if body is not None:
                body.position = pose[:3, 3]
                body.wxyz = matrix_to_quaternion(torch.as_tensor(pose[:3, :3])).numpy()

    def _cloud(self, moment: Moment) -> None:
        if not self._shown["cloud"].value or not len(moment.points):
            self._server.scene.remove_by_name("/cloud")
            return
        colors = np.where(moment.part[:, None], PART, SEEN)
        self._server.scene.add_point_cloud(
            "/cloud",
            moment.points,
            (255 * colors).astype(np.uint8),
            point_size=0.004 * self._session.size,
            point_shape="circle",
        )

    def _arrows(self, moment: Moment) -> None:
        """Draw the flows beside each other: the moving points have an arrow of one flow or the other in turn."""
        norms = np.max([np.linalg.norm(flow, axis=-1) for flow in moment.flows.values()], axis=0)
        moving = np.flatnonzero(norms > 0.1)[: len(moment.flows) * ARROWS]  # clouds are in random order
        for turn, (name, flow) in enumerate(moment.flows.items()):
            rows = moving[turn :: len(moment.flows)]
            rows = rows[np.linalg.norm(flow[rows], axis=-1) > 0.05] if self._shown[name].value else rows[:0]
            length = LENGTH * self._session.size
            starts, ways = moment.points[rows].astype(np.float64), length * flow[rows].astype(np.float64)
            meshes = arrow_mesh(starts, ways, 0.045 * length) if len(rows) else []
            self._mesh(f"/flow/{name}", meshes, COLORS[name])

    def _aim(self, moment: Moment) -> None:
        """The contact point as a ball, an arrow along the pull, and a thin one from the hand's standoff pose."""
        scene, contact, size = self._server.scene, moment.contact, self._session.size
        if contact is None:
            for name in ("point", "pull", "approach"):
                scene.remove_by_name(f"/contact/{name}")
            return
        scene.add_icosphere("/contact/point", radius=0.011 * size, color=CONTACT, position=contact.point)
        pull = _arrow(contact.point, 1.6 * LENGTH * size * contact.pull, 0.008 * size)
        self._mesh("/contact/pull", pull, CONTACT)
        way = 0.09 * size * contact.standoff
        self._mesh("/contact/approach", _arrow(contact.point + 1.25 * way, -way, 0.005 * size), GRIPPER)

    def _write(self, moment: Moment) -> None:
        """Write the numbers and messages, and set the controls to the present state."""
        if moment.metrics:
            self._measured.content = (
                f"Predicted: cosine **{moment.metrics['cosine']:.3f}** · RMSE **{moment.metrics['rmse']:.3f}**"
            )
        elif "predicted" in moment.flows:
            self._measured.content = "The camera sees nothing that moves."
        else:
            self._measured.content = "For ArtFlowNet's flow beside the true one give `checkpoint=pretrained`."
        self._status.content = status(moment, self._playing)
        session = self._session
        self._part_control.value = self._part_names[session.link]
        for (slider, scale), position in zip(self._joints, moment.qpos, strict=True):
            wanted = float(np.clip(round(scale * position, 1), slider.min, slider.max))
            if abs(slider.value - scale * position) > 0.1:
                slider.value = wanted
        for slider, angle in ((self._azimuth, session.view.azimuth), (self._elevation, session.view.elevation)):
            if slider.value != round(angle):
                slider.value = round(angle)


def _ray(camera: Any, place: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin (m) and direction [3] of the ray through a point in a visitor's picture: column and row from 0 to 1.

    viser's events have the ray as well, but it is wrong in some versions.
    """
    across, down = (2.0 * np.array(place) - 1.0) * math.tan(0.5 * camera.fov) * [camera.aspect, 1.0]
    rotation = quaternion_to_matrix(torch.as_tensor(np.asarray(camera.wxyz, dtype=np.float64))).numpy()
    return np.asarray(camera.position, dtype=np.float64), rotation @ [across, down, 1.0]


def _arrow(start: NDArray[np.float32], vector: NDArray[np.float32], radius: float) -> list[Mesh]:
    return arrow_mesh(start[None].astype(np.float64), vector[None].astype(np.float64), radius)
