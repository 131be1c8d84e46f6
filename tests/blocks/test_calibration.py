import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.calibration import block_error, calibrate, feature_similarity
from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise


def test_similarity_is_the_cosine_of_flattened_outputs_averaged_over_samples():
    features = torch.randn(4, 3, 5, 2, generator=torch.Generator().manual_seed(0))
    similarity = feature_similarity(features)
    for t in range(4):
        for u in range(4):
            cosines = torch.cosine_similarity(features[t].flatten(1), features[u].flatten(1), dim=1)
            assert similarity[t, u].item() == pytest.approx(cosines.mean().item(), abs=1e-6)


def test_an_output_of_zero_resembles_nothing():
    features = torch.tensor([[[0.0, 0.0]], [[1.0, 0.0]]])
    assert feature_similarity(features).tolist() == [[0.0, 0.0], [0.0, 1.0]]


def test_block_error_is_the_mean_l1_distance_of_all_pairs_of_steps():
    features = torch.randn(4, 3, 5, 2, generator=torch.Generator().manual_seed(0))
    pairs = [(features[t] - features[u]).abs().sum(dim=(1, 2)).mean() for t in range(4) for u in range(4)]
    assert block_error(features).item() == pytest.approx(torch.stack(pairs).mean().item(), rel=1e-5)


def test_calibration_averages_its_samples(network, sampler, query):
    noise, cond = query
    together = calibrate(network, sampler, noise[:3], cond[:3])
    alone = [calibrate(network, sampler, noise[i : i + 1], cond[i : i + 1]) for i in range(3)]
    assert together.num_samples == 3
    assert together.similarity.shape == (6, 10, 10)
    torch.testing.assert_close(together.similarity, torch.stack([a.similarity for a in alone]).mean(dim=0))
    torch.testing.assert_close(together.errors, torch.stack([a.errors for a in alone]).mean(dim=0))


def test_calibration_measures_the_dense_policy(network, ddpm, query):
    noise, cond = query
    recorder = FeatureRecorder()
    denoise(network, ddpm, noise[:1], cond[:1], record=recorder)
    result = calibrate(network, ddpm, noise[:1], cond[:1])
    for block, features in enumerate(recorder.features()):
        torch.testing.assert_close(result.similarity[block], feature_similarity(features))
        torch.testing.assert_close(result.errors[block], block_error(features))
    diagonal = result.similarity.diagonal(dim1=1, dim2=2)
    torch.testing.assert_close(diagonal, torch.ones_like(diagonal))


def test_calibration_refuses_training_mode_no_samples_and_wrong_shapes(network, ddpm, query):
    noise, cond = query
    with refused("cond"):
        calibrate(network, ddpm, noise[:0], cond[:0])
    with refused("noise"):
        calibrate(network, ddpm, noise[:, :9], cond)
    with refused("network"):
        calibrate(network.train(), ddpm, noise, cond)
