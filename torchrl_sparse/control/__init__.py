"""Controllers between policy and environment: when to call the policy, and which action of a chunk to execute."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
