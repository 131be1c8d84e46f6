from .engine import TorchEngine as TorchEngine
