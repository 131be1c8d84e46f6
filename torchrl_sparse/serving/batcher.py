"""One thread that answers whatever has arrived while it was busy, as one batch."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

__all__ = ["Batcher"]


class Batcher:
    """Answers items in batches, in one thread beside the event loop.

    An idle thread begins at once; what arrives meanwhile is its next batch. Where a batch fails, each of its items is asked
    alone, so that an item fails for its own sake only.

    Args:
        answer: returns an answer for each item, in their order; called in that thread.
        threads: of PyTorch, and of the native engine, in a call; None for as many as now.
    """

    def __init__(self, answer: Callable[[list[Any]], Sequence[Any]], threads: int | None = None):
        self._answer = answer
        self._waiting: list[tuple[Any, asyncio.Future[Any]]] = []
        self._running: asyncio.Task[None] | None = None
        begin = None if threads is None else lambda: torch.set_num_threads(threads)
        self._thread = ThreadPoolExecutor(1, "policy calls", begin)

    async def ask(self, item: Any) -> Any:
        """Return the answer to ``item``, or raise what ``answer`` raised for it."""
        future = asyncio.get_running_loop().create_future()
        self._waiting.append((item, future))
        if self._running is None:
            self._running = asyncio.create_task(self._run())
        return await future

    async def close(self) -> None:
        """Let the call under way end, and the thread with it; what still waits is cancelled."""
        for _, future in self._waiting:
            future.cancel()
        self._waiting.clear()
        if self._running is not None:
            await self._running
        self._thread.shutdown()

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(0)  # others whose requests are there already
        while self._waiting:
            asked, self._waiting = self._waiting, []
            answers = await loop.run_in_executor(self._thread, self._call, [item for item, _ in asked])
            for (_, future), answer in zip(asked, answers, strict=True):
                if future.done():  # its client is gone
                    continue
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)
        self._running = None

    def _call(self, items: list[Any]) -> Sequence[Any]:
        try:
            return self._answer(items)
        except Exception as error:
            return [error] if len(items) == 1 else [self._call([item])[0] for item in items]
