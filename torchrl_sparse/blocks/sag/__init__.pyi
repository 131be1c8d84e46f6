from .network import PrunerNetwork as PrunerNetwork
from .planner import (
    PrunerInfo as PrunerInfo,
    SAGPruner as SAGPruner,
)
