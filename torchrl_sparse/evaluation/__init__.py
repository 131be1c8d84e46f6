"""Paired evaluation on shared seeds: intervals, verdicts, latency, ``results.json``, figures and videos."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
