"""The process: threads, a clock, backends for workers, progress bars and signals to stop."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
