"""A server in a thread, and what a client could send."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.flow_policy import artflownet_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.scene.posed import Posed
from fb3d_rl.serve.episode import Served
from fb3d_rl.serve.server import Door, listening

Opened: TypeAlias = "Callable[..., AbstractContextManager[int]]"
LIMITS, OPTIONS = VelocityLimits(2.0, 3.0), FlowPolicyOptions()
ROOT = Path(__file__).resolve().parents[2]
POINTS = 300
TOOL = [-1.6, 0.1, 0.8, 1.0, 0.0, 0.0, 0.0]


def offered(net: ArtFlowNet, points: int = POINTS) -> Served:
    return Served("artflownet", "", lambda: artflownet_policy(net, LIMITS, OPTIONS), net, LIMITS, OPTIONS, points)


@pytest.fixture(scope="session")
def quick() -> ArtFlowNet:
    """A network of few milliseconds, which has learned nothing."""
    return ArtFlowNet(True, 8, "delayed", torch.Generator().manual_seed(0)).eval()


@pytest.fixture(scope="session")
def served(quick: ArtFlowNet) -> Served:
    return offered(quick)


@pytest.fixture(scope="session")
def opened() -> Opened:
    """A context with a server on a free port of this machine, in a thread."""

    @contextmanager
    def running(served: Served, **door: Any) -> Iterator[int]:
        port: Future[int] = Future()
        end: Future[Callable[[], object]] = Future()

        async def work() -> None:
            stop, loop = asyncio.Event(), asyncio.get_running_loop()
            end.set_result(lambda: loop.call_soon_threadsafe(stop.set))
            try:
                async with listening(served, Door(**{"port": 0, **door})) as number:
                    port.set_result(number)
                    await stop.wait()
            except UserError as error:
                port.set_exception(error)

        thread = threading.Thread(target=lambda: asyncio.run(work()))
        thread.start()
        try:
            yield port.result(30)
        finally:
            with suppress(RuntimeError):  # it ended by itself
                end.result()()
            thread.join(30)
            assert not thread.is_alive(), "the server does not end"

    return running


@pytest.fixture(params=["published", "tiny"])
def client(request: pytest.FixtureRequest) -> Any:
    """openpi-client's class, and ours of the same protocol."""
    from .client import WebsocketClientPolicy

    if request.param == "tiny":
        return WebsocketClientPolicy
    module = pytest.importorskip("openpi_client.websocket_client_policy", reason="openpi-client is not installed")
    return module.WebsocketClientPolicy


@pytest.fixture(scope="session")
def seen(procedural_objects: dict[str, ArticulatedObject]) -> dict[str, Any]:
    """A request that sees a microwave, of about 2900 points."""
    posed, view = Posed(procedural_objects["Microwave"]), View(20.0, 30.0)
    link = posed.openable[0]
    points, links = posed.camera.capture(posed.poses(posed.closed), view, further=False)
    order = np.random.default_rng(0).permutation(len(points))
    part = np.isin(links, list(posed.obj.descendants(link)))
    return {
        "points": points[order].astype(np.float32),
        "mask": part[order],
        "camera": posed.camera.pose(view)[:3, 3],
    }


@pytest.fixture(scope="session")
def acting(seen: dict[str, Any]) -> dict[str, Any]:
    """A request for an action in the world frame."""
    return {**seen, "tool_pose": np.array(TOOL), "T_world_cloud": np.eye(4)}
