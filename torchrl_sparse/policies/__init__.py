"""Policies: TensorDict modules composed of a network, a plan and an engine."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
