"""An object in a person's hands: what the session makes of it, and the page that serves it to this machine alone."""

from __future__ import annotations

import http.client
import math
import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View, look_at
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.geometry.transforms import matrix_to_quaternion, quaternion_to_matrix
from fb3d_rl.live import page as pages
from fb3d_rl.live.page import Page, serve
from fb3d_rl.live.server import HOST, start_server
from fb3d_rl.live.session import Session
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.rollout.trials import schedule

CAMERA = CameraOptions(resolution=64)
SAMPLES = SampleOptions(points=300, camera=CAMERA)
OPTIONS = EnvOptions(points=300, camera=CAMERA)


def session_of(obj: ArticulatedObject, **more: Any) -> Session:
    return Session(obj, SAMPLES, OPTIONS, FlowPolicyOptions(), **more)


@pytest.fixture(scope="module")
def net() -> ArtFlowNet:
    return ArtFlowNet.from_pretrained()


@pytest.fixture
def oven(procedural_objects: dict[str, ArticulatedObject]) -> Iterator[Session]:
    session = session_of(procedural_objects["Microwave"])
    yield session
    session.close()


def towards(session: Session, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A ray to a point from beside the camera."""
    origin = session.moment.camera[:3, 3] + [0.0, 0.1, 0.2]
    return origin, point - origin


def another_point(session: Session) -> np.ndarray:
    """A point of the part that moves well, far from the one that the policy would choose."""
    moment = session.moment
    assert moment.contact is not None
    moves = moment.part & (np.linalg.norm(moment.flows["true"], axis=-1) > 0.6)
    points = moment.points[moves]
    return points[np.linalg.norm(points - moment.contact.point, axis=-1).argmax()]


# ------------------------------------------------------------------------------------------------------- the session


def test_it_begins_where_an_evaluation_does(procedural_objects: dict[str, ArticulatedObject]) -> None:
    obj = procedural_objects["StorageFurniture"]
    scheduled = {item.trial.link: item.trial for item in schedule([(obj, "")], SAMPLES, seed=5)[0]}
    session = session_of(obj, seed=5)
    for link in scheduled:
        session.set_part(link)
        assert (session.link, session.view) == (link, scheduled[link].view)
        assert session.moment.qpos.tolist() == list(scheduled[link].start)
    assert len(scheduled) > 1 and session.moment.trial is None


def test_a_slider_moves_the_cloud_the_flow_and_the_prediction(
    procedural_objects: dict[str, ArticulatedObject], net: ArtFlowNet
) -> None:
    session = session_of(procedural_objects["Microwave"], net=net)
    before = session.moment
    low, high = session.limits[0]
    session.set_joint(0, 0.5 * (low + high))
    after = session.moment
    assert after.qpos[0] == pytest.approx(0.5 * (low + high))
    link = session.link
    assert not np.allclose(before.poses[link], after.poses[link]) and np.array_equal(before.poses[0], after.poses[0])
    for name in ("true", "predicted"):
        way = [m.flows[name][m.part].mean(0) / np.linalg.norm(m.flows[name][m.part].mean(0)) for m in (before, after)]
        assert way[0] @ way[1] < 0.95, "the flow turns with the door"
    target, predicted = (torch.from_numpy(after.flows[name])[None] for name in ("true", "predicted"))
    expected = flow_metrics(predicted, target, torch.ones(target.shape[:2], dtype=torch.bool))
    assert after.metrics == {key: pytest.approx(float(value), abs=1e-5) for key, value in expected.items()}
    assert after.metrics["cosine"] > 0.5
    session.set_joint(0, high + 1.0)
    assert session.moment.qpos[0] == high, "a joint stays within its limits"


def test_another_view_sees_other_points(oven: Session) -> None:
    before = oven.moment
    oven.set_view(View(60.0, 20.0))
    after = oven.moment
    assert not np.array_equal(before.points, after.points) and np.array_equal(before.qpos, after.qpos)
    expected = look_at(View(60.0, 20.0), oven.centre, np.linalg.norm(before.camera[:3, 3] - oven.centre))
    np.testing.assert_allclose(after.camera, expected, atol=1e-9)
    oven.set_view(View(180.0, 0.0))
    assert not oven.moment.part.any() and oven.moment.contact is None, "the door is in front"
    with pytest.raises(UserError, match="sees nothing"):
        oven.pick(*towards(oven, oven.centre))


def test_the_expert_opens_what_is_shown_and_reset_puts_it_back(oven: Session) -> None:
    shown = oven.moment
    assert shown.contact is not None and len(shown.poses) == len(oven.obj.links)
    oven.step()
    assert oven.moment.contact is not None
    np.testing.assert_allclose(oven.moment.contact.point, shown.contact.point, atol=1e-4)
    assert len(oven.moment.poses) == len(oven.obj.links) + 3
    phases = []
    while oven.trial is not None and not oven.trial.done:
        oven.step()
        phases.append(oven.trial.phase)
    assert oven.trial is not None and oven.trial.success and oven.trial.attached and oven.trial.distance < 0.1
    assert {"travel", "approach", "pull"} <= set(phases)
    end = oven.moment
    assert abs(end.qpos[0] - shown.qpos[0]) > 0.5
    oven.step()
    assert oven.moment is end, "a trial that is over stays as it is"
    with pytest.raises(UserError, match="reset"):
        oven.pick(*towards(oven, oven.centre))
    oven.set_view(View(10.0, 30.0))
    assert oven.trial is None and np.array_equal(oven.moment.qpos, end.qpos), "it is seen where it stands"
    oven.set_part(oven.link)
    assert np.array_equal(oven.moment.points, shown.points)
    oven.step()
    oven.reset()
    assert oven.trial is None and np.array_equal(oven.moment.points, shown.points)


def test_a_picked_point_is_the_policys(oven: Session) -> None:
    wanted = another_point(oven)
    chosen = oven.moment.contact
    oven.pick(*towards(oven, wanted))
    picked = oven.moment.contact
    assert picked is not None and chosen is not None
    assert np.linalg.norm(picked.point - wanted) < 0.03 < np.linalg.norm(chosen.point - wanted)
    assert any(np.array_equal(picked.point, point) for point in oven.moment.points[oven.moment.part])
    assert np.linalg.norm(picked.pull) == pytest.approx(1.0, abs=1e-4)
    assert np.linalg.norm(picked.standoff) == pytest.approx(1.0, abs=1e-4)
    tips = []
    oven.step()
    while oven.trial is not None and not oven.trial.done:
        if oven.trial.phase in ("travel", "approach"):
            assert oven.moment.contact is not None
            np.testing.assert_array_equal(oven.moment.contact.point, picked.point)
        elif oven.trial.phase == "pull":
            tips.append(oven.moment.contact.point)  # type: ignore[union-attr]
        oven.step()
    assert np.linalg.norm(tips[0] - picked.point) < 0.06, "it holds the part where it was told to"
    assert oven.trial is not None and oven.trial.success


def test_a_point_can_be_picked_on_the_way(oven: Session) -> None:
    for _ in range(3):
        oven.step()
    assert oven.trial is not None and oven.trial.phase == "travel"
    wanted = another_point(oven)
    oven.pick(*towards(oven, wanted))
    oven.step()
    assert oven.moment.contact is not None and np.linalg.norm(oven.moment.contact.point - wanted) < 0.03


def test_a_ray_means_the_foremost_point(procedural_objects: dict[str, ArticulatedObject]) -> None:
    session = session_of(procedural_objects["StorageFurniture"])
    # The camera's own rays: each meets its point first.
    camera = session.moment.camera[:3, 3]
    moment = session.moment
    for point in moment.points[moment.part & (np.linalg.norm(moment.flows["true"], axis=-1) > 0.2)][:5]:
        session.pick(camera, point - camera)
        assert session.moment.contact is not None
        assert np.linalg.norm(session.moment.contact.point - point) < 0.04


def test_where_nothing_moves_nothing_is_picked(oven: Session) -> None:
    moment = oven.moment
    norm = np.linalg.norm(moment.flows["true"], axis=-1)
    hinge = moment.points[moment.part][norm[moment.part].argmin()]
    assert norm[moment.part].min() < 0.04, "the camera sees the hinge"
    chosen = moment.contact
    with pytest.raises(UserError, match="too little"):
        oven.pick(*towards(oven, hinge))
    assert oven.moment.contact is chosen


def test_what_cannot_be_shown_is_said(procedural_objects: dict[str, ArticulatedObject], oven: Session) -> None:
    with pytest.raises(UserError, match="checkpoint=PATH"):
        session_of(procedural_objects["Microwave"], flow="predicted")
    oven.set_joint(0, oven.limits[0, 1] if oven.moment.qpos[0] == oven.limits[0, 0] else oven.limits[0, 0])
    with pytest.raises(UserError, match="fully open"):
        oven.step()
    assert oven.trial is None


def test_without_a_simulator_all_but_acting_works(oven: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "fb3d_rl.env.task", None)
    oven.set_view(View(20.0, 30.0))
    oven.pick(*towards(oven, another_point(oven)))
    with pytest.raises(UserError, match="simulator cannot be loaded.*mani-skill.*without running trials"):
        oven.step()
    assert oven.trial is None and oven.moment.contact is not None


# ---------------------------------------------------------------------------------------------------------- the page


@dataclass
class Guest:
    """A guest's camera, as viser tells of it."""

    position: np.ndarray
    wxyz: np.ndarray
    fov: float
    aspect: float


def test_a_click_is_the_ray_through_what_was_clicked() -> None:
    pose = look_at(View(-40.0, 25.0), np.array([0.1, 0.2, 0.7]), 2.5)
    guest = Guest(pose[:3, 3], matrix_to_quaternion(torch.as_tensor(pose[:3, :3])).numpy(), math.radians(50), 1.6)
    x, y, z = np.linalg.inv(pose)[:3] @ [0.4, -0.3, 0.9, 1.0]
    half = math.tan(math.radians(25))
    origin, direction = pages._ray(guest, (0.5 + 0.5 * x / z / half / 1.6, 0.5 + 0.5 * y / z / half))
    np.testing.assert_allclose(origin + z * direction, [0.4, -0.3, 0.9], atol=1e-9)


def test_viser_is_asked_for(monkeypatch: pytest.MonkeyPatch, oven: Session) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(UserError, match=r'pip install "fb3d_rl\[view\]"'):
        serve(oven, 8080)


@pytest.fixture
def server() -> Iterator[Any]:
    pytest.importorskip("viser", reason="viser is not installed; install it to run this test")
    made = start_server(free_port(), "test")
    yield made
    made.stop()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def test_controls_do_what_they_say(server: Any, procedural_objects: dict[str, ArticulatedObject]) -> None:
    session = session_of(procedural_objects["StorageFurniture"])
    page = Page(server, session)
    other = next(link for link in session.parts if link != session.link)
    page._request("part", lambda: session.set_part(other))
    for opened in (0.1, 0.2, 0.3):
        page._request("joint", lambda opened=opened: page._set_joint(1, 100.0, 100.0 * opened))
    assert session.link != other, "nothing happens in the thread that wishes"
    page.attend()
    assert session.link == other and page._part_control.value == page._part_names[other]
    low, high = session.limits[1]
    assert session.moment.qpos[1] == pytest.approx(np.clip(0.3, low, high))
    slider, scale = page._joints[1]
    assert slider.value == pytest.approx(scale * session.moment.qpos[1], abs=0.1)

    page._request("a", lambda: page._act("Play"))
    page.attend()
    page.attend()
    assert session.trial is not None and session.trial.steps == 2 and "phase" not in page._status.content
    page._request("b", lambda: page._act("Pause"))
    page.attend()
    page.attend(0.01)
    assert session.trial.steps == 2 and "paused in phase **travel**" in page._status.content
    page._request("c", lambda: page._act("Step"))
    page.attend()
    assert session.trial.steps == 3
    page._request("d", lambda: page._act("Reset"))
    page.attend()
    assert session.trial is None and "Click the blue part" in page._status.content
    page._request("e", lambda: session.set_flow("predicted"))
    page.attend()
    assert "checkpoint=PATH" in page._message.content, "what cannot be done is said on the page"
    session.close()


def listening(port: int) -> list[str]:
    """Addresses (hexadecimal) on which a port is listened to."""
    lines = [
        line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return [words[1].split(":")[0] for words in lines if words[3] == "0A" and int(words[1].split(":")[1], 16) == port]


@pytest.fixture
def served(oven: Session, capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[[int], str]]:
    """Serves the page in a thread; gives what is printed."""
    pytest.importorskip("viser", reason="viser is not installed; install it to run this test")
    over = threading.Event()
    threads = []

    def start(port: int) -> str:
        thread = threading.Thread(target=serve, args=(oven, port, over.is_set))
        thread.start()
        threads.append(thread)
        printed = ""
        for _ in range(100):
            printed += capsys.readouterr().out
            if "Ctrl-C" in printed:
                break
            thread.join(0.1)
        return printed

    yield start
    over.set()
    for thread in threads:
        thread.join()


@pytest.mark.skipif(not Path("/proc/net/tcp").is_file(), reason="looks for sockets in /proc")
def test_it_listens_on_this_machine_alone_and_on_the_port_that_it_names(served: Callable[[int], str]) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        printed = served(port)
    assert f"port {port} is taken" in printed
    named = int(printed.split(f"http://{HOST}:")[1].split()[0])
    assert named != port and listening(named) == ["0100007F"]


def answer(server: Any, path: str) -> tuple[int, str]:
    """Status and text of what the server has at ``path``, which is asked for as it stands, dots and all."""
    connection = http.client.HTTPConnection(HOST, server.get_port(), timeout=10)
    connection.request("GET", path)
    response = connection.getresponse()
    found = response.status, response.read().decode(errors="replace")
    connection.close()
    return found


def test_the_page_loads_nothing_from_elsewhere(server: Any) -> None:
    for path in ("/", "/index.html", "/./index.html"):
        status, page = answer(server, path)
        assert status == 200 and "<script" in page
        assert not re.search(r'\b(src|href)="(https?:)?//', page)


def test_no_file_but_the_pages_own_is_given_away(server: Any, tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("mine")
    for path in ("/" + "../" * 20 + str(tmp_path / "secret.txt")[1:], "/../index.html", "/assets/../../index.html"):
        assert answer(server, path)[0] == 404, path
    assert answer(server, "/nothing.js")[0] == 404


@pytest.mark.slow
@pytest.mark.alone
def test_in_a_browser_a_click_picks_a_point_and_play_opens_the_part(server: Any, oven: Session) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not shutil.which("chromium"):
        pytest.skip("there is no chromium on this machine")
    page = Page(server, oven)

    def attend(until: Callable[[], bool]) -> None:
        for _ in range(200):
            browser_page.wait_for_timeout(20)  # the browser's turn
            page.attend(0.1)
            if until():
                return
        pytest.fail(browser_page.inner_text("body"))

    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        browser_page = browser.new_page(viewport={"width": 1280, "height": 800})
        browser_page.goto(f"http://{HOST}:{server.get_port()}")
        browser_page.get_by_text("Click the blue part").wait_for()
        browser_page.locator("canvas").first.wait_for()
        browser_page.wait_for_timeout(3000)  # until the scene is drawn from where the guest is put

        wanted, before = another_point(oven), oven.moment.contact
        guest = next(iter(server.get_clients().values())).camera
        pose = np.eye(4)
        pose[:3, :3] = quaternion_to_matrix(torch.as_tensor(guest.wxyz)).numpy()
        pose[:3, 3] = guest.position
        x, y, z = np.linalg.inv(pose)[:3] @ [*wanted, 1.0]
        box = browser_page.locator("canvas").first.bounding_box()
        half = math.tan(0.5 * guest.fov) * z
        place = 0.5 + 0.5 * np.array([x / half / guest.aspect, y / half])
        at = np.array([box["x"], box["y"]]) + place * box["height"] * [guest.aspect, 1.0]  # beside the panel
        browser_page.mouse.move(*at)
        browser_page.wait_for_timeout(500)
        browser_page.mouse.click(*at, delay=60)
        attend(lambda: oven.moment.contact is not before)
        assert oven.moment.contact is not None and np.linalg.norm(oven.moment.contact.point - wanted) < 0.05

        browser_page.get_by_text("Play", exact=True).click()
        attend(lambda: oven.trial is not None and oven.trial.done)
        browser_page.get_by_text("opened", exact=True).wait_for()
        browser_page.get_by_text("Reset", exact=True).click()
        attend(lambda: oven.trial is None)
        browser.close()
