from .diffusion import (
    Sampler as Sampler,
    TransformerForDiffusion as TransformerForDiffusion,
    VisionEncoder as VisionEncoder,
)
from .normalize import Normalizer as Normalizer
