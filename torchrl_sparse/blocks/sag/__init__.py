"""Sparse ActionGen (SAG, arXiv:2601.12894): a learned planner that reads the observation."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
