"""Paired episodes: the same initial states and the same noise for every method."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
