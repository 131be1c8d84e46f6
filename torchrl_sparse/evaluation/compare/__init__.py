"""Verdicts on anybody's files of episodes: ours, LeRobot's, vla-eval's, robomimic's, CSV."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
