"""A policy behind openpi's websocket protocol: many robots, one policy call at a time."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
