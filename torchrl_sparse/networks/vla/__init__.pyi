from .config import (
    TransformerSize as TransformerSize,
    VLAConfig as VLAConfig,
)
from .network import (
    VLANetwork as VLANetwork,
    make_network as make_network,
)
from .pruning import (
    LayerState as LayerState,
    TokenKind as TokenKind,
    TokenPruner as TokenPruner,
    VisualSpec as VisualSpec,
)
