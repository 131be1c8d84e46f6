"""Clients that break the rules, or off, are told so and dropped; no other robot notices."""

import socket
import threading

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.serving.robots import Client, packed, running
from torchrl_sparse import keys

STATE = np.zeros(5)


def message(**entries):
    return msgpack.packb(entries, default=packed)


@pytest.fixture
def witness(server, episode):
    """A robot that is there before and after, whose answers have to be those of a robot alone."""
    states = episode(9)
    with Client(server.port) as robot:
        expected = [robot.act(state) for state in states]
    with Client(server.port) as robot:
        half = [robot.act(state) for state in states[:4]]
        yield
        np.testing.assert_array_equal(half + [robot.act(state) for state in states[4:]], expected)
    server.until(lambda status: status["clients"] == 0)


@pytest.mark.parametrize(
    ("entry", "sent"),
    [
        ("message", "text"),
        ("message", b""),
        ("message", b"\xc1garbage"),
        ("message", message(state=STATE)[:-3]),
        ("message", message(state=STATE) * 2),
        ("dtype", message(state={b"__ndarray__": True, b"data": b"", b"dtype": "O", b"shape": [0]})),
        ("data", message(state={b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [5]})),
        ("observation", message()),
        ("observation", message(state=STATE, force=STATE)),
        ("state", message(state=np.zeros(6))),
        ("state", message(state=np.zeros((2, 5)))),
        ("state", message(state=np.full(5, np.nan))),
        ("state", message(state=np.full(5, 1e300))),
        ("state", message(state=np.zeros(5, bool))),
    ],
)
@pytest.mark.usefixtures("witness")
def test_what_cannot_be_read_is_refused_in_a_line(server, entry, sent):
    with Client(server.port) as client:
        client.act(STATE)
        told, code = client.refusal(sent)
    assert told.startswith(f"{entry}: expected ")
    assert "\n" not in told
    assert code == 1007


@pytest.mark.usefixtures("witness")
def test_a_seed_in_mid_episode_is_refused(server):
    with Client(server.port) as client:
        client.act(STATE, **{"episode/seed": 3})
        assert client.refusal(message(**{"state": STATE, "episode/seed": 3}))[0].startswith("episode/seed: ")


@pytest.mark.usefixtures("witness")
def test_a_message_that_is_too_long_ends_its_connection(server):
    with Client(server.port) as client, pytest.raises(ConnectionClosed) as raised:
        client.ask({"state": np.zeros(2**20)})
    assert raised.value.rcvd.code == 1009


@pytest.mark.usefixtures("witness")
def test_clients_that_die_in_the_middle_of_a_message(server):
    for sent in (message(state=STATE)[:20], b"", bytes(100_000)):
        client = Client(server.port)
        raw = client.socket.socket
        raw.sendall(b"\x82\xfe\x7f\xff" + bytes(4) + sent)  # the head of a masked frame of 32767 bytes
        raw.shutdown(socket.SHUT_RDWR)
        raw.close()
    for sent in (b"", b"GET / HTTP/1.1\r\nHost: x", b"\x00\x01\x02\r\n\r\n", bytes(70_000)):
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
            raw.sendall(sent)
    server.until(lambda status: status["clients"] == 1)


@pytest.mark.usefixtures("witness")
def test_a_client_that_dies_while_it_is_asked_about(server):
    for _ in range(5):
        client = Client(server.port)
        client.send({"state": STATE})
        client.socket.socket.shutdown(socket.SHUT_RDWR)
    server.until(lambda status: status["clients"] == 1)


@pytest.mark.usefixtures("witness")
def test_a_client_that_reads_nothing_holds_nobody_up(server):
    slow = Client(server.port)
    slow.socket.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.socket.recv_bufsize = 1
    sender = threading.Thread(target=flood, args=(slow,))
    sender.start()
    with Client(server.port) as other:
        for _ in range(20):
            assert other.act(STATE).shape == (1, 10)
    slow.socket.socket.shutdown(socket.SHUT_RDWR)
    sender.join(20)
    assert not sender.is_alive()


def flood(client):
    try:
        for _ in range(2000):
            client.send({"state": STATE})
    except (ConnectionClosed, OSError):
        pass


def test_an_answer_that_is_not_finite_is_one_robots_own(actor, episode, monkeypatch):
    asked = actor.policy.forward

    def forward(tensordict):
        answer = asked(tensordict)
        mad = tensordict[keys.HISTORY_STATE].abs().amax((-1, -2)) > 1e6
        answer[keys.CHUNK][mad] = float("nan")
        return answer

    monkeypatch.setattr(actor.policy, "forward", forward)
    with running(actor) as server, Client(server.port) as good, Client(server.port) as bad:
        for _ in range(3):
            assert np.isfinite(good.act(STATE)).all()
        told, _ = bad.refusal(message(state=np.full(5, 1e7)))
        assert told.startswith("observation: expected ")
        assert np.isfinite(good.act(STATE)).all()


def test_a_fault_of_the_policy_is_told_in_a_line(actor, monkeypatch):
    lines = []
    with running(actor, log=lines.append) as server, Client(server.port) as client:
        monkeypatch.setattr(actor, "forward", lambda tensordict: 1 / 0)
        told, code = client.refusal(message(state=STATE))
        assert told == "policy: ZeroDivisionError: division by zero"
        assert code == 1011
        assert "Traceback" in lines[0]
        assert told in lines[1]
        monkeypatch.undo()
        with Client(server.port) as other:
            other.act(STATE)


def test_at_the_end_every_robot_is_told_so(actor):
    threads = threading.active_count()
    with running(actor) as server:
        robot = Client(server.port)
        robot.act(STATE)
        idle = Client(server.port)
    for client in (robot, idle):
        with pytest.raises(ConnectionClosed) as raised:
            client.act(STATE)
        assert raised.value.rcvd.code == 1001
        client.socket.close()
    with pytest.raises(OSError, match="refused"):
        Client(server.port)
    assert threading.active_count() <= threads


def test_no_page_in_a_browser_may_connect(server):
    with pytest.raises(InvalidStatus) as raised:
        Client(server.port, origin="https://example.org")
    assert raised.value.response.status_code == 403
