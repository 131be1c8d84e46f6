from .bac import (
    BAC as BAC,
    bac_schedule as bac_schedule,
)
from .calibration import (
    Calibration as Calibration,
    calibrate as calibrate,
)
from .engine import (
    Engine as Engine,
    denoise as denoise,
    make_engine as make_engine,
)
from .planner import (
    Dense as Dense,
    Planner as Planner,
    PlanSpec as PlanSpec,
    StaticPlanner as StaticPlanner,
)
from .sag import (
    PrunerInfo as PrunerInfo,
    PrunerNetwork as PrunerNetwork,
    SAGPruner as SAGPruner,
)
from .saved import (
    PLANNERS as PLANNERS,
    load_planner as load_planner,
    saved_planners as saved_planners,
)
from .schedule import (
    CacheSchedule as CacheSchedule,
    SchedulePlanner as SchedulePlanner,
)
from .uniform import Uniform as Uniform
