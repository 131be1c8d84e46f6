"""Checkpoints in the published layout: a policy from PyTorch's own modules, saved as the published code saves it.

Names and shapes are those of methods that others read from the published code; nothing here uses the library.
"""

import copy
import math

import dill
import torch
from diffusers import DDPMScheduler
from omegaconf import OmegaConf
from torch import nn


def sinusoidal(timestep, width):
    frequency = torch.exp(torch.arange(width // 2) * -(math.log(10000) / (width // 2 - 1)))
    angle = timestep[:, None] * frequency
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class PublishedTransformer(nn.Module):
    def __init__(self, action_dim, cond_dim, horizon, n_obs_steps, n_layer, n_head, n_emb):
        super().__init__()
        self._dummy_variable = nn.Parameter(torch.empty(0))
        self.input_emb = nn.Linear(action_dim, n_emb)
        self.pos_emb = nn.Parameter(torch.zeros(1, horizon, n_emb))
        self.cond_obs_emb = nn.Linear(cond_dim, n_emb)
        self.cond_pos_emb = nn.Parameter(torch.zeros(1, 1 + n_obs_steps, n_emb))
        self.encoder = nn.Sequential(nn.Linear(n_emb, 4 * n_emb), nn.Mish(), nn.Linear(4 * n_emb, n_emb))
        layer = nn.TransformerDecoderLayer(
            n_emb, n_head, 4 * n_emb, dropout=0.3, activation="gelu", batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, n_layer)
        self.ln_f = nn.LayerNorm(n_emb)
        self.head = nn.Linear(n_emb, action_dim)
        self.register_buffer("mask", nn.Transformer.generate_square_subsequent_mask(horizon))
        rows, columns = torch.arange(horizon)[:, None], torch.arange(1 + n_obs_steps)
        hidden = torch.zeros(horizon, 1 + n_obs_steps).masked_fill(rows < columns - 1, float("-inf"))
        self.register_buffer("memory_mask", hidden)

    def forward(self, sample, timestep, cond):
        timestep = torch.as_tensor(timestep).expand(len(sample))
        time_token = sinusoidal(timestep, self.pos_emb.shape[-1])[:, None]
        memory = self.encoder(torch.cat([time_token, self.cond_obs_emb(cond)], 1) + self.cond_pos_emb)
        x = self.input_emb(sample) + self.pos_emb
        x = self.decoder(x, memory, tgt_mask=self.mask, memory_mask=self.memory_mask)
        return self.head(self.ln_f(x))


class Field(nn.Module):
    """One entry of the published normaliser: a ParameterDict within a ParameterDict."""

    def __init__(self, scale, offset):
        super().__init__()
        self.scale, self.offset = nn.Parameter(scale), nn.Parameter(offset)
        self.input_stats = nn.ParameterDict(
            {name: torch.zeros_like(scale) for name in ("min", "max", "mean", "std")}
        )


class LowDimPolicy(nn.Module):
    """``DiffusionTransformerLowdimPolicy``: what is in its state dict, and its arithmetic."""

    def __init__(
        self, obs_dim=19, action_dim=10, horizon=10, n_obs_steps=2, n_layer=2, n_head=4, n_emb=32, seed=0
    ):
        super().__init__()
        torch.manual_seed(seed)
        self.sizes = {
            "obs_dim": obs_dim,
            "action_dim": action_dim,
            "horizon": horizon,
            "n_obs_steps": n_obs_steps,
        }
        self.sizes |= {"n_layer": n_layer, "n_head": n_head, "n_emb": n_emb}
        self._dummy_variable = nn.Parameter(torch.empty(0))
        self.model = PublishedTransformer(action_dim, obs_dim, horizon, n_obs_steps, n_layer, n_head, n_emb)
        self.mask_generator = nn.Module()
        self.mask_generator._dummy_variable = nn.Parameter(torch.empty(0))
        self.normalizer = nn.Module()
        fields = {
            "obs": Field(torch.full((obs_dim,), 0.4), torch.zeros(obs_dim)),
            "action": Field(torch.rand(action_dim) + 0.5, torch.randn(action_dim) / 10),
        }
        self.normalizer.params_dict = nn.ModuleDict(fields)
        make_blocks_matter(self.model)
        self.eval().requires_grad_(False)

    def cond(self, obs):
        field = self.normalizer.params_dict["obs"]
        return obs * field.scale + field.offset

    def unnormalize(self, action):
        field = self.normalizer.params_dict["action"]
        return (action - field.offset) / field.scale

    def chain(self, noise, cond):
        return chain(self.model, noise, cond)


def chain(model, noise, cond):
    """The normalised chunk [B, H, A]; noise [B, K, H, A] holds the first sample and what each step adds."""
    scheduler = DDPMScheduler(
        100, beta_schedule="squaredcos_cap_v2", variance_type="fixed_small", clip_sample=True
    )
    scheduler.set_timesteps(100)
    sample = noise[:, 0]
    for step, timestep in enumerate(scheduler.timesteps):
        eps = model(sample, timestep, cond)
        # diffusers draws the noise of a step itself, so its equation is written out to hand it in.
        mean, spread = ddpm_mean_and_spread(scheduler, eps, int(timestep), sample)
        sample = mean if timestep == 0 else mean + spread * noise[:, step + 1]
    return sample


def make_blocks_matter(module):
    """The published initialisation leaves blocks that hardly change anything."""
    for name, parameter in module.named_parameters():
        if parameter.ndim > 1:
            nn.init.normal_(parameter, std=0.1)
        elif parameter.numel() and "norm" not in name and "ln_f" not in name:
            nn.init.normal_(parameter, std=0.05)


def ddpm_mean_and_spread(scheduler, eps, timestep, sample):
    """Equation 7 of arXiv:2006.11239 with the clean sample clipped, as diffusers evaluates it."""
    abar = scheduler.alphas_cumprod[timestep]
    abar_prev = scheduler.alphas_cumprod[timestep - 1] if timestep > 0 else torch.tensor(1.0)
    alpha = abar / abar_prev
    clean = ((sample - (1 - abar).sqrt() * eps) / abar.sqrt()).clamp(-1, 1)
    mean = abar_prev.sqrt() * (1 - alpha) / (1 - abar) * clean
    mean = mean + alpha.sqrt() * (1 - abar_prev) / (1 - abar) * sample
    variance = ((1 - abar_prev) / (1 - abar) * (1 - alpha)).clamp(min=1e-20)
    return mean, variance.sqrt()


LOW_DIM_CONFIG = """
name: train_diffusion_transformer_lowdim
_target_: diffusion_policy.workspace.train_diffusion_transformer_lowdim_workspace.Workspace
obs_dim: ${task.obs_dim}
action_dim: ${task.action_dim}
n_action_steps: 8
n_latency_steps: 0
obs_as_cond: true
pred_action_steps_only: false
task:
  name: lift_lowdim
  abs_action: true
  obs_keys: [object, robot0_eef_pos, robot0_eef_quat, robot0_gripper_qpos]
  env_runner:
    max_steps: ${eval:'500 if "${task.dataset_type}" == "mh" else 400'}
policy:
  _target_: diffusion_policy.policy.diffusion_transformer_lowdim_policy.DiffusionTransformerLowdimPolicy
  model:
    _target_: diffusion_policy.model.diffusion.transformer_for_diffusion.TransformerForDiffusion
    input_dim: ${eval:'${action_dim} if ${obs_as_cond} else ${obs_dim} + ${action_dim}'}
    output_dim: ${policy.model.input_dim}
    horizon: ${horizon}
    n_obs_steps: ${n_obs_steps}
    cond_dim: ${eval:'${obs_dim} if ${obs_as_cond} else 0'}
    p_drop_emb: 0.0
    p_drop_attn: 0.3
    causal_attn: true
    time_as_cond: true
    obs_as_cond: ${obs_as_cond}
    n_cond_layers: 0
  noise_scheduler:
    _target_: diffusers.schedulers.scheduling_ddpm.DDPMScheduler
    num_train_timesteps: 100
    beta_start: 0.0001
    beta_end: 0.02
    beta_schedule: squaredcos_cap_v2
    variance_type: fixed_small
    clip_sample: true
    prediction_type: epsilon
  n_action_steps: ${n_action_steps}
  num_inference_steps: 100
  obs_as_cond: ${obs_as_cond}
  pred_action_steps_only: ${pred_action_steps_only}
training:
  device: cuda:0
  use_ema: true
logging:
  id: null
  name: ${now:%Y.%m.%d-%H.%M.%S}_${name}
  tags: ["${name}", default]
"""


def low_dim_config(policy):
    config = OmegaConf.create(LOW_DIM_CONFIG)
    sizes = policy.sizes
    config.horizon, config.n_obs_steps = sizes["horizon"], sizes["n_obs_steps"]
    config.task.obs_dim, config.task.action_dim = sizes["obs_dim"], sizes["action_dim"]
    for name in ("n_layer", "n_head", "n_emb"):
        config.policy.model[name] = sizes[name]
    return config


def make_payload(policy, config):
    """What the published workspace saves; the raw weights differ from the averaged ones."""
    raw = copy.deepcopy(policy)
    for parameter in raw.model.parameters():
        parameter.add_(0.1)
    optimizer = torch.optim.AdamW(raw.model.parameters())
    optimizer.state = {
        p: {"step": torch.tensor(3.0), "exp_avg": torch.zeros_like(p)} for p in raw.model.parameters()
    }
    states = {
        "model": raw.state_dict(),
        "ema_model": policy.state_dict(),
        "optimizer": optimizer.state_dict(),
    }
    counters = {"_output_dir": "data/outputs/run", "global_step": 1234, "epoch": 650}
    return {"cfg": config, "state_dicts": states, "pickles": {k: dill.dumps(v) for k, v in counters.items()}}


def write_checkpoint(path, policy, *, change=None, make_config=low_dim_config):
    """Saves ``policy`` as published; ``change`` edits the payload before."""
    payload = make_payload(policy, make_config(policy))
    if change is not None:
        change(payload)
    torch.save(payload, path, pickle_module=dill)
    return path


def put_config(path, value):
    """A change of a checkpoint's payload: the entry ``path`` of its configuration becomes ``value``."""

    def change(payload):
        node = payload["cfg"]
        *parents, last = path.split(".")
        for key in parents:
            node = node[key]
        node[last] = value

    return change
