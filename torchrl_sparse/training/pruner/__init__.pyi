from .config import PrunerConfig as PrunerConfig
from .export import export_planner as export_planner
from .fit import fit_to_masks as fit_to_masks
from .gates import make_gates as make_gates
from .trainer import PrunerTrainer as PrunerTrainer
