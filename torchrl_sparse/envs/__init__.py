"""robosuite tasks and other benchmarks of Diffusion Policy as TorchRL environments, and scripted experts for them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
