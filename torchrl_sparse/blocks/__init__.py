"""Sparsity over (denoising step × block): what to skip (planners) and how it is skipped (engines)."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
