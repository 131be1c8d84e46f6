"""The scripted experts of Push-T and block pushing in their simulators."""

import numpy as np
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.envs.experts.disturbance import next_noise
from torchrl_sparse.envs.tasks import find_task


def run(task, seeds):
    """Successes and steps of clean episodes."""
    env, results = find_task(task).make(seeds=seeds), []
    for seed in seeds:
        expert, td = find_task(task).load_expert()(np.random.default_rng(seed)), env.reset()
        while not td["done"]:
            action = expert.command(td[keys.STATE].double().numpy())
            td = env.step(td.set(keys.ACTION, torch.as_tensor(action, dtype=torch.float32)))["next"]
        results.append((bool(td["success"]), int(td[keys.EPISODE_STEP])))
    env.close()
    return results


@pytest.mark.parametrize(
    ("task", "package", "steps"), [("PushT", "gym_pusht", 200), ("BlockPush", "pybullet", 160)]
)
def test_experts_solve_unseen_episodes_in_good_time(task, package, steps):
    pytest.importorskip(package)
    results = run(task, [100000, 100001, 100002])
    assert all(success for success, _ in results)
    assert np.mean([length for _, length in results]) < steps


def test_an_episode_follows_from_the_state_and_the_draw():
    pytest.importorskip("gym_pusht")
    assert run("PushT", [8]) == run("PushT", [8])


def test_blocks_go_in_every_order_that_was_drawn():
    orders = {tuple(find_task("BlockPush").load_expert()(np.random.default_rng(s))._order) for s in range(40)}
    assert orders == {((0, 0), (1, 1)), ((0, 1), (1, 0)), ((1, 1), (0, 0)), ((1, 0), (0, 1))}


def test_a_push_begins_behind_the_block_and_walks_round_it():
    expert = find_task("BlockPush").load_expert()(np.random.default_rng(1))
    (block, square), _ = expert._order
    state = np.zeros(16)
    state[[0, 1, 3, 4]] = [0.4, -0.2, 0.2, -0.4]
    state[[10, 11, 13, 14]] = [0.4, 0.2, 0.2, 0.2]
    start = state[3 * block : 3 * block + 2]
    goal = state[10 + 3 * square : 12 + 3 * square]
    ahead = (goal - start) / np.linalg.norm(goal - start)
    state[8:10] = start - 0.045 * ahead  # in place: push
    assert expert.command(state) @ ahead == pytest.approx(np.linalg.norm(expert.command(state)))
    state[8:10] = start + 0.06 * ahead  # on the wrong side: past it, not through it
    heading = expert.command(state) / np.linalg.norm(expert.command(state))
    assert heading @ ahead < 0
    assert abs(heading[0] * ahead[1] - heading[1] * ahead[0]) * 0.06 > 0.04


def test_commands_of_a_demonstration_of_pushing_seldom_turn_back():
    """A policy that is taught by commands that come and go with each disturbance learns nothing."""
    pytest.importorskip("pybullet")
    task, seeds, turned = find_task("BlockPush"), range(5), []
    env = task.make(seeds=seeds)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        expert, td, noise, commands = task.load_expert()(rng), env.reset(), np.zeros(2), []
        while not td["done"]:
            commands.append(expert.command(td[keys.STATE].double().numpy()))
            noise = next_noise(noise, rng)
            action = torch.as_tensor(commands[-1] + expert.noise * noise, dtype=torch.float32)
            td = env.step(td.set(keys.ACTION, action))["next"]
        turned.extend((np.multiply(commands[1:], commands[:-1]).sum(1) < 0).tolist())
    env.close()
    assert np.mean(turned) < 0.05


def test_tasks_without_an_expert_are_named():
    with refused("task"):
        find_task("FrankaKitchen").load_expert()
