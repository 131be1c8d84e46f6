"""Methods by name: one table each says how methods are made, controlled and coloured in figures."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
