"""Sparse, fast robot policies as TensorDictModules for TorchRL.

Importing the package is light: each name is imported from its module on first use, so simulators are loaded only by the code
that needs them. As in every package here, ``__init__.pyi`` lists the names, for editors and for the import alike.
"""

import lazy_loader as lazy

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
