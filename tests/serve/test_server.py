"""Over a real socket: openpi-client's conversation, strangers, broken messages, clients that vanish, and the time."""

from __future__ import annotations

import http.client
import re
import signal
import socket
import statistics
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.serve.episode import Episode, Served
from fb3d_rl.serve.protocol import packed, unpacked

from .client import WebsocketClientPolicy, msgpack, websockets
from .conftest import ROOT, Opened, offered

exceptions, connect = pytest.importorskip("websockets.exceptions"), websockets.connect
HERE = "127.0.0.1"


@pytest.fixture
def port(opened: Opened, served: Served) -> Any:
    with opened(served) as number:
        yield number


def test_the_published_client_gets_metadata_actions_and_plans(
    port: int, client: type[WebsocketClientPolicy], served: Served, acting: dict[str, Any]
) -> None:
    robot = client(HERE, port)
    about = robot.get_server_metadata()
    assert about["policy"] == "artflownet" and about["plans"] and "points" in about["reads"]
    answer = robot.infer({**acting, "plan": True, "attached": np.bool_(False), "force": np.float64(0.0)})
    expected = Episode(served).answer({**acting, "plan": True})
    np.testing.assert_array_equal(answer["actions"], expected["actions"])
    np.testing.assert_array_equal(answer["twist"], expected["twist"])
    assert answer["plan"] == expected["plan"] and answer["actions"].dtype == np.float32


def test_an_error_is_text_and_the_conversation_goes_on(
    port: int, client: type[WebsocketClientPolicy], acting: dict[str, Any]
) -> None:
    robot = client(HERE, port)
    first = robot.infer(acting)["actions"]
    for wrong in ({"points": np.zeros((4, 2))}, {"mask": np.zeros(2)}, {"tool_pose": [np.nan] * 7}):
        with pytest.raises(RuntimeError, match=r"server:\n[A-Zmt].* "):
            robot.infer({**acting, **wrong})
    np.testing.assert_array_equal(robot.infer({**acting, "reset": True})["actions"], first)


def test_two_clients_have_an_episode_each(
    port: int, client: type[WebsocketClientPolicy], served: Served, acting: dict[str, Any]
) -> None:
    ways = [[{**acting, "tool_pose": [-1.6 + s * 0.1 * k, 0.1, 0.8, 1, 0, 0, 0]} for k in range(5)] for s in (0, 1)]
    alone = [[episode.answer(request)["actions"] for request in way] for way in ways for episode in [Episode(served)]]
    robots = [client(HERE, port) for _ in ways]
    for step in range(5):
        for robot, way, expected in zip(robots, ways, alone, strict=True):
            np.testing.assert_array_equal(robot.infer(way[step])["actions"], expected[step])
    assert np.abs(np.subtract(*alone)).max() > 1e-3


def test_a_huge_message_ends_its_conversation_alone(
    port: int, client: type[WebsocketClientPolicy], acting: dict[str, Any]
) -> None:
    other, robot = client(HERE, port), client(HERE, port)
    with pytest.raises(exceptions.ConnectionClosed, match="1009|too big"):
        robot.infer({"points": np.zeros((50 * 2**20 // 12, 3), dtype=np.float32)})
    assert other.infer(acting)["actions"].shape == (1, 8)


def test_a_client_that_vanishes_leaves_the_others_alone(opened: Opened, served: Served, acting: dict[str, Any]) -> None:
    with opened(served, clients=2) as port:
        other = WebsocketClientPolicy(HERE, port)
        for _ in range(5):  # with two at most, the next could not come in if one of these stayed
            with socket.create_connection((HERE, port)) as raw:
                handshake = "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                raw.sendall(f"{handshake}Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
                while b"fb3d_rl" not in raw.recv(65536):
                    pass
                body = packed({**acting, "plan": True})
                frame = b"\x82\xff" + len(body).to_bytes(8, "big") + bytes(4) + body
                raw.sendall(frame if _ % 2 else frame[: len(frame) // 2])
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # closed by a reset
            assert other.infer(acting)["actions"].shape == (1, 8)
            time.sleep(0.2)
        assert WebsocketClientPolicy(HERE, port).infer(acting)["actions"].shape == (1, 8)


def test_a_token_is_asked_for(opened: Opened, served: Served, client: type[WebsocketClientPolicy]) -> None:
    with opened(served, token="open sesame") as port:
        for wrong in (None, "open", "open sesame!"):
            with pytest.raises(exceptions.InvalidStatus, match="401"):
                client(HERE, port, wrong)
        assert client(HERE, port, "open sesame").get_server_metadata()["server"] == "fb3d_rl"
        assert _get(port, "/healthz") == (200, b"OK\n")
        assert _get(port, "/")[0] == 401


def _get(port: int, path: str) -> tuple[int, bytes]:
    line = http.client.HTTPConnection(HERE, port, timeout=10)
    line.request("GET", path)
    answer = line.getresponse()
    return answer.status, answer.read()


def test_pages_and_too_many_clients_are_refused(opened: Opened, served: Served) -> None:
    with opened(served, clients=1) as port:
        with pytest.raises(exceptions.InvalidStatus, match="403"):
            connect(f"ws://{HERE}:{port}", origin="https://example.org")
        with connect(f"ws://{HERE}:{port}") as first:
            first.recv()
            with pytest.raises(exceptions.InvalidStatus, match="503"):
                connect(f"ws://{HERE}:{port}")
        until = time.monotonic() + 10
        while time.monotonic() < until:
            try:
                with connect(f"ws://{HERE}:{port}") as second:
                    assert unpacked(second.recv())["server"] == "fb3d_rl"
                    break
            except exceptions.InvalidStatus:
                time.sleep(0.05)
        else:
            pytest.fail("the place of a client that left stays taken")


def test_a_port_that_is_taken_is_one_sentence(opened: Opened, served: Served, port: int) -> None:
    with pytest.raises(UserError, match=rf"{HERE}:{port} .*port="), opened(served, port=port):
        pass


def test_broken_messages_are_answered_and_end_nothing(port: int, acting: dict[str, Any]) -> None:
    rng, good = np.random.default_rng(0), packed({**acting, "points": acting["points"][:60], "mask": None})
    array = {b"__ndarray__": True, b"data": b"12", b"dtype": "<f4", b"shape": [3, 3]}
    evil = [array, {**array, b"dtype": "O", b"shape": [0]}, {**array, b"shape": [-1]}, {**array, b"shape": [2**62, 4]}]
    evil += [{b"__ndarray__": True}, {b"__npgeneric__": True, b"dtype": "f4,f4", b"data": 1}, [[[1]]] * 3, None]
    messages: list[Any] = [msgpack.packb({"points": value}) for value in evil]
    messages += ["text", b"", b"\xc1", b"\x91" * 5000, msgpack.packb([1, 2]), msgpack.packb({b"points": 1})]
    for _ in range(200):
        mutant = bytearray(good[: rng.integers(len(good))] if rng.random() < 0.3 else good)
        for place in rng.integers(0, max(1, min(len(mutant), 400)), rng.integers(1, 6)):
            mutant[place : place + 1] = bytes([rng.integers(256)])
        messages.append(bytes(mutant))
    with connect(f"ws://{HERE}:{port}", compression=None) as line:
        line.recv()
        refused = 0
        for message in messages:
            line.send(message)
            answer = line.recv(timeout=30)
            refused += isinstance(answer, str)
            assert not isinstance(answer, str) or "policy failed" not in answer, answer
        assert refused > len(evil) + 5
        line.send(packed({**acting, "reset": True}))
        assert unpacked(line.recv())["actions"].shape == (1, 8)


def test_a_fault_of_the_policy_is_said_and_logged(
    opened: Opened, served: Served, acting: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    from dataclasses import replace

    from tensordict.nn import TensorDictModule

    def faulty() -> TensorDictModule:
        return TensorDictModule(lambda x: x.no_such_thing, in_keys=[("observation", "points")], out_keys=["action"])

    with opened(replace(served, policy=faulty, network=None)) as port, pytest.raises(RuntimeError, match="no_such"):
        WebsocketClientPolicy(HERE, port).infer(acting)
    assert "no_such_thing" in caplog.text


def test_the_example_of_the_page_is_short_and_runs(
    port: int, client: type[WebsocketClientPolicy], acting: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    [example] = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "serve.md").read_text(), re.DOTALL)
    assert len(example.splitlines()) <= 22
    place: dict[str, Any] = {"WebsocketClientPolicy": client}
    exec(re.sub(r"^from .*\n", "", example), place)  # noqa: S102, the page's own
    moves: list[np.ndarray] = []
    tip = np.array(acting["tool_pose"], dtype=np.float64)

    def move(linear: np.ndarray, angular: np.ndarray) -> None:
        moves.append(linear)
        tip[:3] += linear / 20

    look = (acting["points"], acting["mask"], acting["camera"])
    place["run"](lambda: look, lambda: (tip, False, 0.0), move, steps=3, port=port)
    assert len(moves) == 3 and np.linalg.norm(moves[0]) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_command_ends_cleanly(tmp_path: Any, acting: dict[str, Any], number: signal.Signals) -> None:
    command = [sys.executable, str(ROOT / "launch" / "serve.py"), "port=0", "token=secret"]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"policy=artflownet answers at ws://127\.0\.0\.1:(\d+)", line)
        assert found, line
        robot = WebsocketClientPolicy(HERE, int(found[1]), "secret")
        robot.infer(acting)
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    with pytest.raises(exceptions.ConnectionClosed, match="1001"):
        robot.infer(acting)
    assert (process.returncode, out, err) == (0, "the server has ended\n", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.alone
def test_twenty_times_a_second_for_a_minute(
    port: int, client: type[WebsocketClientPolicy], acting: dict[str, Any]
) -> None:
    robot, period, trips, behind = client(HERE, port), 0.05, [], []
    began = time.perf_counter()
    for step in range(1200):
        tool = [-1.6 + 0.001 * step, 0.1, 0.8, 1.0, 0.0, 0.0, 0.0]
        asked = time.perf_counter()
        robot.infer({**acting, "tool_pose": tool})
        trips.append(time.perf_counter() - asked)
        behind.append(time.perf_counter() - (began + (step + 1) * period))
        time.sleep(max(0.0, -behind[-1]))
    # Other work on the machine may hold up a few; a server that is too slow would fall behind more and more.
    assert statistics.median(trips) < period and max(behind) < 1.0


@pytest.mark.slow
@pytest.mark.alone
def test_a_round_trip_takes_little_longer_than_the_decision(
    opened: Opened, client: type[WebsocketClientPolicy], acting: dict[str, Any]
) -> None:
    served = offered(ArtFlowNet.from_pretrained(), 1200)
    policy, episode = served.policy(), Episode(served)
    frames: list[Any] = []
    episode._decided = lambda frame, scale: (frames.append(frame.clone()), policy(frame))[1]  # type: ignore[method-assign]
    request = {**acting, "points": acting["points"][:1200], "mask": acting["mask"][:1200], "reset": True}
    episode.answer(request)
    ratios = []
    with opened(served) as port, torch.no_grad():
        robot = client(HERE, port)
        while len(ratios) < 3 and min(ratios, default=9.0) > 1.3:  # other work on the machine may take its time
            trips, decisions = [], []
            for _ in range(50):
                began = time.perf_counter()
                robot.infer(request)
                trips.append(time.perf_counter() - began)
                frame = frames[0].clone()
                began = time.perf_counter()
                policy(frame)
                decisions.append(time.perf_counter() - began)
            ratios.append(statistics.median(trips) / statistics.median(decisions))
            print(f"round trip {1e3 * statistics.median(trips):.1f} ms, {ratios[-1]:.2f} times the decision")
    assert min(ratios) <= 1.3
