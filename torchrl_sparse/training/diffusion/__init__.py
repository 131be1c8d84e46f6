"""Training of diffusion policies, and the search for a sampler's timesteps."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
