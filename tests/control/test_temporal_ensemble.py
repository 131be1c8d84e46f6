"""What is played is ACT's weighted mean of all that was predicted for a step, in every row alone, from the episode's start."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler, keys, make_env
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.realtime_executor import RealtimeExecutor
from torchrl_sparse.control.roll_forward import RollForward, StateModel
from torchrl_sparse.control.temporal_ensemble import TemporalEnsemble
from torchrl_sparse.methods.executor import make_executor, make_realtime_executor

LENGTH = 5
HOLD = TensorDictModule(lambda state: state - 100, in_keys=["state"], out_keys=[keys.HOLD])


class Predicting(TensorDictModuleBase):
    """Entry i of a chunk is a number that depends on the state alone, another for each i."""

    in_keys = ["state"]
    out_keys = [keys.CHUNK]

    def forward(self, td):
        return td.set(keys.CHUNK, predictions(td["state"]))


def predictions(state):
    return torch.sin(state * 7 + torch.arange(LENGTH) * 3)[..., None]


def played(executor, steps, begins):
    """The actions [steps, B] of samples whose state is 100 times their number plus the step; `begins` are their first steps."""
    td, actions = TensorDict(batch_size=[len(begins)]), []
    for step in range(steps):
        td["state"] = torch.tensor([[100.0 * row + step] for row in range(len(begins))])
        td[keys.IS_INIT] = torch.tensor([[step in first] for first in begins])
        td = executor(td)
        actions.append(td[keys.ACTION].flatten())
    return torch.stack(actions)


def weighted_mean(step, row, first, every, coeff):
    """ACT's formula: all predictions of this episode for the step, the oldest with index 0."""
    asked = [t for t in range(first, step + 1, every) if step - t < LENGTH]
    values = [float(predictions(torch.tensor([100.0 * row + t]))[step - t, 0]) for t in asked]
    weights = [math.exp(-coeff * i) for i in range(len(values))]
    return sum(w * v for w, v in zip(weights, values, strict=True)) / sum(weights)


@pytest.mark.parametrize("coeff", [0.0, 0.01, 0.7, -0.7, -100.0])
@pytest.mark.parametrize("every", [1, 2, 3, 5])
def test_every_action_is_the_weighted_mean_of_the_formula(every, coeff):
    executor = ChunkExecutor(TemporalEnsemble(Predicting(), coeff), every)
    actions = played(executor, 12, [{0}, {0, 7}, {0, 4, 5}])
    for row, starts in enumerate([[0], [0, 7], [0, 4, 5]]):
        for step in range(12):
            first = max(t for t in starts if t <= step)
            expected = weighted_mean(step, row, first, every, coeff)
            assert actions[step, row].item() == pytest.approx(expected, abs=1e-5), (row, step)


def test_a_row_is_as_if_it_were_alone():
    executor = ChunkExecutor(TemporalEnsemble(Predicting()), 2)
    together = played(executor, 9, [{0}, {0, 3}])
    assert torch.equal(played(executor, 9, [{0}])[:, 0], together[:, 0])


def test_chunks_that_share_no_step_are_the_policys_own():
    plain, averaged = (ChunkExecutor(p, LENGTH) for p in (Predicting(), TemporalEnsemble(Predicting())))
    assert torch.equal(played(plain, 12, [{0}, {0, 6}]), played(averaged, 12, [{0}, {0, 6}]))


def test_late_answers_are_averaged_with_what_was_predicted_for_their_steps():
    executor = RealtimeExecutor(TemporalEnsemble(Predicting(), 0.0), HOLD, 2, latency=0.05)
    actions = played(executor, 4, [{0}])[:, 0]
    first, second = predictions(torch.tensor([0.0]))[:, 0], predictions(torch.tensor([2.0]))[:, 0]
    assert actions[0] == -100  # held until the first answer
    # Asked at step 2, answered at step 3: there the mean of both predictions for it.
    torch.testing.assert_close(actions[1:], torch.stack([first[1], first[2], (first[3] + second[1]) / 2]))


def test_methods_are_ensembled_by_name():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    made = make_executor("ddim2_every2_of3_ensembled", policy, 8)
    assert isinstance(made.policy, TemporalEnsemble)
    assert (made.policy.policy, made.n_action_steps, made.num_samples) == (policy, 2, 3)
    # What is averaged are chunks that begin at the present step, so the state is rolled inside.
    model = StateModel.fit([(torch.rand(9, 19), torch.rand(9, 10))])
    options = {"hold": HOLD, "latency": 0.1, "control_freq": 20.0, "model": model}
    late = make_realtime_executor("ddim2_every2_ensembled_ahead", policy, 8, **options)
    assert isinstance(late.policy.policy, RollForward)


def test_an_environment_is_played_with_averages_of_what_was_predicted():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddim", 2)
    env = make_env("Lift", seeds=[7])
    rollout = env.rollout(5, make_executor("ddim2_every2_ensembled", policy, 8))
    assert rollout[keys.ENSEMBLED][:, 0].flatten().tolist() == [1, 1, 2, 2, 3]
    assert rollout[keys.ENSEMBLED][4].tolist() == [3, 3, 3, 3, 3, 2, 2, 1, 1]
    alone = policy(rollout[2:3].exclude(keys.CHUNK))[keys.CHUNK]
    first, second = rollout[keys.CHUNK][0], rollout[keys.CHUNK][2]
    weight = math.exp(-0.01)
    expected = (first[2:9] + weight * alone[0, :7]) / (1 + weight)
    torch.testing.assert_close(second[:7], expected)
    torch.testing.assert_close(second[7:], alone[0, 7:])
    env.close()


def test_a_weight_that_is_no_number_is_refused():
    with refused("coeff"):
        TemporalEnsemble(Predicting(), math.nan)
