"""Robots are answered as each of them alone is, whatever the others do."""

import json
import threading
import urllib.request

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from websockets.exceptions import InvalidStatus

from tests.refusals import refused
from tests.serving.conftest import STEPS
from tests.serving.robots import Client, running
from torchrl_sparse import ChunkExecutor, CoherentChunk, DiffusionPolicy, Sampler, WarmStart, keys
from torchrl_sparse.envs.contract import task_contract
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.serving import PolicyServer
from torchrl_sparse.serving.messages import pack


def alone(actor, states, seed):
    """What a robot's own loop does."""
    actor.reset(seed=seed)
    return [actor.act({"state": state}) for state in states]


def together(server, episodes):
    """What robots get that all ask at the same time, [robots, steps, A]."""
    answers, barrier = [None] * len(episodes), threading.Barrier(len(episodes))

    def play(number, states):
        with Client(server.port) as robot:
            barrier.wait(20)
            begin = {"episode/seed": number, "episode/reset": True}
            answers[number] = [
                robot.act(state, **(begin if step == 0 else {}))[0] for step, state in enumerate(states)
            ]

    threads = [threading.Thread(target=play, args=pair) for pair in enumerate(episodes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return answers


def get(server, page):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}{page}", timeout=10) as response:
        return response.read().decode()


def test_a_robot_is_told_what_is_served(actor, server):
    with Client(server.port) as robot:
        told = robot.metadata
    assert told["answers"] == "action"
    assert (told["state"]["size"], told["chunk"], told["n_action_steps"]) == (5, [5, 10], STEPS)
    assert told["engine"].startswith("native")
    assert told["description"] == actor.policy.describe()
    assert told["task"] is None
    assert told["cameras"] == {}


def test_a_robot_is_answered_as_its_own_loop_would(actor, server, episode):
    first, second = episode(1), episode(2)
    with Client(server.port) as robot:
        answers = [robot.ask({"state": state}) for state in first]
        again = [robot.act(second[0], **{"episode/reset": True}), *map(robot.act, second[1:])]
    expected = alone(actor, first, 0)
    np.testing.assert_array_equal([answer["actions"][0] for answer in answers], expected, strict=True)
    np.testing.assert_array_equal(np.concatenate(again), alone(actor, second, 1))
    called = [answer["server_timing"]["policy_ms"] > 0 for answer in answers]
    assert called == [step % STEPS == 0 for step in range(len(first))]
    assert answers[-1]["server_timing"].keys() >= {"infer_ms", "prev_total_ms", "p50_ms", "p99_ms"}


def test_another_connection_begins_as_the_first_did(server, episode):
    states = episode(3)

    def play():
        with Client(server.port) as robot:
            return [robot.act(state) for state in states]

    np.testing.assert_array_equal(play(), play())


def test_robots_together_are_answered_as_each_alone(actor, server, episode):
    episodes = [episode(number, 12 + number) for number in range(6)]
    answers = together(server, episodes)
    for number, states in enumerate(episodes):
        np.testing.assert_array_equal(answers[number], alone(actor, states, number))
    status = server.server.status()
    assert status["requests"] == sum(map(len, episodes))
    assert status["batches"] < status["policy_calls"]
    assert status["policy_calls"] == sum(-(-len(states) // STEPS) for states in episodes)


@pytest.mark.parametrize("how", ["warm", "coherent"])
def test_what_calls_leave_to_the_next_is_each_robots_own(policy, episode, how):
    if how == "warm":
        policy.start = WarmStart(2)
    more = {"num_samples": 3, "selector": CoherentChunk()} if how == "coherent" else {}
    actor = ChunkExecutor(policy, 2, **more)
    episodes = [episode(number) for number in range(4)]
    with running(actor) as server:
        answers = together(server, episodes)
    for number, states in enumerate(episodes):
        np.testing.assert_array_equal(answers[number], alone(actor, states, number))


def test_chunks_are_answered_to_histories(policy, episode):
    states = episode(4)
    with running(ChunkExecutor(policy, 1), answers="chunk") as server, Client(server.port) as robot:
        chunks = [robot.act(states[step - 1 : step + 1]) for step in range(1, 8)]
        told, code = robot.refusal(pack({"state": states[0]}))
    assert told.startswith("state: expected the last 2 steps")
    assert code == 1007
    reads = np.stack([states[step - 1 : step + 1] for step in range(1, 8)])
    asked = {
        keys.HISTORY_STATE: torch.from_numpy(reads).float(),
        keys.EPISODE_SEED: torch.zeros(7, 1, dtype=torch.int64),
        keys.EPISODE_STEP: torch.arange(7)[:, None],
    }
    expected = policy(TensorDict(asked, [7]))[keys.CHUNK]
    np.testing.assert_array_equal(chunks, expected.numpy())


def test_chunks_of_what_needs_the_chunk_before_are_refused(policy):
    policy.start = WarmStart(2)
    with refused("answers"):
        PolicyServer(ChunkExecutor(policy, 1), answers="chunk")
    with refused("answers"):
        PolicyServer(ChunkExecutor(policy, 1), answers="nothing")


def test_a_robot_with_cameras_is_answered_as_its_own_loop_would(episode):
    torch.manual_seed(0)
    vision = VisionEncoder(["image"], image_size=(40, 44), crop_size=(34, 40), width=16)
    sizes = {
        "input_dim": 4,
        "output_dim": 4,
        "horizon": 6,
        "n_obs_steps": 2,
        "cond_dim": vision.feature_dim + 5,
    }
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    policy = DiffusionPolicy(
        TransformerForDiffusion(**sizes, n_layer=1, n_emb=16, n_head=2), normalizer, vision=vision,
        sampler=Sampler("ddpm", 2, spacing="logsnr"), engine="native",
    )  # fmt: skip
    actor, states = ChunkExecutor(policy, 2), episode(5)
    images = np.random.default_rng(0).integers(0, 256, (len(states), 40, 44, 3), dtype=np.uint8)
    actor.reset(seed=0)
    expected = [actor.act({"state": s, "image": i}) for s, i in zip(states, images, strict=True)]
    with running(actor) as server, Client(server.port) as robot:
        assert robot.metadata["cameras"] == {"image": {"name": "image", "shape": [40, 44, 3]}}
        observed = [{"observation": {"state": s, "image": i}} for s, i in zip(states, images, strict=True)]
        np.testing.assert_array_equal([robot.ask(content)["actions"][0] for content in observed], expected)


def test_a_known_task_is_told(policy):
    server = PolicyServer(ChunkExecutor(policy, 1), task_contract("lift"))
    assert server.metadata["task"] == "Lift"
    assert server.metadata["control_freq"] == 20
    assert server.metadata["state"]["keys"][0] == "object"


def test_pages_answer_plain_requests(server):
    assert get(server, "/healthz") == "OK\n"
    with Client(server.port) as robot:
        robot.act(np.zeros(5))
        status = json.loads(get(server, "/status"))
    assert (status["clients"], status["requests"], status["policy_calls"]) == (1, 1, 1)
    assert status["request"]["p99_ms"] > 0


def test_more_robots_than_allowed_are_refused_until_one_leaves(actor):
    with running(actor, max_clients=2) as server:
        with Client(server.port), Client(server.port) as second:
            with pytest.raises(InvalidStatus) as raised:
                Client(server.port)
            assert raised.value.response.status_code == 503
            assert b"max_clients: expected at most 2" in raised.value.response.body
            assert get(server, "/healthz") == "OK\n"
            second.act(np.zeros(5))
        server.until(lambda status: status["clients"] == 0)
        with Client(server.port) as third:
            third.act(np.zeros(5))
