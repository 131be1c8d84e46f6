"""The state in which an answer will begin: predicted right, shown to the policy, and the chunk put off to it."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler, keys
from torchrl_sparse.control.realtime_executor import RealtimeExecutor
from torchrl_sparse.control.roll_forward import RollForward, StateModel
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.methods.executor import make_executor, make_realtime_executor
from torchrl_sparse.training.state_model import fit_state_model

WEIGHT = torch.tensor(
    [[-0.5, 0.0], [0.2, 0.0], [0.0, 0.0], [0.0, 0.9], [0.4, 0.1], [0.01, -0.02]], dtype=torch.float64
)
"""A hand that follows its commands late, guided toward something that drifts: 2 numbers, their change, an action and 1."""
HOLD = TensorDictModule(lambda state: torch.zeros_like(state[..., :1]), [keys.STATE], [keys.HOLD])


def step(before, now, action):
    return now + (torch.cat([now, now - before, action, torch.ones(1)]).double() @ WEIGHT).float()


def episode(length, seed):
    actions = torch.randn(length, 1, generator=torch.Generator().manual_seed(seed))
    states = [torch.zeros(2), torch.tensor([0.1, 0.3])]
    while len(states) < length:
        states.append(step(states[-2], states[-1], actions[len(states) - 1]))
    return torch.stack(states), actions


@pytest.fixture(scope="module")
def model():
    return StateModel.fit([episode(30, seed) for seed in range(4)])


class Seer(TensorDictModuleBase):
    """Its chunk counts on from the last number of the state that it was shown; what it was shown is kept."""

    in_keys = [keys.HISTORY_STATE]
    out_keys = [keys.CHUNK]

    def __init__(self):
        super().__init__()
        self.shown = []

    def forward(self, td):
        history = td[keys.HISTORY_STATE]
        self.shown.append(history.clone())
        return td.set(keys.CHUNK, history[..., -1, -1:, None] + 0.1 * torch.arange(9.0)[:, None])


def test_a_linear_world_is_found_exactly(model):
    others = [episode(20, seed) for seed in range(10, 13)]
    rolled, stale = model.errors([*others, episode(3, 0)], 3)  # the last is too short to count
    assert rolled.max() < 1e-3 < 1e-2 < stale.min()
    expected = [(states[4:] - states[1:-3]).abs() for states, _ in others]
    torch.testing.assert_close(stale, torch.cat(expected).mean(dim=0))


def test_commands_that_never_turn_leave_the_model_as_it_is(model):
    # As demonstrations of Can do: entries of the rotation are 1 or 0 in every step, which makes their columns one and the same.
    still = torch.tensor([1.0, 0.0, 1.0]).expand(30, 3)
    episodes = [
        (states, torch.cat([actions, still], dim=1)) for states, actions in map(episode, [30] * 4, range(4))
    ]
    weight = StateModel.fit(episodes).weight
    torch.testing.assert_close(torch.cat([weight[:5], weight[-1:]]), model.weight, rtol=0, atol=1e-12)
    assert not weight[5:8].any()


def test_a_number_that_never_changes_stays():
    states, actions = episode(30, 0)
    model = StateModel.fit([(torch.cat([states, torch.full((30, 1), 7.0)], dim=1), actions)])
    assert model(torch.tensor([1.0, 2.0, 7.0]), torch.tensor([3.0, 4.0, 7.0]), torch.ones(1))[2] == 7.0


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_a_policy_is_shown_the_state_in_which_its_answer_begins(delay):
    """Played in that world: what each policy call but the first is shown comes true when its answer takes over."""
    seer = Seer()
    executor = RealtimeExecutor(RollForward(seer, StateModel(WEIGHT)), HOLD, 4, latency=delay / 20)
    states, asked, actions = [torch.zeros(2), torch.tensor([0.1, 0.3])], [], []
    td = TensorDict(batch_size=[1])
    for now in range(24):
        td[keys.HISTORY_STATE] = torch.stack(states[-2:])[None]
        td[keys.STATE] = states[-1][None]
        td[keys.IS_INIT] = torch.tensor([[now == 0]])
        td = executor(td)
        if td[keys.QUERIED].item():
            asked.append(now)
        actions.append(td[keys.ACTION][0])
        assert torch.equal(td[keys.HISTORY_STATE][0], torch.stack(states[-2:]))  # recorded is what was seen
        states.append(step(*states[-2:], actions[-1]))
    for query, shown in zip(asked[1:5], seer.shown[1:5], strict=True):
        begins = query + delay
        torch.testing.assert_close(shown[0], torch.stack(states[begins : begins + 2]), atol=1e-4, rtol=1e-5)
        count = shown[0, -1, -1] + 0.1 * torch.arange(
            4.0
        )  # the answer's own first actions, none of them skipped
        torch.testing.assert_close(torch.cat(actions[begins : begins + 4]), count, atol=1e-6, rtol=0)


def late(rows, **control):
    states = torch.randn(rows, 2, 19, generator=torch.Generator().manual_seed(0))
    td = TensorDict({"history": {"state": states}, "episode": {"seed": torch.arange(rows)[:, None]}}, [rows])
    td[keys.EPISODE_STEP] = torch.full((rows, 1), 8)
    for name, value in control.items():
        td["control", name] = value
    return td


@pytest.fixture(scope="module")
def diffusion():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddpm", timesteps=[82, 14])
    return policy


@pytest.fixture(scope="module")
def ahead(diffusion):
    generator = torch.Generator().manual_seed(1)
    recorded = torch.randn(60, 29, generator=generator)
    return RollForward(diffusion, StateModel.fit([(recorded[:, :19], recorded[:, 19:])]))


def test_a_row_of_a_batch_is_the_row_alone(ahead):
    control = {
        "last_chunk": torch.randn(4, 9, 10, generator=torch.Generator().manual_seed(2)),
        "elapsed": torch.tensor([[4], [0], [2], [7]]),
        "delay": torch.tensor([[1], [3], [3], [0]]),
    }
    td = late(4, **control)
    together = ahead(td.clone())
    alone = torch.cat([ahead(td[row : row + 1].clone()) for row in range(4)])
    assert torch.equal(together[keys.CHUNK], alone[keys.CHUNK])
    assert torch.equal(together[keys.HISTORY_STATE], td[keys.HISTORY_STATE])
    assert torch.equal(together[keys.CHUNK][2, :3], control["last_chunk"][2, 2:5])  # what plays meanwhile


def test_without_delay_and_at_the_beginning_the_policy_answers_as_ever(ahead, diffusion):
    plain = diffusion(late(2))[keys.CHUNK]
    begun = {
        "last_chunk": torch.zeros(2, 9, 10),
        "elapsed": torch.tensor([[0], [4]]),
        "delay": torch.tensor([[3], [0]]),
    }
    assert torch.equal(ahead(late(2, **begun))[keys.CHUNK], plain)
    assert torch.equal(ahead(late(2))[keys.CHUNK], plain)


def test_what_cannot_be_rolled_is_named(model):
    with refused("policy"):
        RollForward(TensorDictModule(torch.zeros_like, ["x"], [keys.CHUNK]), model)
    short = TensorDict({"history": {"state": torch.zeros(1, 1, 2)}}, [1])
    short[keys.LAST_CHUNK] = torch.zeros(1, 9, 1)
    short[keys.ELAPSED] = short[keys.DELAY] = torch.ones(1, 1, dtype=torch.int64)
    with refused("('history', 'state')"):
        RollForward(Seer(), model)(short)
    with refused("episodes"):
        StateModel.fit([episode(2, 0)])
    with refused("episodes"):
        model.errors([episode(6, 0)], 5)


def test_methods_look_ahead_where_the_world_does_not_wait(diffusion, model):
    with refused("methods: ddim2_ahead"):
        make_executor("ddim2_ahead", diffusion, 4)
    options = {"hold": HOLD, "latency": 0.1, "control_freq": 20.0}
    with refused("methods: ddim2_ahead"):
        make_realtime_executor("ddim2_ahead", diffusion, 4, **options)
    made = make_realtime_executor("ddim2_every2_of3_ahead", diffusion, 4, model=model, **options)
    assert isinstance(made.policy, RollForward)
    assert (made.n_action_steps, made.num_samples) == (2, 3)
    assert make_realtime_executor("ddim2", diffusion, 4, **options).policy is diffusion


def test_demonstrations_fit_a_model_and_try_it_on_others():
    recorded = [episode(20, seed) for seed in range(12)]
    states, actions = (torch.cat(part) for part in zip(*recorded, strict=True))
    data = TensorDict({keys.STATE: states, keys.ACTION: actions}, [len(states)])
    demos = Demonstrations(data, torch.arange(0, 241, 20))
    fitted, error = fit_state_model(demos, 3)
    assert error < 1e-3
    torch.testing.assert_close(fitted.weight, StateModel.fit(recorded[:11]).weight)
    with refused("demos"):
        fit_state_model(demos.between(0, 1), 3)
