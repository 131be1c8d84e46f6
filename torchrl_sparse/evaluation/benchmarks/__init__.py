"""Benchmarks: results, figures and films from the episodes, timed policy calls and errors of every method."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
