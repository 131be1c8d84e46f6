"""When a motion counts as fine, what the controller then writes, and what the executor makes of it in mid-chunk."""

import itertools

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from tests.control.test_chunk_executor import CountingPolicy
from tests.refusals import refused
from torchrl_sparse import (
    ActionAwareController,
    ChunkExecutor,
    DiffusionPolicy,
    Sampler,
    keys,
    make_env,
)
from torchrl_sparse.control.action_aware import (
    COMMANDED,
    MEASURED,
    ReleaseThresholds,
    Thresholds,
    fine_mode,
    rotation_speed,
    translation_speed,
)

# Enters below 1 m/s and 2 rad/s; leaves above 3 m/s, 4 rad/s or rising by 0.5 m/s.
LIMITS = Thresholds(1.0, 2.0, leave_translation=3.0, leave_rotation=4.0, leave_rise=0.5)
SPEEDS = {"slow": 0.9, "between": 2.0, "fast": 3.1}
TURNS = {"slow": 1.9, "between": 3.0, "fast": 4.1}
RISES = {"down": -0.1, "level": 0.0, "up a little": 0.4, "up": 0.6}


def expected(speed, turn, rise, was_fine):
    """The rule in words, for the table."""
    if was_fine:
        return speed != "fast" and turn != "fast" and rise != "up"
    return speed == turn == "slow" and rise in ("down", "level")


@pytest.mark.parametrize("was_fine", [False, True])
def test_truth_table(was_fine):
    seen = set()
    for speed, turn, rise in itertools.product(SPEEDS, TURNS, RISES):
        dz = RISES[rise]
        dx = (SPEEDS[speed] ** 2 - dz**2) ** 0.5
        twist = torch.tensor([[dx, 0.0, dz, 0.0, TURNS[turn], 0.0]])
        fine = fine_mode(twist, torch.tensor([was_fine]), LIMITS).item()
        assert fine == expected(speed, turn, rise, was_fine), (speed, turn, rise)
        seen.add(fine)
    assert seen == {True, False}


def test_speeds_are_norms_of_their_halves():
    twist = torch.tensor([[3.0, 4.0, 12.0, -2.0, 3.0, 6.0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    assert translation_speed(twist).tolist() == [13, 0]
    assert rotation_speed(twist).tolist() == [7, 1]


def test_one_slow_arm_enters_and_all_must_move_to_leave():
    slow, fast = [0.1, 0, 0, 0, 0, 0], [9.0, 0, 0, 0, 0, 0]
    for twists, enters, stays in (((slow, fast), True, True), ((fast, fast), False, False)):
        twist = torch.tensor([twists])
        assert fine_mode(twist, torch.tensor([[False]]), LIMITS).item() == enters
        assert fine_mode(twist, torch.tensor([[True]]), LIMITS).item() == stays


def release_rule(action, was_fine, queue):
    """The rule of the authors' release in plain numbers: action [6], and how many actions are left of the chunk."""
    speed, planar = sum(x * x for x in action[:3]) ** 0.5, sum(x * x for x in action[:2]) ** 0.5
    turn, rise = sum(x * x for x in action[3:]) ** 0.5, action[2]
    if was_fine:
        return not (rise > 0.2 or (turn > 0.3 and queue == 0))
    return speed < 0.4 or (planar < 0.1 and rise < 0.1 and turn < 0.2)


def test_the_release_has_another_rule():
    generator = torch.Generator().manual_seed(0)
    twist = torch.randn(2000, 1, 6, generator=generator) * torch.tensor([0.15, 0.15, 0.4, 0.2, 0.2, 0.2])
    was, used_up = torch.rand(2, 2000, 1, generator=generator) < 0.5
    fine = fine_mode(twist, was, COMMANDED, used_up)
    rows = zip(twist[:, 0].tolist(), was.flatten().tolist(), used_up.flatten().tolist(), strict=True)
    expected = [release_rule(action, before, queue=0 if last else 3) for action, before, last in rows]
    assert fine.flatten().tolist() == expected
    assert len({*zip(expected, was.flatten().tolist(), used_up.flatten().tolist(), strict=True)}) == 8
    both = fine_mode(twist, torch.zeros_like(was), COMMANDED) & ~fine_mode(
        twist, ~torch.zeros_like(was), COMMANDED
    )
    assert both.any()  # such motions alternate, as they do there


def test_options_of_recipes_make_controllers():
    thresholds = {
        "translation": 0.1,
        "rotation": 0.2,
        "leave_translation": 0.3,
        "leave_rotation": 0.4,
        "leave_rise": 0.0,
    }
    controller = ActionAwareController.from_options(coarse=12, thresholds=thresholds)
    assert controller.budgets == (12.0, 40.0)
    assert controller.thresholds == Thresholds(**thresholds)
    released = ActionAwareController.from_options(
        motion="commanded", thresholds={"speed": 0.2}, chunk_steps=4
    )
    assert released.thresholds == ReleaseThresholds(speed=0.2)
    with refused("controller: motion"):
        ActionAwareController.from_options(motion="speed")
    with refused("thresholds"):
        ActionAwareController.from_options(thresholds={"speed": 0.2})


@pytest.mark.parametrize("limits", [MEASURED, LIMITS])
def test_no_motion_both_enters_and_leaves(limits):
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.0, 1, 1, 2, 2, 2]) * 0.3
    twist = (torch.randn(4000, 1, 6, generator=generator) * scale).clamp(-1, 1)
    coarse = torch.zeros(4000, 1, dtype=torch.bool)
    entered = fine_mode(twist, coarse, limits)
    stayed = fine_mode(twist, ~coarse, limits)
    assert entered.any()
    assert not stayed.all()
    assert (stayed | ~entered).all()


def move(controller, td, speeds, is_init=False, key=keys.EEF_VEL):
    batch = td.batch_size
    twist = torch.zeros(*batch, 6)
    twist[..., 0] = torch.as_tensor(speeds, dtype=torch.float32)
    td[key] = twist
    td[keys.IS_INIT] = torch.as_tensor(is_init).expand(batch).unsqueeze(-1).clone()
    return controller(td)


def flags(td, key):
    return td[key].flatten().tolist()


def test_each_sample_switches_replans_once_and_starts_anew():
    controller = ActionAwareController(thresholds=LIMITS, warmup_steps=1)
    td = move(controller, TensorDict(batch_size=[3]), [0.0, 0.0, 9.0], True)
    assert flags(td, keys.FINE) == flags(td, keys.REPLAN) == [False] * 3
    td = move(controller, td, [0.5, 9.0, 9.0])
    assert flags(td, keys.FINE) == flags(td, keys.REPLAN) == [True, False, False]
    assert flags(td, keys.TOKEN_BUDGET) == [40, 24, 24]
    td = move(controller, td, [2.0, 0.5, 9.0])  # the first stays: 2 m/s does not leave
    assert flags(td, keys.FINE) == [True, True, False]
    assert flags(td, keys.REPLAN) == [False, True, False]
    td = move(controller, td, [0.5, 4.0, 2.0], [True, False, False])  # 2 m/s does not enter
    assert flags(td, keys.FINE) == [False, False, False]
    td = move(controller, td, [0.5, 4.0, 9.0])
    assert flags(td, keys.REPLAN) == [True, False, False]  # a new episode, a new entry


def test_an_episode_begins_coarse():
    controller = ActionAwareController(thresholds=LIMITS, warmup_steps=3)
    td = TensorDict(batch_size=[2])
    seen = []
    for step in range(6):
        td = move(controller, td, [0.0, 0.0], [step == 0, step in (0, 2)])
        seen.append(flags(td, keys.FINE))
    assert seen == [[False] * 2, [False] * 2, [False] * 2, [True, False], [True, False], [True, True]]


def test_budget_goes_where_it_is_told():
    key = ("diffusion", "rate")
    controller = ActionAwareController(
        coarse=0.95, fine=0.8, budget_key=key, thresholds=LIMITS, warmup_steps=1
    )
    td = move(controller, TensorDict(batch_size=[]), 0.0, True)
    assert td[key].item() == pytest.approx(0.95)
    assert move(controller, td, 0.0)[key].item() == pytest.approx(0.8)
    assert keys.TOKEN_BUDGET not in controller.out_keys
    assert key in controller.out_keys


class Deltas(CountingPolicy):
    """Chunks of delta actions whose entry i moves the hand by ``speeds[i]`` along x."""

    def __init__(self, speeds):
        super().__init__()
        self.speeds = torch.tensor(speeds)

    def forward(self, td):
        td = super().forward(td)
        chunk = torch.zeros(*td.batch_size, len(self.speeds), 7)
        chunk[..., 0], chunk[..., 6] = self.speeds, 1.0  # the gripper is no motion
        return td.set(keys.CHUNK, chunk)


def test_commanded_reads_the_action_served_last():
    controller = ActionAwareController("commanded", thresholds=LIMITS, warmup_steps=1)
    policy = Deltas([9.0, 9.0, 0.5, 9.0, 9.0])
    executor, td = ChunkExecutor(policy, n_action_steps=5, controller=controller), TensorDict(batch_size=[2])
    ages, fine = [], []
    for step in range(6):
        td["input"] = torch.zeros(2, 1)
        td[keys.IS_INIT] = torch.tensor([[step == 0], [step in (0, 1)]])
        td = executor(td)
        ages.append(flags(td, keys.AGE))
        fine.append(flags(td, keys.FINE))
    # The slow command is the third; the step after it is fine, and drops the two that were left of the chunk.
    assert [row[0] for row in ages] == [0, 1, 2, 0, 1, 2]
    assert [row[0] for row in fine] == [False, False, False, True, False, False]
    assert [row[1] for row in ages] == [0, 0, 1, 2, 0, 1]


def test_commanded_wants_deltas():
    controller = ActionAwareController("commanded")
    td = TensorDict({keys.CHUNK: torch.zeros(8, 10), keys.AGE: torch.tensor([0])}, [])
    td[keys.IS_INIT] = torch.tensor([False])
    with refused("('vla_action', 'chunk')"):
        controller(td)


@pytest.mark.parametrize("on", ["measured", "commanded"])
def test_samples_at_their_first_step_may_be_stacked_with_others(on):
    controller = ActionAwareController(on, thresholds=LIMITS, warmup_steps=1)
    executor = ChunkExecutor(Deltas([0.5, 0.5, 0.5, 0.5]), n_action_steps=4, controller=controller)
    fresh = TensorDict({"input": torch.zeros(1), keys.EEF_VEL: torch.zeros(6)}, [])
    fresh[keys.IS_INIT] = torch.tensor([True])
    later = executor(fresh.clone())
    later[keys.IS_INIT] = torch.tensor([False])
    td = executor(lazy_stack([later, fresh]))
    assert flags(td, keys.FINE) == flags(td, keys.REPLAN) == [True, False]
    assert flags(td, keys.QUERIED) == [True, True]


def test_mistakes_are_named():
    with refused("on"):
        ActionAwareController("speed")
    with refused("warmup_steps"):
        ActionAwareController(warmup_steps=0)
    with refused("rotation"):
        Thresholds(1, 2, 3, 1, 0)
    with refused("leave_rise"):
        Thresholds(1, 1, 3, 1, -1)
    with pytest.raises(KeyError, match="eef_vel"):
        ActionAwareController()(TensorDict({keys.IS_INIT: torch.tensor([True])}, []))
    td = TensorDict({keys.EEF_VEL: torch.zeros(7), keys.IS_INIT: torch.tensor([True])}, [])
    with refused("('observation', 'eef_vel')"):
        ActionAwareController()(td)


# -- in closed loop ---------------------------------------------------------------------------------------------------


def lift_actor():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddim", 10)
    return ChunkExecutor(policy, n_action_steps=8, controller=ActionAwareController())


def lift(seed):
    return make_env("Lift", seeds=[seed], horizon=24)


OPTIONS = {"total_frames": 24, "frames_per_batch": 24, "exploration_type": ExplorationType.RANDOM}


def check_episode(steps):
    """A trained policy on Lift: down at speed, then slowly onto the cube, which is when it looks again."""
    fine, replan = (steps[key].squeeze(-1) for key in (keys.FINE, keys.REPLAN))
    (entered,) = replan.nonzero().squeeze(-1).tolist()
    assert 10 <= entered < 24
    assert entered % 8
    assert not fine[:entered].any()
    assert fine[entered]
    speed = translation_speed(steps[keys.EEF_VEL])
    assert speed[entered] < MEASURED.translation < speed[1:entered].mean()
    queries = steps[keys.QUERIED].squeeze(-1).nonzero().squeeze(-1).tolist()
    assert queries == [*range(0, entered, 8), *range(entered, len(steps), 8)]
    assert torch.equal(steps[keys.TOKEN_BUDGET].squeeze(-1), torch.where(fine, 40.0, 24.0))


def test_lift_in_a_collector():
    actor = lift_actor()
    collector = Collector(lift(0), actor, auto_register_policy_transforms=True, **OPTIONS)
    try:
        steps = next(iter(collector)).clone()
    finally:
        collector.shutdown()
    check_episode(steps)
    assert not set(actor.out_keys) - set(steps.keys(True, True))
    assert {keys.EEF_VEL, keys.FINE, keys.IS_INIT} <= set(actor.in_keys)
