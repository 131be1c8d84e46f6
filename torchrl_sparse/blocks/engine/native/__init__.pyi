from .engine import NativeEngine as NativeEngine
from .library import native_available as native_available
