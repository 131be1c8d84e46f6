"""Vision towers: patch features of two encoders, concatenated and projected to visual tokens (Prismatic, arXiv:2402.07865)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.networks.vla import backbones
from torchrl_sparse.networks.vla.config import VLAConfig

__all__ = ["FusedProjector", "VisionTowers", "center_crop"]

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def center_crop(images: Tensor, area: float) -> Tensor:
    """Crop each image to its central ``area`` (a share) and resize it to the full size, bilinearly, with rounding.

    Args:
        images: u8 [B, 3, h, w].

    Examples:
        >>> image = torch.arange(64, dtype=torch.uint8).reshape(1, 1, 8, 8).expand(1, 3, 8, 8)
        >>> center_crop(image, 1.0) is image, int(center_crop(image, 0.25).min()) > 0
        (True, True)
    """
    if area == 1.0:
        return images
    side = area**0.5
    axes = [torch.linspace(-side, side, size, device=images.device) for size in images.shape[-2:]]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], dim=-1).expand(len(images), -1, -1, -1)
    cropped = functional.grid_sample(images.float() / 255, grid, align_corners=True)
    # TensorFlow's float-to-integer rule, by which the published checkpoints were trained
    return (cropped * 255.5).clamp(0, 255).to(torch.uint8)


class VisionTowers(nn.Module):
    """Patch encoder of DINOv2 (with registers) and SigLIP, each from its second-to-last layer without a final norm.

    The last layer is not built, since nothing reads it.
    """

    def __init__(self, config: VLAConfig):
        super().__init__()
        shape = {"image_size": config.image_size, "patch_size": config.patch_size}
        self.dino = backbones.Dinov2WithRegistersModel(
            backbones.Dinov2WithRegistersConfig(
                hidden_size=config.dino.dim,
                num_hidden_layers=config.dino.layers - 1,
                num_attention_heads=config.dino.heads,
                mlp_ratio=config.dino.mlp // config.dino.dim,
                num_register_tokens=config.registers,
                **shape,
            )
        )
        self.dino.layernorm = nn.Identity()
        self.siglip = backbones.SiglipVisionModel(
            backbones.SiglipVisionConfig(
                hidden_size=config.siglip.dim,
                num_hidden_layers=config.siglip.layers - 1,
                num_attention_heads=config.siglip.heads,
                intermediate_size=config.siglip.mlp,
                hidden_act="gelu",
                vision_use_head=False,
                **shape,
            )
        )
        self.siglip.post_layernorm = nn.Identity()
        # The constants of both libraries are made for weights that are loaded: beside what a patch shows, its place would be a
        # fiftieth of a token, too little to learn from where things are.
        nn.init.normal_(self.dino.embeddings.position_embeddings)
        nn.init.normal_(self.siglip.embeddings.position_embedding.weight)
        self._prefix = 1 + config.registers

    def forward(self, images: Tensor) -> Tensor:
        """Return the features [B, patches, dino.dim + siglip.dim] of images u8 [B, 3, h, w]."""
        dtype = next(self.parameters()).dtype
        pixels = images.float() / 255
        mean, std = (pixels.new_tensor(value)[:, None, None] for value in (_IMAGENET_MEAN, _IMAGENET_STD))
        dino = self.dino(((pixels - mean) / std).to(dtype)).last_hidden_state[:, self._prefix :]
        siglip = self.siglip((2 * pixels - 1).to(dtype)).last_hidden_state
        return torch.cat([dino, siglip], dim=-1)


class FusedProjector(nn.Module):
    """Projector of patch features to the decoder's width: three linear layers with GELU between them."""

    def __init__(self, config: VLAConfig):
        super().__init__()
        features = config.dino.dim + config.siglip.dim
        self.fc1 = nn.Linear(features, 4 * features)
        self.fc2 = nn.Linear(4 * features, config.llm.dim)
        self.fc3 = nn.Linear(config.llm.dim, config.llm.dim)

    def forward(self, features: Tensor) -> Tensor:
        """Project [B, patches, features] to [B, patches, llm.dim]."""
        return self.fc3(functional.gelu(self.fc2(functional.gelu(self.fc1(features)))))
