"""The beginning of every recipe: its options checked, its output its own, its errors one line."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
