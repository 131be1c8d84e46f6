from .benchmark import (
    Benchmark as Benchmark,
    BenchmarkOptions as BenchmarkOptions,
)
from .delayed import RealtimeBenchmark as RealtimeBenchmark
from .diffusion import (
    DiffusionBenchmark as DiffusionBenchmark,
    default_methods as default_methods,
    draw_methods as draw_methods,
    make_methods as make_methods,
    measure_methods as measure_methods,
    settle_rates as settle_rates,
)
from .film import (
    film_masks as film_masks,
    film_tokens as film_tokens,
)
from .rounds import (
    episode_horizon as episode_horizon,
    make_design as make_design,
    play_rounds as play_rounds,
)
from .summary import (
    describe_policy as describe_policy,
    error_to_dense as error_to_dense,
)
