"""Methods by name: a table says how each is made, what controls it, and its colour in figures."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
