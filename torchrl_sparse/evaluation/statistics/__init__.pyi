from .fidelity import (
    action_error as action_error,
    block_errors as block_errors,
)
from .intervals import (
    episodes_needed as episodes_needed,
    paired_difference as paired_difference,
    tango_interval as tango_interval,
    verdict as verdict,
    wilson_interval as wilson_interval,
)
