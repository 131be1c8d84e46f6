"""The policy server under openpi's own client, ``openpi-client`` 0.1.2, which needs an environment with numpy 1."""

import os
import threading

import numpy as np
import pytest

client = pytest.importorskip("openpi_client.websocket_client_policy")
pytest.importorskip("msgpack")

from openpi_client.action_chunk_broker import ActionChunkBroker  # noqa: E402

from tests.fixtures.diffusion import make_network  # noqa: E402, F401
from tests.serving.conftest import actor, episode, policy  # noqa: E402, F401
from tests.serving.robots import running  # noqa: E402
from torchrl_sparse import ChunkExecutor  # noqa: E402

REQUESTS = int(os.environ.get("PEER_REQUESTS", 2000))
"""Of the test of many; the issue of this server asks for 100,000."""


def connect(server):
    return client.WebsocketClientPolicy("127.0.0.1", server.port)


def alone(actor, states, seed):  # noqa: F811
    actor.reset(seed=seed)
    return [actor.act({"state": state}) for state in states]


def test_it_is_answered_as_a_robots_own_loop(actor, episode):  # noqa: F811
    states = episode(0)
    with running(actor) as server:
        robot = connect(server)
        assert robot.get_server_metadata()["chunk"] == [5, 10]
        robot.reset()  # which sends nothing
        answers = [robot.infer({"observation/state": s, "prompt": np.str_("lift")}) for s in states]
    np.testing.assert_array_equal([answer["actions"][0] for answer in answers], alone(actor, states, 0))
    assert answers[0]["server_timing"]["infer_ms"] > 0


def test_its_broker_plays_chunks(policy, episode):  # noqa: F811
    states = episode(1)
    with running(ChunkExecutor(policy, 1), answers="chunk") as server:
        chunk = connect(server).infer({"state": states[:2]})["actions"]
        broker = ActionChunkBroker(connect(server), action_horizon=4)
        played = [broker.infer({"state": states[:2]})["actions"] for _ in range(4)]
    np.testing.assert_array_equal(played, chunk[:4])


def test_its_broker_plays_single_actions(actor, episode):  # noqa: F811
    states = episode(2)
    with running(actor) as server:
        broker = ActionChunkBroker(connect(server), action_horizon=1)
        played = [broker.infer({"observation": {"state": state}})["actions"] for state in states]
    np.testing.assert_array_equal(played, alone(actor, states, 0))


def test_a_refusal_is_its_error(actor):  # noqa: F811
    with running(actor) as server:
        robot = connect(server)
        with pytest.raises(RuntimeError, match="state: expected 5 finite numbers in one row, got shape"):
            robot.infer({"state": np.zeros(6)})
        connect(server).infer({"state": np.zeros(5)})


def test_many_requests_of_many_robots_leave_nothing_behind(actor, episode):  # noqa: F811
    """Eight robots that come and go, and one that stays; every answer is right, and memory stays as it is."""
    robots, steps = 8, 40
    episodes = [episode(number, steps) for number in range(robots)]
    expected = [alone(actor, states, number) for number, states in enumerate(episodes)]
    wrong = []

    def play(server, number, rounds):
        for _ in range(rounds):
            robot = connect(server)
            begin = {"episode/reset": True, "episode/seed": number}
            for step, state in enumerate(episodes[number]):
                answer = robot.infer({"state": state, **(begin if step == 0 else {})})
                if not np.array_equal(answer["actions"][0], expected[number][step]):
                    wrong.append((number, step))
            robot._ws.close()

    def all_play(server, rounds):
        threads = [threading.Thread(target=play, args=(server, number, rounds)) for number in range(robots)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    with running(actor) as server:
        all_play(server, 2)
        before = resident()
        rounds = max(1, REQUESTS // (robots * steps))
        all_play(server, rounds)
        server.until(lambda status: status["clients"] == 0)
        assert server.server.status()["requests"] == robots * steps * (rounds + 2)
    assert not wrong
    assert resident() - before < 30 * 2**20


def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
