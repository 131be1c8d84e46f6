"""A profile times what its user runs: the policy's weights, steps, words and start, whatever the policy."""

from unittest.mock import MagicMock

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.evaluation.benchmarks import engine_times
from torchrl_sparse.evaluation.latency import profile
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, make_network
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer


def make_policy(sampler, **options):
    network = TransformerForDiffusion(
        input_dim=4, output_dim=4, horizon=6, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=32
    )
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    return DiffusionPolicy(network, normalizer, sampler=sampler, **options)


@pytest.mark.parametrize(("engine", "weights"), [("native_bf16", "bfloat16"), ("auto", "float32")])
def test_the_exported_policy_has_the_weights_of_the_engine_beside_it(monkeypatch, tmp_path, engine, weights):
    """C and Python stand in one table, so both round (`DiffusionPolicy.export`'s ``weights``)."""
    asked = []
    monkeypatch.setattr(profile.ctypes, "CDLL", lambda path: MagicMock(tsp_load=lambda *_: None))
    monkeypatch.setattr(DiffusionPolicy, "export", lambda self, path, *, weights: asked.append(weights))
    with refused("library"):
        profile.exported_call(make_policy(Sampler("ddpm", 4, 4), engine=engine), tmp_path).__enter__()
    assert asked == [weights]


def test_dense_is_the_chain_that_the_policy_was_trained_with(monkeypatch):
    """A policy of 50 training steps and another clip range has no chain of 100 steps clipped at 1 (diffusers' DDPM)."""
    cases = []
    monkeypatch.setattr(engine_times, "EngineCase", lambda *_, dense, **__: cases.append(dense) or _stop())
    policy = make_policy(Sampler("ddim", 10, 50, clip_sample_range=2.0))
    with pytest.raises(InterruptedError):
        engine_times.measure_engines(policy, 1, name="", repeats=1, warmup=0, threads=1)
    (dense,) = cases
    assert (dense.kind, dense.num_inference_steps, dense.clip_sample_range) == ("ddpm", 50, 2.0)


def _stop():
    raise InterruptedError


@pytest.mark.parametrize("steps", [2, 5])
def test_a_small_network_of_few_training_steps_is_timed_too(steps):
    """BAC enlarges the paper's 5 blocks, or all where there are fewer; a mask computes the first step whatever its rate."""
    dense = Sampler("ddpm", steps, steps, clip_sample_range=2.0)
    case = EngineCase(make_network("low_dim", n_layer=1, n_emb=32), 1, dense=dense)
    for query in case.queries.values():
        assert query.sampler.clip_sample_range == 2.0
        assert query.sampler.num_inference_steps <= steps
        assert query.mask is None or not query.mask[:, 0].any()


def test_a_vla_is_told_words_that_it_knows():
    """Words that a small tokenizer does not know are spelled, a token a letter; its task's own are one each."""
    pytest.importorskip("transformers")
    from torchrl_sparse.evaluation.latency.vla_cases import VLACase
    from torchrl_sparse.networks.vla.config import VLAConfig
    from torchrl_sparse.networks.vla.network import VLANetwork
    from torchrl_sparse.networks.vla.text import WordTokenizer
    from torchrl_sparse.policies.vla.policy import VLAPolicy
    from torchrl_sparse.storage.vla import VLASource

    words = ["lift", "red", "green", "blue", "cube"]
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny()), tokenizer=WordTokenizer(words))
    policy.source = VLASource(task="LiftNamed")
    lengths = {
        told: VLACase(policy, {"dense": None}, told).sequence().hidden.shape[1]
        for told in (None, "lift the red cube", "pick up the black bowl")
    }
    assert lengths[None] == lengths["lift the red cube"] < lengths["pick up the black bowl"]
