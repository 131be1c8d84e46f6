from .aggregate import (
    TaskPairs as TaskPairs,
    aggregate_tasks as aggregate_tasks,
)
from .bootstrap import median_ratio_interval as median_ratio_interval
from .durations import (
    restricted_times as restricted_times,
    success_within as success_within,
    time_ratio as time_ratio,
    time_verdict as time_verdict,
)
from .fidelity import (
    action_error as action_error,
    block_errors as block_errors,
)
from .intervals import (
    episodes_needed as episodes_needed,
    mcnemar_p as mcnemar_p,
    paired_difference as paired_difference,
    tango_interval as tango_interval,
    verdict as verdict,
    wilson_interval as wilson_interval,
)
from .multiplicity import holm as holm
from .sequential import Design as Design
