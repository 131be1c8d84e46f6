"""Common start-up of every recipe: checked options, a locked output folder, and one-line errors."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
