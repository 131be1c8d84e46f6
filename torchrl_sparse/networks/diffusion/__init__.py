"""The denoiser of Diffusion Policy, the encoder of its cameras, its sampler and its noise."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
