"""Scripted experts, one file a task, and what their operators do besides what they mean; never human."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
