"""Calibration sets: what their targets are, what joins them, and the file that they are kept in."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, keys
from torchrl_sparse.training.diffusion.targets import add_queries, load_targets, make_targets, save_targets


@pytest.fixture
def policy(make_network, demos):
    normalizer = Normalizer.fit(demos.data[keys.STATE], demos.data[keys.ACTION])
    return DiffusionPolicy(make_network(), normalizer, sampler=Sampler("ddim", 10))


@pytest.fixture
def targets(policy, demos):
    return make_targets(policy, demos, share=0.5, n_action_steps=4)


def test_targets_are_what_the_dense_policy_answers(policy, demos, targets):
    assert len(targets) == round(0.5 * len(demos.window_rows(policy.horizon, policy.n_obs_steps, 4)))
    noise = policy.sample_noise(targets[keys.SEED].squeeze(-1))
    torch.testing.assert_close(
        targets["target"], policy.denoise(noise, targets[keys.COND]), rtol=0, atol=1e-5
    )
    assert targets[keys.SEED].unique().numel() == len(targets)


def test_targets_from_data_are_what_was_demonstrated(policy, demos):
    targets = make_targets(policy, demos, share=1.0, source="data", n_action_steps=4)
    windows = demos.windows(demos.window_rows(policy.horizon, policy.n_obs_steps, 4), policy.n_obs_steps)
    demonstrated = policy.normalizer.normalize_action(windows[keys.ACTION])
    assert torch.equal(targets["target"].sum((1, 2)).sort().values, demonstrated.sum((1, 2)).sort().values)


def test_queries_join_targets_with_the_dense_answers(policy, targets):
    queries = TensorDict(
        {
            keys.COND: torch.randn(5, policy.n_obs_steps, policy.network.cond_dim),
            keys.SEED: torch.arange(5)[:, None],
        },
        [5],
    )
    joined = add_queries(policy, targets, queries)
    assert len(joined) == len(targets) + 5
    dense = policy.denoise(policy.sample_noise(torch.arange(5)), queries[keys.COND])
    for expected, row in zip(dense, range(5), strict=True):
        (found,) = (joined[keys.SEED] == row).squeeze(-1).nonzero().flatten()
        assert torch.allclose(joined["target"][found], expected, atol=1e-5)
    kept = torch.isin(joined["target"].sum((1, 2)), targets["target"].sum((1, 2)))
    assert kept.sum() == len(targets)


def test_targets_are_kept_in_a_file_for_what_they_were_made_for(targets, tmp_path):
    path, made_for = tmp_path / "targets.safetensors", {"policy": "one", "share": 0.5}
    save_targets(path, targets, made_for)
    loaded = load_targets(path, made_for)
    assert set(loaded.keys(True, True)) == set(targets.keys(True, True))
    assert (loaded == targets).all()
    with refused("targets.safetensors"):
        load_targets(path, {**made_for, "policy": "two"})
    path.write_bytes(path.read_bytes()[:-10])
    with refused("targets.safetensors"):
        load_targets(path, made_for)


@pytest.mark.parametrize("share", [0.0, 0.001, 1.5])
def test_an_empty_calibration_set_is_refused(policy, demos, share):
    with refused("share"):
        make_targets(policy, demos, share=share, n_action_steps=4)


def test_targets_of_a_policy_with_cameras_are_of_what_these_show(make_image_policy, make_image_demos):
    policy = make_image_policy()
    demos = make_image_demos(policy)
    targets = make_targets(policy, demos, share=1.0, n_action_steps=4)
    assert targets[keys.COND].shape == (len(targets), 2, 128 + 3)
    states = policy.normalizer.normalize_state(demos.data[keys.STATE])
    with torch.no_grad():
        for query in targets[::5]:
            rows = [(states == step).all(dim=1).nonzero().item() for step in query[keys.COND][:, 128:]]
            seen = policy.vision(
                {name: demos.data["observation", name][rows] for name in policy.vision.cameras}
            )
            torch.testing.assert_close(query[keys.COND][:, :128], seen, rtol=0, atol=1e-5)
