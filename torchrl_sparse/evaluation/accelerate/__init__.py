"""Search for the fastest method that is non-inferior to the dense policy: candidates, stages, choice, and output."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
