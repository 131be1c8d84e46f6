from .noise import (
    query_seed as query_seed,
    sample_noise as sample_noise,
)
from .sampler import Sampler as Sampler
from .transformer import TransformerForDiffusion as TransformerForDiffusion
from .vision import VisionEncoder as VisionEncoder
