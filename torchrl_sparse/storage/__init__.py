"""Files: reading and writing policies, and reading published formats. Nothing in a checkpoint is ever executed."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
