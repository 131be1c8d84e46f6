"""Something in the way: which side is told, its touch fails the episode, and the expert passes on every side."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_sparse import keys
from torchrl_sparse.envs.detours import Obstacle
from torchrl_sparse.envs.experts.operators import draw_operator
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.rotations import pose_to_absolute


def play(task, env, signs=(1, 1), command=None):
    """Act out one episode in a style of these signs; return the last observation and the hand's places, [T, 3]."""
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
        way.append(expert.hand().position - env.sim_env.centre)
        states.append(present[keys.STATE].numpy())
    assert present[keys.EPISODE_WAY].item() == task.load_way_of()(np.stack(states))
    return present, np.stack(way)


@pytest.mark.parametrize(
    ("name", "ways"),
    [("lift_two_ways", [0, 1]), ("lift_four_ways", [0, 1, 2, 3]), ("can_two_ways", [0, 0, 1, 1])],
)
def test_the_expert_takes_the_way_that_its_style_says(name, ways):
    task = find_task(name)
    env = task.make(seeds=range(4), horizon=130)
    taken = []
    for signs in [(-1, -1), (-1, 1), (1, -1), (1, 1)][: len(ways)]:
        end, path = play(task, env, signs)
        obstacle = env.sim_env.obstacle
        assert end[keys.SUCCESS].item()
        assert not obstacle.holds(path).any()
        taken.append(end[keys.EPISODE_WAY].item())
        assert taken[-1] == obstacle.side(path[np.abs(obstacle.passed(path)).argmin()])
    assert taken == ways


def test_a_pillar_is_as_high_as_it_is_low_and_a_ball_is_not():
    above = np.array([[0.01, 0.0, 0.5]])
    round_thing = {"radius": 0.03, "along": (0, 1, 0), "directions": [(1, 0, 0), (-1, 0, 0)]}
    assert not Obstacle(**round_thing).holds(above).any()
    assert Obstacle(**round_thing, upright=True).holds(above).all()


def test_the_mean_of_the_ways_leads_through_the_ball_and_fails():
    task = find_task("lift_two_ways")
    env = task.make(seeds=[3], horizon=60)

    def straight(expert):
        """What the expert does without a ball, as the mean of passing left and right would."""
        lift = super(type(expert), expert).waypoints()
        hand = expert.hand()
        if expert.sim_env.passed < 0:  # no hover: straight ahead
            lift = [replace(lift[0], position=expert.sim_env.centre + 0.02 * expert.sim_env.obstacle.along)]
        return expert._step_towards(hand, lift[0])

    end, _ = play(task, env, command=straight)
    assert end[keys.EPISODE_WAY].item() == BETWEEN
    assert not end[keys.SUCCESS].item()
    assert env.object_positions()[2] > 0.86, "the cube was lifted: it is the ball that failed the episode"


def test_carrying_the_can_between_the_ways_fails():
    task = find_task("can_two_ways")
    env = task.make(seeds=[2], horizon=130)
    ordinary = find_task("can").load_expert()

    def straight(expert):
        """What the expert does without a pillar, but over where it stands."""
        expert._towards = lambda hand, goal: (
            goal[:2] if expert.sim_env.passed > 0.02 else expert.sim_env.centre[:2]
        )
        ahead = ordinary.waypoints(expert)[0]
        return expert._step_towards(expert.hand(), ahead)

    end, path = play(task, env, command=straight)
    assert end[keys.EPISODE_WAY].item() == BETWEEN
    assert not end[keys.SUCCESS].item()
    assert env.sim_env.obstacle.passed(path[-1]) > 0


@pytest.mark.parametrize("name", ["lift_two_ways", "can_two_ways"])
def test_nothing_is_told_before_the_obstacle_is_passed(name):
    env = find_task(name).make(seeds=[0, 1])
    for _ in range(2):
        assert env.reset()[keys.EPISODE_WAY].item() == NO_WAY


def test_a_restored_start_has_the_same_ball():
    env = find_task("lift_two_ways").make(seeds=[5])
    env.reset()
    start = env.get_initial_state()
    ball = env.sim_env.centre.copy()
    other = find_task("lift_two_ways").make(seeds=[6])
    other.reset()
    assert not np.array_equal(other.sim_env.centre, ball)
    other.reset(initial_state=start)
    assert np.array_equal(other.sim_env.centre, ball)
