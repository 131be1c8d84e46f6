"""Scripted experts, one file per task, and the simulated errors of their operators; no human data."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
