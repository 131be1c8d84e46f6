from .backends import backend_runtime as backend_runtime
from .clock import synchronised_clock as synchronised_clock
from .interrupt import StopSignal as StopSignal
from .progress import progress as progress
from .threads import num_threads as num_threads
