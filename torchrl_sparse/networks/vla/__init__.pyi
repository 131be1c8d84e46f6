from .config import (
    TransformerSize as TransformerSize,
    VLAConfig as VLAConfig,
)
from .hooks import (
    LayerHooks as LayerHooks,
    LayerState as LayerState,
    TokenKind as TokenKind,
    VisualSpec as VisualSpec,
)
from .network import (
    VLANetwork as VLANetwork,
    make_network as make_network,
)
