"""What arrives during a call is one batch; nothing waits for company."""

import asyncio
import threading

import pytest

from torchrl_sparse.serving.batcher import Batcher


def test_an_idle_thread_begins_at_once_and_the_rest_is_the_next_batch():
    batches, begun, go = [], threading.Event(), threading.Event()

    def answer(items):
        batches.append(items)
        begun.set()
        assert go.wait(20)
        return [10 * item for item in items]

    async def main():
        batcher = Batcher(answer)
        first = asyncio.create_task(batcher.ask(1))
        while not begun.is_set():
            await asyncio.sleep(0.001)
        others = [asyncio.create_task(batcher.ask(item)) for item in (2, 3, 4)]
        await asyncio.sleep(0.01)
        others[1].cancel()  # its client is gone
        go.set()
        found = [await first, await others[0], await others[2]]
        assert await batcher.ask(5) == 50
        await batcher.close()
        return found

    assert asyncio.run(main()) == [10, 20, 40]
    assert batches == [[1], [2, 3, 4], [5]]


def test_an_item_fails_for_its_own_sake_only():
    def answer(items):
        if "bad" in items:
            raise ValueError("bad")
        return items

    async def main():
        batcher = Batcher(answer)
        found = await asyncio.gather(*map(batcher.ask, ("a", "bad", "b")), return_exceptions=True)
        await batcher.close()
        return found

    first, error, last = asyncio.run(main())
    assert (first, last) == ("a", "b")
    with pytest.raises(ValueError, match="bad"):
        raise error
