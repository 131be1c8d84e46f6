"""The substeps of one control step of robosuite in compiled code, bit-equal to its own Python."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
