"""Sparsity over (denoising step × block): planners decide what to skip, engines skip it."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
