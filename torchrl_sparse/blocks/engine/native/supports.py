"""The networks and machines that the native engine supports, and the reason for each refusal."""

from __future__ import annotations

import torch

from torchrl_sparse.blocks.engine.native.layout import CONSTANTS
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["native_supports"]

_MAX_OBS_STEPS = CONSTANTS["MAX_OBS_STEPS"]


def native_supports(network: Denoiser) -> tuple[bool, str]:
    """Return whether the native engine can run ``network`` on this machine, and if not, why.

    It needs the compiled library, f32 weights on the CPU, a token-wise condition encoder (``n_cond_layers`` = 0,
    as all published models have), a noise vector as large as an action, and at most 63 observation steps.
    """
    if not isinstance(network, TransformerForDiffusion):
        return False, f"it runs the published transformer, the network is a {type(network).__name__}"
    available, reason = native_available()
    if not available:
        return False, reason
    parameters = list(network.parameters())
    if any(parameter.device.type != "cpu" for parameter in parameters):
        return False, f"it runs on the CPU, the network is on {parameters[0].device}"
    if any(parameter.dtype != torch.float32 for parameter in parameters):
        return False, "it reads float32 weights"
    if network.n_cond_layers > 0:
        return False, f"it needs n_cond_layers = 0, the network has {network.n_cond_layers}"
    if network.output_dim != network.input_dim:
        return False, f"it needs output_dim = input_dim, got {network.output_dim} and {network.input_dim}"
    if network.n_obs_steps > _MAX_OBS_STEPS:
        return False, f"it needs n_obs_steps <= {_MAX_OBS_STEPS}, the network has {network.n_obs_steps}"
    return True, ""
