"""From a slow policy to the fastest one that is still right: candidates, stages, the choice, and what is handed over."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
