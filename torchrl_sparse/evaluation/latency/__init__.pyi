from .measure import (
    Latency as Latency,
    Machine as Machine,
    describe_machine as describe_machine,
    measure_latency as measure_latency,
    summarize_latency as summarize_latency,
)
from .queries import (
    time_planning as time_planning,
    time_queries as time_queries,
)
