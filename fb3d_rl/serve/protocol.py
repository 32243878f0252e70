"""Messages as openpi-client writes and reads them: MessagePack maps, in which NumPy arrays are maps of their bytes."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.errors import UserError

NUMBERS = re.compile(r"[<>|=]?(b1|[iu][1248]|f(2|4|8|16))")
"""Types of arrays that are read: bool, whole numbers and floats; others may hold objects."""

DEPTH = 32
"""Dimensions of an array, at most."""


def require_messages() -> None:
    """Check that what the server needs is installed.

    Raises:
        UserError: it is not.
    """
    try:
        import msgpack  # noqa: F401
        import websockets.asyncio.server  # noqa: F401
    except ImportError as error:
        raise UserError(
            f'the policy server needs msgpack and websockets ({error}); install them: pip install "fb3d_rl[serve]"'
        ) from error


def packed(content: dict[str, Any]) -> bytes:
    """A message of strings, numbers, lists, maps and arrays."""
    import msgpack

    message: bytes = msgpack.packb(content, default=_as_map)
    return message


def unpacked(message: bytes | str) -> dict[str, Any]:
    """The map in a message; no code in it is run.

    Raises:
        UserError: it is no such message.
    """
    import msgpack

    if isinstance(message, str):
        raise UserError("A request is text: send a binary MessagePack map, as openpi-client does.")
    try:
        content = msgpack.unpackb(message, object_hook=_as_array)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise UserError(f"A request is no MessagePack map as openpi-client writes it ({error}).") from error
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise UserError("A request is no map with names as keys: send a dict such as {'points': ...}.")
    return content


def _as_map(value: Any) -> dict[bytes, Any]:
    """An array, or a number of NumPy's, as openpi-client writes it."""
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _as_array(value: dict[Any, Any]) -> Any:
    """What :func:`_as_map` wrote; other maps as they are."""
    if b"__ndarray__" in value:
        shape, data = value[b"shape"], value[b"data"]
        kind = _type(value[b"dtype"])
        whole = all(isinstance(size, int) and size >= 0 for size in shape) and len(shape) <= DEPTH
        if not whole or not isinstance(data, bytes) or math.prod(shape) * kind.itemsize != len(data):
            raise ValueError("an array's bytes are not those of its shape")
        array: NDArray[Any] = np.frombuffer(bytearray(data), kind).reshape(shape)  # which can be written to
        return array
    if b"__npgeneric__" in value:
        return _type(value[b"dtype"]).type(value[b"data"])
    return value


def _type(word: Any) -> np.dtype[Any]:
    if not isinstance(word, str) or NUMBERS.fullmatch(word) is None:
        raise ValueError(f"arrays of {word!r} are not read")
    return np.dtype(word)
