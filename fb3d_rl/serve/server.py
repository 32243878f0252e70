"""The socket: several clients, each with an episode of its own, one decision after the other."""

from __future__ import annotations

import asyncio
import hmac
import http
import logging
import signal
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any

from fb3d_rl.errors import UserError
from fb3d_rl.serve.episode import Episode, Served
from fb3d_rl.serve.protocol import packed, require_messages, unpacked

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Door:
    """Who may come in.

    Attributes:
        host: address that is listened on; only this machine reaches 127.0.0.1.
        port: 0 for any free one.
        token: what a client has to know; None: nothing.
        megabytes: the largest message, MiB.
        clients: at most so many at once.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = None
    megabytes: float = 16.0
    clients: int = 8


def serve(served: Served, door: Door) -> None:
    """Answer clients until Ctrl-C or SIGTERM; then say goodbye to those that are there.

    Raises:
        UserError: the address cannot be listened on, or msgpack or websockets is missing.
    """
    asyncio.run(_until_signal(served, door))


async def _until_signal(served: Served, door: Door) -> None:
    end, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end.set)
    async with listening(served, door) as port:
        print(f"policy={served.name} answers at ws://{door.host}:{port}; Ctrl-C ends it", flush=True)
        await end.wait()
    print("the server has ended", flush=True)


@asynccontextmanager
async def listening(served: Served, door: Door) -> AsyncIterator[int]:
    """A context in which clients are answered; gives the port.

    Raises:
        UserError: as of :func:`serve`.
    """
    require_messages()
    from websockets.asyncio.server import serve as open_server

    with ThreadPoolExecutor(1, thread_name_prefix="policy") as brain:  # networks use all cores by themselves
        room = _Room(served, door, brain)
        quiet = logging.getLogger(f"{__name__}.handshakes")
        quiet.setLevel(logging.CRITICAL)  # it has a traceback for each stranger
        try:
            server = await open_server(
                room.converse,
                door.host,
                door.port,
                process_request=room.admit,
                origins=[None],  # a page in a browser may not talk to it
                compression=None,  # a message is as large as it is said to be
                max_size=int(door.megabytes * 2**20),
                max_queue=1,
                logger=quiet,
            )
        except OSError as error:
            why = error.strerror or error
            raise UserError(
                f"{door.host}:{door.port} cannot be listened on ({why}); give another host= or port="
            ) from error
        async with server:
            yield server.sockets[0].getsockname()[1]


class _Room:
    """The clients that are there."""

    def __init__(self, served: Served, door: Door, brain: ThreadPoolExecutor) -> None:
        self._served, self._door, self._brain = served, door, brain
        self._here = 0
        self._welcome = packed(served.metadata() | {"max_message_bytes": int(door.megabytes * 2**20)})

    def admit(self, connection: Any, request: Any) -> Any:
        """An HTTP answer in place of a conversation, or None for a client that may come in."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        if self._door.token is not None:
            given = " ".join(request.headers.get_all("Authorization"))
            if not hmac.compare_digest(given.encode(), f"Api-Key {self._door.token}".encode()):
                return connection.respond(
                    http.HTTPStatus.UNAUTHORIZED, "This server wants a token: give it as api_key.\n"
                )
        if self._here >= self._door.clients:
            return connection.respond(
                http.HTTPStatus.SERVICE_UNAVAILABLE, f"{self._here} clients are here, no more are let in.\n"
            )
        return None

    async def converse(self, connection: Any) -> None:
        """Answer one client until it leaves."""
        from websockets.exceptions import ConnectionClosed

        loop = asyncio.get_running_loop()
        self._here += 1
        try:
            with suppress(ConnectionClosed):
                episode = await loop.run_in_executor(self._brain, Episode, self._served)
                await connection.send(self._welcome)
                async for message in connection:
                    await connection.send(await loop.run_in_executor(self._brain, _answer, episode, message))
        finally:
            self._here -= 1


def _answer(episode: Episode, message: bytes | str) -> bytes | str:
    """The answer to a message; an error is text, as openpi-client expects, and the conversation goes on."""
    try:
        return packed(episode.answer(unpacked(message)))
    except UserError as error:
        return str(error)
    except Exception as error:  # noqa: BLE001, a fault of one request must not end the server
        log.exception("a request failed")
        return f"The policy failed with {type(error).__name__}: {error}"
