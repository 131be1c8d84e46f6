"""A server in a thread, and a client of openpi's protocol with nothing of ours in it."""

import asyncio
import threading
from contextlib import ExitStack, contextmanager

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from torchrl_sparse.serving import PolicyServer


def packed(value):
    """As openpi's client packs arrays."""
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    raise TypeError


def unpacked(content):
    if b"__ndarray__" in content:
        return np.ndarray(content[b"shape"], np.dtype(content[b"dtype"]), content[b"data"])
    return content


class Client:
    """One robot; a context that hangs up at its end."""

    def __init__(self, port, **options):
        self._open = ExitStack()
        address = f"ws://127.0.0.1:{port}"
        self.socket = self._open.enter_context(connect(address, compression=None, max_size=None, **options))
        self.metadata = self._read()

    def send(self, content):
        self.socket.send(msgpack.packb(content, default=packed))

    def ask(self, content):
        self.send(content)
        return self._read()

    def act(self, state, **entries):
        return self.ask({"observation/state": np.asarray(state), **entries})["actions"]

    def refusal(self, message):
        """What the server says to bytes or text, after which it hangs up."""
        self.socket.send(message)
        told = self.socket.recv(timeout=20)
        assert isinstance(told, str)
        with pytest.raises(ConnectionClosed) as raised:
            self.socket.recv(timeout=20)
        return told, raised.value.rcvd.code

    def _read(self):
        answer = self.socket.recv(timeout=60)
        assert isinstance(answer, bytes), answer
        return msgpack.unpackb(answer, object_hook=unpacked)

    def __enter__(self):
        return self

    def __exit__(self, *raised):
        self._open.close()


class Running:
    """A server in a thread of its own."""

    def __init__(self, server):
        self.server, self.port = server, 0
        self._stop, self._loop, self._ready = asyncio.Event(), None, threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._main()))
        self._thread.start()
        assert self._ready.wait(60)

    async def _main(self):
        self._loop = asyncio.get_running_loop()
        await self.server.serve("127.0.0.1", 0, self._stop, ready=self._note)

    def _note(self, port):
        self.port = port
        self._ready.set()

    def stop(self):
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(30)
        assert not self._thread.is_alive()

    def until(self, condition):
        """Wait until a condition on the server's status holds."""
        for _ in range(400):
            if condition(self.server.status()):
                return
            threading.Event().wait(0.02)
        pytest.fail(f"not in 8 s: {self.server.status()}")


@contextmanager
def running(executor, contract=None, **options):
    """Serve in a thread as long as the context lasts."""
    with ExitStack() as stack:
        made = Running(PolicyServer(executor, contract, threads=1, **options))
        stack.callback(made.stop)
        yield made
