"""The server: openpi's protocol on a websocket, a health and a status page, limits, and a clean end."""

from __future__ import annotations

import asyncio
import json
import logging
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import numpy as np

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.contract import Contract
from torchrl_sparse.envs.extras import import_extra
from torchrl_sparse.errors import InputError
from torchrl_sparse.serving.batcher import Batcher
from torchrl_sparse.serving.latencies import Latencies
from torchrl_sparse.serving.messages import pack, unpack
from torchrl_sparse.serving.metadata import describe_service
from torchrl_sparse.serving.requests import RequestReader
from torchrl_sparse.serving.robot import Answers, Robot, RobotSetup, Row, first_request

__all__ = ["PolicyServer"]

logger = logging.getLogger(__name__)


class PolicyServer:
    """Serve a policy to robots in other processes, by the websocket protocol of openpi.

    A connection is a robot: the first message is the server's metadata, each further one answers a request. An episode begins
    with the connection, and with a request that says ``"episode/reset"``; openpi's own ``reset()`` is not sent. Requests that
    arrive during a policy call share the next one; the bits of an answer are the same in every company. A step whose action
    is in the robot's chunk already is answered at once. Whoever sends what cannot be read is told why in text, which openpi's
    client raises, and dropped.

    Args:
        executor: of a `DiffusionPolicy`, as `torchrl_sparse.methods.executor.make_executor` makes it.
        contract: of the policy, see `torchrl_sparse.envs.contract.policy_contract`; None where its task is not known.
        answers: ``"action"``, a request is a control step and is answered with its action, f32 [1, A]; or ``"chunk"``, a
            request is a policy call on a history, [To, ...], and is answered with the chunk, f32 [n, A].
        seed: of the noise of each robot's first episode; its next has the next, unless it says ``"episode/seed"``.
        max_clients: at a time; others are refused with status 503.
        max_message_bytes: of a request; longer ones end the connection with code 1009.
        threads: of a policy call; None for as many as PyTorch has.
        facts: further metadata, such as the method's name.
        log: takes a line on each client that is dropped and, now and then, on what was served.

    Raises:
        InputError: as of `RobotSetup`.
        ImportError: without the extra ``serve``.
    """

    def __init__(
        self,
        executor: ChunkExecutor,
        contract: Contract | None = None,
        *,
        answers: Answers = "action",
        seed: int = 0,
        max_clients: int = 64,
        max_message_bytes: int = 2**22,
        threads: int | None = None,
        facts: Mapping[str, Any] | None = None,
        log: Callable[[str], None] = logger.warning,
    ):
        self._websockets = import_extra("websockets.asyncio.server", "serve")
        self._closed = import_extra("websockets.exceptions", "serve").ConnectionClosed
        self._setup = RobotSetup(executor, answers, seed)
        self._read = RequestReader(contract)
        self._most, self._size, self._threads = max_clients, max_message_bytes, threads
        self._log = log
        self.metadata = describe_service(self._setup, contract, facts or {})
        self._greeting = pack(self.metadata)
        self._clients: set[Any] = set()
        self._latencies, self._calls = Latencies(), Latencies()
        self._counts = dict.fromkeys(("clients_served", "refused", "requests", "policy_calls", "batches"), 0)
        self._begun = time.monotonic()

    def status(self) -> dict[str, Any]:
        """Return what ``/status`` shows: clients, counts, and percentiles of requests and of policy calls, in ms."""
        return {
            "clients": len(self._clients),
            **self._counts,
            "uptime_s": round(time.monotonic() - self._begun, 1),
            "request": self._latencies.percentiles_ms(),
            "policy_call": self._calls.percentiles_ms(),
        }

    def run(self, host: str = "127.0.0.1", port: int = 8000, **options: Any) -> None:
        """Serve until SIGINT or SIGTERM; arguments are those of `serve`."""

        async def until_signal() -> None:
            stop, loop = asyncio.Event(), asyncio.get_running_loop()

            def note(number: signal.Signals) -> None:
                stop.set()
                loop.remove_signal_handler(number)  # a second one ends the program as usual

            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, note, number)
            await self.serve(host, port, stop, **options)

        asyncio.run(until_signal())

    async def serve(
        self,
        host: str,
        port: int,
        stop: asyncio.Event,
        *,
        ready: Callable[[int], None] = lambda port: None,
        report_every: float = 60.0,
    ) -> None:
        """Serve until ``stop`` is set; the call under way is finished, and every client told that the server goes away.

        Args:
            host: address to bind; robots elsewhere need one that they reach.
            port: 0 for any that is free.
            ready: called with the port once clients may connect.
            report_every: seconds from one line on clients and percentiles to the next.

        Raises:
            OSError: if the address cannot be bound.
        """
        self._batcher = Batcher(self._call, self._threads)
        options: dict[str, Any] = {"compression": None, "max_size": self._size, "max_queue": 2}
        options |= {"close_timeout": 2, "origins": [None]}  # robots send none, pages in a browser do
        try:
            if (row := first_request(self._setup)) is not None:  # builds what the engine runs
                await self._batcher.ask(row)
            async with self._websockets.serve(
                self._talk, host, port, process_request=self._page, logger=_QUIET, **options
            ) as server:
                ready(server.sockets[0].getsockname()[1])
                while not stop.is_set():
                    with suppress(asyncio.TimeoutError):
                        await asyncio.wait_for(stop.wait(), report_every)
                    self._report()
        finally:
            await self._batcher.close()

    def _report(self) -> None:
        """Log a line on what has been served, where anything has."""
        if self._counts["requests"]:
            self._log(json.dumps(self.status()))

    def _page(self, connection: Any, request: Any) -> Any:
        """Answer plain HTTP requests, and refuse robots that are too many."""
        path = request.path.partition("?")[0]
        if path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if path == "/status":
            return connection.respond(HTTPStatus.OK, json.dumps(self.status()) + "\n")
        if len(self._clients) >= self._most:
            self._counts["refused"] += 1
            return connection.respond(
                HTTPStatus.SERVICE_UNAVAILABLE, f"max_clients: expected at most {self._most}, got another\n"
            )
        return None

    async def _talk(self, connection: Any) -> None:
        if len(self._clients) >= self._most:  # those that shook hands at the same time
            self._counts["refused"] += 1
            await connection.close(1013, f"max_clients: expected at most {self._most}, got another")
            return
        self._clients.add(connection)
        self._counts["clients_served"] += 1
        try:
            with suppress(self._closed):
                await self._answer_all(connection)
        finally:
            self._clients.discard(connection)

    async def _answer_all(self, connection: Any) -> None:
        robot, last = Robot(self._setup), None
        await connection.send(self._greeting)
        async for message in connection:
            begin = time.perf_counter()
            try:
                actions, timing = await self._answer(robot, message)
            except InputError as error:
                self._counts["refused"] += 1
                await self._drop(connection, 1007, str(error))
                return
            except Exception as error:  # of the policy, whose robots all others still are
                self._log(traceback.format_exc())
                await self._drop(connection, 1011, f"policy: {type(error).__name__}: {error}")
                return
            took = time.perf_counter() - begin
            self._latencies.add(took)
            self._counts["requests"] += 1
            timing |= {"infer_ms": _ms(took), **({} if last is None else {"prev_total_ms": last})}
            timing |= self._latencies.percentiles_ms()
            await connection.send(pack({"actions": actions, "server_timing": timing}))
            last = _ms(time.perf_counter() - begin)

    async def _answer(self, robot: Robot, message: bytes | str) -> tuple[np.ndarray, dict[str, float]]:
        """Return a request's actions and what of its time was the policy call's."""
        taken = robot.take(self._read(unpack(message)))
        if isinstance(taken, np.ndarray):
            return taken, {"policy_ms": 0.0}
        left, seconds = await self._batcher.ask(taken)
        self._calls.add(seconds)
        self._counts["policy_calls"] += 1
        return robot.keep(left), {"policy_ms": _ms(seconds)}

    def _call(self, rows: list[Row]) -> list[tuple[Row, float]]:
        """Ask the policy in the batcher's thread."""
        begin = time.perf_counter()
        answers = self._setup.ask(rows)
        self._counts["batches"] += 1
        took = time.perf_counter() - begin
        return [(answer, took) for answer in answers]

    async def _drop(self, connection: Any, code: int, why: str) -> None:
        """Tell a client why, in text as openpi's server does, and end its connection."""
        line = " ".join(why.split())
        self._log(f"dropped {connection.remote_address}: {line}")
        await connection.send(line)
        await connection.close(code, "see the message before")


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 3)


_QUIET = logging.getLogger(f"{__name__}.websockets")
"""Of the library, which would log a traceback for every client that hangs up; what matters is logged here."""
_QUIET.setLevel(logging.CRITICAL)
