"""TTS as released (``ky-ji/Test-time-Sparsity``, read and run at commit ab1c72b), around a policy of ours.

The release exchanges the layers of a policy's decoder, and asks its pruner on a CUDA stream while the decoder computes its
first step. On a CPU it would never ask it: `ask_on_cpu` has it asked at the same place.
"""

import contextlib
import copy
import io
from types import SimpleNamespace
from unittest import mock

import torch
from TTSInfer.acceleration.rollout import pruner_warpper_test_stream, pruner_warpper_train
from TTSInfer.pruner.train.transformer_pruner import TransformerPruner, enumerate_decoder_block_keys

COMPUTE, TYPE, BLOCK, RECALL = range(4)
CHOICES = {"type": TYPE, "block": BLOCK}


class ReleasedPolicy:
    """What the release expects a policy to have; queries are ``{"cond": [B, To, D], "noise": [B, K, H, A]}``, normalised."""

    def __init__(self, network, sampler):
        self.model = copy.deepcopy(network).eval().requires_grad_(False)
        self.model.obs_as_cond = True
        self.noise_scheduler = SimpleNamespace(timesteps=sampler.timesteps)
        self.num_inference_steps = sampler.num_inference_steps
        self._sampler = sampler

    def reset(self):
        """What the release notes that an episode begins by."""

    def predict_action(self, query):
        sampler, noise, sample = self._sampler, query["noise"], query["noise"][:, 0]
        for k, timestep in enumerate(sampler.timesteps):
            eps = self.model(sample, timestep, query["cond"])
            drawn = noise[:, k + 1] if k + 1 < sampler.num_inference_steps else None
            sample = sampler.step(eps, k, sample, drawn, ())
        return {"action_pred": sample}


def make_pruner(policy, seed=0):
    """The release's pruner with its sizes for a policy of ours, untrained."""
    torch.manual_seed(seed)
    layers = [f"decoder.layers.{layer}" for layer in range(policy.network.n_layer)]
    return TransformerPruner(
        max_steps=policy.num_inference_steps,
        block_names=enumerate_decoder_block_keys(layers),
        obs_dim=policy.network.n_emb,
        head_4=True,
    )


def released(policy, pruner, *, training=False):
    """Return the release's policy around the networks of ours."""
    made = ReleasedPolicy(policy.network, policy.sampler)
    wrapper = pruner_warpper_train if training else pruner_warpper_test_stream
    wrapper.CachePrunerWrapper.apply(made, pruner=pruner, if_rollout_cache=True, training=training)
    if not training:
        made._cache["worker_streams"] = [None]
    return made


@contextlib.contextmanager
def ask_on_cpu():
    """Runs what the release gives to a CUDA stream in turn, and silences what it prints."""
    with mock.patch.object(torch.cuda, "Event", mock.MagicMock), contextlib.redirect_stdout(io.StringIO()):
        yield


def choices(made, shape):
    """What the release's pruner chose for the last query of one, i64 [K, 3L]."""
    chosen = made._cache["strategy_dict"]
    return torch.tensor([chosen[cell] for cell in range(len(chosen))]).view(shape)
