"""Process utilities: threads, clock, worker backends, progress bars and stop signals."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
