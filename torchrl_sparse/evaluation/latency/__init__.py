"""Latency: interleaved measurements, and the benchmark cases of engines."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
