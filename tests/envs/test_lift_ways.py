"""A ball in the way: which side is told, its touch fails the episode, and the expert passes on every side."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_sparse import keys
from torchrl_sparse.envs.experts.operators import draw_operator
from torchrl_sparse.envs.lift_ways import RADIUS, directions, way_of
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.rotations import pose_to_absolute


def play(task, env, signs=(1, 1), command=None):
    """Act out one episode in a style of these signs; return the last observation and the hand relative to the ball, [T, 3]."""
    rng = np.random.default_rng(0)
    style = draw_operator("proficient", rng).draw(rng)
    style = replace(style, bow=signs[0] * abs(style.bow), offset=signs[1] * abs(style.offset))
    present = env.reset()
    expert = task.load_expert()(env.sim_env, style)
    way, states = [], [present[keys.STATE].numpy()]
    while not present["done"].item():
        pose = expert.command() if command is None else command(expert)
        present[keys.ACTION] = torch.as_tensor(pose_to_absolute(pose), dtype=torch.float32)
        present = env.step(present)["next"]
        way.append(expert.hand().position - env.sim_env.ball)
        states.append(present[keys.STATE].numpy())
    assert present[keys.EPISODE_WAY].item() == way_of(np.stack(states), env.sim_env.ways)
    return present, np.stack(way)


@pytest.mark.parametrize(("name", "ways"), [("lift_two_ways", [0, 1]), ("lift_four_ways", [0, 1, 2, 3])])
def test_the_expert_takes_the_way_that_its_style_says(name, ways):
    task = find_task(name)
    env = task.make(seeds=range(4), horizon=80)
    taken = []
    for signs in [(-1, -1), (-1, 1), (1, -1), (1, 1)][: len(ways)]:
        end, path = play(task, env, signs)
        assert end[keys.SUCCESS].item()
        assert np.linalg.norm(path, axis=1).min() > RADIUS
        taken.append(end[keys.EPISODE_WAY].item())
        passing = path[np.abs(path @ env.sim_env.along).argmin()]
        assert taken[-1] == (directions(len(ways)) @ passing).argmax()
    assert taken == ways


def test_the_mean_of_the_ways_leads_through_the_ball_and_fails():
    task = find_task("lift_two_ways")
    env = task.make(seeds=[3], horizon=60)

    def straight(expert):
        """What the expert does without a ball, as the mean of passing left and right would."""
        lift = super(type(expert), expert).waypoints()
        hand = expert.hand()
        if expert.sim_env.passed < 0:  # no hover: straight ahead
            lift = [replace(lift[0], position=expert.sim_env.ball + 0.02 * expert.sim_env.along)]
        return expert._step_towards(hand, lift[0])

    end, _ = play(task, env, command=straight)
    assert end[keys.EPISODE_WAY].item() == BETWEEN
    assert not end[keys.SUCCESS].item()
    assert env.object_positions()[2] > 0.86, "the cube was lifted: it is the ball that failed the episode"


def test_nothing_is_told_before_the_ball_is_passed():
    env = find_task("lift_two_ways").make(seeds=[0, 1])
    for _ in range(2):
        assert env.reset()[keys.EPISODE_WAY].item() == NO_WAY


def test_a_restored_start_has_the_same_ball():
    env = find_task("lift_two_ways").make(seeds=[5])
    env.reset()
    start = env.get_initial_state()
    ball = env.sim_env.ball.copy()
    other = find_task("lift_two_ways").make(seeds=[6])
    other.reset()
    assert not np.array_equal(other.sim_env.ball, ball)
    other.reset(initial_state=start)
    assert np.array_equal(other.sim_env.ball, ball)
