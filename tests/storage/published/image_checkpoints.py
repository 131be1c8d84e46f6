"""Image checkpoints in the published layout: robomimic's encoder under its own names, beside the published denoiser."""

import torch
from omegaconf import OmegaConf
from torch import nn
from torch.nn import functional as F

from .checkpoints import LOW_DIM_CONFIG, Field, PublishedTransformer, chain, make_blocks_matter

LIFT = {
    "agentview_image": [3, 84, 84],
    "robot0_eye_in_hand_image": [3, 84, 84],
    "robot0_eef_pos": [3],
    "robot0_eef_quat": [4],
    "robot0_gripper_qpos": [2],
}
TRANSPORT = {
    "shouldercamera0_image": [3, 84, 84],
    "robot0_eye_in_hand_image": [3, 84, 84],
    "robot0_eef_pos": [3],
    "shouldercamera1_image": [3, 84, 84],
    "robot1_eye_in_hand_image": [3, 84, 84],
    "robot1_eef_pos": [3],
}


class Residual(nn.Module):
    def __init__(self, before, after, stride):
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, 1, bias=False)
        self.bn1 = nn.GroupNorm(after // 16, after)
        self.conv2 = nn.Conv2d(after, after, 3, 1, 1, bias=False)
        self.bn2 = nn.GroupNorm(after // 16, after)
        if stride > 1:
            norm = nn.GroupNorm(after // 16, after)
            self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), norm)

    def forward(self, x):
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(y + (self.downsample(x) if hasattr(self, "downsample") else x))


class Backbone(nn.Module):
    def __init__(self, width):
        super().__init__()
        stages, before = [], width
        for index, after in enumerate([width, 2 * width, 4 * width, 8 * width]):
            stages.append(
                nn.Sequential(Residual(before, after, 1 if index == 0 else 2), Residual(after, after, 1))
            )
            before = after
        stem = [nn.Conv2d(3, width, 7, 2, 3, bias=False), nn.GroupNorm(width // 16, width), nn.ReLU()]
        self.nets = nn.Sequential(*stem, nn.MaxPool2d(3, 2, 1), *stages)

    def forward(self, x):
        return self.nets(x)


class Pool(nn.Module):
    def __init__(self, channels, size):
        super().__init__()
        self.temperature = nn.Parameter(torch.ones(1), requires_grad=False)
        pos_y, pos_x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
        self.register_buffer("pos_x", pos_x.reshape(1, -1))
        self.register_buffer("pos_y", pos_y.reshape(1, -1))
        self.nets = nn.Conv2d(channels, 32, 1)

    def forward(self, x):
        flat = self.nets(x).flatten(2).flatten(0, 1)
        attention = F.softmax(flat / self.temperature, dim=-1)
        x_mean = (self.pos_x * attention).sum(1, keepdim=True)
        y_mean = (self.pos_y * attention).sum(1, keepdim=True)
        return torch.cat([x_mean, y_mean], 1).view(-1, 32, 2)


class VisualCore(nn.Module):
    """Every part is registered under two names, as in robomimic."""

    def __init__(self, width, crop):
        super().__init__()
        self.crop = crop
        self.backbone, self.pool = Backbone(width), Pool(8 * width, -(-crop // 32))
        self.nets = nn.Sequential(self.backbone, self.pool, nn.Flatten(1), nn.Linear(64, 64))

    def forward(self, images):
        margin = (images.shape[-1] - self.crop) // 2
        images = images[..., margin : margin + self.crop, margin : margin + self.crop]
        return F.relu(self.nets(images))


class ImagePolicy(nn.Module):
    """``DiffusionTransformerHybridImagePolicy``: what is in its state dict, and its arithmetic."""

    def __init__(self, shape_meta=LIFT, width=16, crop=76, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.shape_meta, self.crop = shape_meta, crop
        self.images = [key for key, shape in shape_meta.items() if len(shape) == 3]
        self.states = [key for key in shape_meta if key not in self.images]
        features = 64 * len(self.images) + sum(shape_meta[key][0] for key in self.states)
        self.obs_encoder = nn.Module()
        self.obs_encoder.obs_nets = nn.ModuleDict({key: VisualCore(width, crop) for key in self.images})
        self.model = PublishedTransformer(10, features, 10, 2, 2, 4, 32)
        self.normalizer = nn.Module()
        fields = {
            key: Field(torch.rand(shape[0]) + 0.5, torch.randn(shape[0])) for key, shape in shape_meta.items()
        }
        fields |= {key: Field(torch.tensor([2.0]), torch.tensor([-1.0])) for key in self.images}
        fields["action"] = Field(torch.rand(10) + 0.5, torch.randn(10) / 10)
        self.normalizer.params_dict = nn.ModuleDict(fields)
        make_blocks_matter(self.model)
        for core in self.obs_encoder.obs_nets.values():  # keypoints that move with the picture
            nn.init.normal_(core.pool.nets.weight, std=0.5)
        self.eval().requires_grad_(False)

    def cond(self, observations):
        """[B, To, D] of robomimic's observations; images are in [0, 1]."""
        parts = []
        for key in self.shape_meta:
            field = self.normalizer.params_dict[key]
            value = observations[key] * field.scale + field.offset
            if key in self.images:
                value = self.obs_encoder.obs_nets[key](value.flatten(0, 1)).unflatten(0, value.shape[:2])
            parts.append(value)
        return torch.cat(parts, -1)

    def unnormalize(self, action):
        field = self.normalizer.params_dict["action"]
        return (action - field.offset) / field.scale

    def chain(self, noise, cond):
        return chain(self.model, noise, cond)


def image_config(policy):
    config = OmegaConf.create(LOW_DIM_CONFIG)
    model = config.policy.pop("model")
    for name in ("p_drop_emb", "p_drop_attn", "causal_attn", "time_as_cond", "obs_as_cond", "n_cond_layers"):
        config.policy[name] = OmegaConf.to_container(model)[name]
    obs = {
        key: {"shape": shape, **({"type": "rgb"} if len(shape) == 3 else {})}
        for key, shape in policy.shape_meta.items()
    }
    config.task = {
        "name": "lift_image",
        "abs_action": True,
        "shape_meta": {"obs": obs, "action": {"shape": [10]}},
    }
    config.shape_meta = "${task.shape_meta}"
    config.horizon, config.n_obs_steps = 10, 2
    config.policy.update(
        {
            "_target_": "diffusion_policy.policy.diffusion_transformer_hybrid_image_policy."
            "DiffusionTransformerHybridImagePolicy",
            "shape_meta": "${shape_meta}",
            "n_action_steps": "${eval:'${n_action_steps}+${n_latency_steps}'}",
            "crop_shape": [policy.crop, policy.crop],
            "obs_encoder_group_norm": True,
            "eval_fixed_crop": True,
            "n_head": 4,
        }
    )
    del config.policy["pred_action_steps_only"]
    return config
