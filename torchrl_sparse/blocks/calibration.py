"""Calibration: per-block statistics of dense policy calls, from which BAC derives its schedules.

They measure the similarity of a block's outputs between denoising steps (BAC, arXiv:2506.13456, Fig. 1), and how much
they vary in all. Few calls suffice: within a task the similarities hardly depend on the episode (its Fig. 7).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import BLOCK_TYPES, Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["Calibration", "block_error", "calibrate", "feature_similarity"]


def feature_similarity(features: Tensor) -> Tensor:
    """Return the cosine similarity of a block's outputs between denoising steps (Fig. 1), averaged over samples.

    Args:
        features: outputs of one block [K, B, ...]; each sample is flattened to one vector.

    Returns:
        f64 [K, K], symmetric; a sample whose output is all zero counts as 0.

    >>> feature_similarity(torch.tensor([[[1.0, 0.0]], [[0.0, 2.0]], [[3.0, 0.0]]])).tolist()
    [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]
    """
    directions = torch.nn.functional.normalize(features.double().flatten(2), dim=-1)
    return torch.einsum("tbd,ubd->tu", directions, directions) / features.shape[1]


def block_error(features: Tensor) -> Tensor:
    """Return the error score of a block, ``l = 1/K² Σ_t Σ_u ‖X^t − X^u‖₁`` (BUA, phase 1), averaged over samples.

    Args:
        features: outputs of one block [K, B, ...].

    Returns:
        f64 scalar.

    >>> block_error(torch.tensor([[[0.0, 0.0]], [[1.0, 1.0]]])).item()
    1.0
    """
    samples = features.double().flatten(2).transpose(0, 1)
    return torch.cdist(samples, samples, p=1).mean()


@dataclass(frozen=True)
class Calibration:
    """Feature similarities and error scores of a policy's blocks.

    Attributes:
        similarity: f64 [3L, K, K], see :func:`feature_similarity`.
        errors: f64 [3L], see :func:`block_error`.
        num_samples: policy calls that were averaged.
        sampler: name of the sampler that denoised them; the schedules made from this are for it.
        block_types: blocks of a layer of its network.
    """

    similarity: Tensor
    errors: Tensor
    num_samples: int
    sampler: str = "ddpm"
    block_types: tuple[str, ...] = BLOCK_TYPES


@torch.no_grad()
def calibrate(network: Denoiser, sampler: Sampler, noise: Tensor, cond: Tensor) -> Calibration:
    """Record the block outputs of dense policy calls. The paper uses a single call; several average out its noise.

    Args:
        network: the denoiser, in eval mode.
        sampler: the denoising steps, K of them.
        noise: f32 [N, K, H, A], as :func:`~torchrl_sparse.blocks.engine.reference.denoise` takes it.
        cond: encoded observations f32 [N, To, D].

    Raises:
        InputError: if the network is in training mode, there is no sample, or shapes do not fit.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> sampler = Sampler("ddpm", 8)
        >>> calibration = calibrate(network, sampler, torch.randn(2, 8, 4, 7), torch.randn(2, 2, 5))
        >>> calibration.similarity.shape, calibration.errors.shape
        (torch.Size([3, 8, 8]), torch.Size([3]))
    """
    if network.training:
        raise InputError(
            "network: expected eval mode, got training mode (dropout would be part of the features)"
        )
    if len(cond) == 0:
        raise InputError("cond: expected at least one sample, got none")
    similarity, errors = 0, 0
    for sample in range(len(cond)):  # One at a time bounds the memory to the features of one policy call.
        recorder = FeatureRecorder()
        rows = slice(sample, sample + 1)
        denoise(network, sampler, noise[rows], cond[rows], record=recorder)
        blocks = recorder.features()
        similarity = similarity + torch.stack([feature_similarity(block) for block in blocks])
        errors = errors + torch.stack([block_error(block) for block in blocks])
    means = similarity / len(cond), errors / len(cond)
    return Calibration(*means, len(cond), sampler.name, network.block_types)
