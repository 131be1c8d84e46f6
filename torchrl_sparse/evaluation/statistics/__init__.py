"""Intervals and verdicts for paired episodes, and errors to the dense answers."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
