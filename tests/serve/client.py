"""openpi-client's side of the conversation in a few lines, for where it is not installed (it wants NumPy 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

msgpack = pytest.importorskip("msgpack", reason="msgpack is not installed; install it to run this test")
websockets = pytest.importorskip(
    "websockets.sync.client", reason="websockets is not installed; install it to run this test"
)


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return value


def _unpack(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.ndarray(buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"])
    return value


class WebsocketClientPolicy:
    """As openpi_client.websocket_client_policy.WebsocketClientPolicy 0.1.2."""

    def __init__(self, host: str = "0.0.0.0", port: int | None = None, api_key: str | None = None) -> None:
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        opening = websockets.connect(f"ws://{host}:{port}", compression=None, max_size=None, additional_headers=headers)
        self._ws = opening.__enter__()
        self._metadata = msgpack.unpackb(self._ws.recv(), object_hook=_unpack)

    def get_server_metadata(self) -> dict[str, Any]:
        metadata: dict[str, Any] = self._metadata
        return metadata

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        self._ws.send(msgpack.packb(obs, default=_pack))
        response = self._ws.recv()
        if isinstance(response, str):
            raise RuntimeError(f"Error in inference server:\n{response}")
        answer: dict[str, Any] = msgpack.unpackb(response, object_hook=_unpack)
        return answer
