"""Intervals and verdicts for paired episodes, and errors relative to dense actions."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
