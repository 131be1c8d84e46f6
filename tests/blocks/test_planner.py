import hashlib
import pickle

import pytest
import torch
from tensordict import TensorDict

from tests.blocks.conftest import COND_DIM, NUM_LAYERS, NUM_STEPS, OBS_STEPS
from tests.refusals import refused
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.planner import Dense, Planner, PlanSpec, StaticPlanner, tensors_fingerprint
from torchrl_sparse.keys import COND, PRUNE_MASK

SPEC = PlanSpec(NUM_STEPS, NUM_LAYERS, policy="a policy")


class RestAtRest(Planner):
    """Where the observation hardly changes, FFNs are computed at every fourth step only."""

    def __init__(self, threshold: float) -> None:
        super().__init__()
        self.threshold = threshold

    def masks(self, cond):
        quiet = (cond[:, -1] - cond[:, 0]).norm(dim=-1) < self.threshold
        skipped = torch.arange(self.spec.num_inference_steps) % 4 != 0
        ffn = torch.arange(self.spec.num_blocks) % 3 == 2
        return quiet[:, None, None] & skipped[:, None] & ffn


class Returns(Planner):
    """Returns whatever it is told to."""

    def __init__(self, masks) -> None:
        super().__init__()
        self.returned = masks

    def masks(self, cond):
        return self.returned


def observations(*batch):
    cond = torch.randn(*batch, OBS_STEPS, COND_DIM, generator=torch.Generator().manual_seed(0))
    return TensorDict({COND: cond}, batch)


def test_a_custom_planner_decides_per_observation_and_the_engine_obeys(network, ddpm, query):
    noise, cond = query
    cond[1, 1] = cond[1, 0]
    planner = RestAtRest(threshold=1e-3)
    planner.bind(SPEC)
    mask = planner(TensorDict({COND: cond}, [5]))[PRUNE_MASK]
    assert mask.any(dim=(1, 2)).tolist() == [False, True, False, False, False]
    pruned = denoise(network, ddpm, noise, cond, mask, reuse=planner.reuse)
    dense = denoise(network, ddpm, noise, cond)
    changed = (pruned - dense).abs().amax(dim=(1, 2)) > 1e-4
    assert changed.tolist() == [False, True, False, False, False]


@pytest.mark.parametrize("planner", [Dense(), RestAtRest(3.0)], ids=["static", "custom"])
@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3), (0,)])
def test_any_batch_shape_gives_each_observation_its_own_mask(planner, batch):
    planner.bind(SPEC)
    td = planner(observations(*batch))
    assert td[PRUNE_MASK].shape == (*batch, NUM_STEPS, 3 * NUM_LAYERS)
    assert td[PRUNE_MASK].dtype == torch.bool
    for index in torch.ones(batch).nonzero().tolist():
        alone = planner(observations(*batch)[tuple(index)])
        assert torch.equal(alone[PRUNE_MASK], td[tuple(index)][PRUNE_MASK])


def test_keys_are_declared():
    assert list(Dense().in_keys) == [COND]
    assert list(RestAtRest(1.0).out_keys) == [PRUNE_MASK]


def test_a_reuse_that_is_no_rule_is_refused():
    planner = RestAtRest(1.0)
    planner.reuse = "types"
    with refused("reuse"):
        planner.bind(SPEC)


def test_dense_prunes_nothing_and_its_rows_can_be_written_one_by_one():
    planner = Dense()
    planner.bind(SPEC)
    mask = planner(observations(3))[PRUNE_MASK]
    assert not mask.any()
    mask[0, 1:] = True
    assert not mask[1:].any()
    assert not planner(observations(3))[PRUNE_MASK].any()


@pytest.mark.parametrize(
    ("masks", "entry"),
    [
        (torch.zeros(3, NUM_STEPS, 6), "Returns.masks: prune mask"),
        (torch.zeros(1, NUM_STEPS, 6, dtype=torch.bool), "Returns.masks: prune mask"),
        (torch.zeros(3, NUM_STEPS, 24, dtype=torch.bool), "Returns.masks: prune mask"),
        (None, "Returns.masks: prune mask"),
    ],
)
def test_what_a_planner_returns_is_checked(masks, entry):
    planner = Returns(masks)
    planner.bind(SPEC)
    with refused(entry):
        planner(observations(3))


def test_a_static_mask_is_checked_when_bound_and_a_failure_leaves_the_planner_as_it_was():
    class FirstRow(StaticPlanner):
        def mask(self, spec):
            return torch.arange(spec.num_inference_steps)[:, None].repeat(1, spec.num_blocks) >= 10

    planner = FirstRow()
    planner.bind(PlanSpec(20, NUM_LAYERS, "a policy"))
    before = planner(observations(2))[PRUNE_MASK]

    planner.mask = lambda spec: torch.ones(spec.num_inference_steps, spec.num_blocks, dtype=torch.bool)
    with refused("FirstRow.mask: prune mask"):
        planner.bind(SPEC)
    assert planner.spec.num_inference_steps == 20
    assert torch.equal(planner(observations(2))[PRUNE_MASK], before)


def test_an_unbound_planner_says_so():
    with pytest.raises(RuntimeError, match=r"Dense is not bound: assign it to `policy\.plan`"):
        Dense()(observations(2))


def test_binding_again_serves_the_new_spec():
    planner = Dense()
    planner.bind(SPEC)
    planner.bind(PlanSpec(4, 1, "a policy"))
    assert planner(observations(2))[PRUNE_MASK].shape == (2, 4, 3)


def test_a_bound_planner_travels_between_processes_and_adds_nothing_to_a_checkpoint():
    planner = Dense()
    planner.bind(SPEC)
    copy = pickle.loads(pickle.dumps(planner))
    assert torch.equal(copy(observations(2))[PRUNE_MASK], planner(observations(2))[PRUNE_MASK])
    assert planner.state_dict() == {}


def test_a_fingerprint_is_of_names_and_bytes_of_any_type():
    values = {"b": torch.tensor(2), "a": torch.tensor([[1.5, -2.0]]).T}
    parts = [b"a", values["a"].numpy().tobytes(), b"b", values["b"].numpy().tobytes()]
    assert tensors_fingerprint(values) == hashlib.sha256(b"".join(parts)).hexdigest()[:16]
    half = {name: value.bfloat16() for name, value in values.items()}
    assert tensors_fingerprint(half) == tensors_fingerprint(dict(reversed(half.items())))
    assert tensors_fingerprint(half) != tensors_fingerprint({**half, "b": half["b"] + 1})
