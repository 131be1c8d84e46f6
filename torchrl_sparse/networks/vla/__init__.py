"""The OpenVLA-OFT architecture at any size, and the hooks around its decoder's layers."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
