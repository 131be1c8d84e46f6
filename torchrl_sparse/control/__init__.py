"""Between a policy and an environment: when to call it, and which action of a chunk to play."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
