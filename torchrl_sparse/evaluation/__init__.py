"""Paired evaluation: shared seeds, intervals and verdicts, latency, ``results.json``, figures, videos."""

from torchrl_sparse.evaluation.figures.plots import (
    plot_error_surge,
    plot_pareto,
    plot_schedule,
    plot_similarity,
)
from torchrl_sparse.evaluation.figures.tokens import (
    draw_tokens,
    plot_control,
    plot_token_strip,
    plot_tokens_per_layer,
)
from torchrl_sparse.evaluation.figures.video import Caption, write_video
from torchrl_sparse.evaluation.latency.measure import (
    Latency,
    describe_machine,
    measure_latency,
    summarize_latency,
)
from torchrl_sparse.evaluation.results.report import (
    MethodRun,
    build_results,
    format_pairs,
    format_table,
    load_results,
    save_results,
)
from torchrl_sparse.evaluation.results.schema import validate_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult, totals
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.evaluation.statistics.fidelity import action_error, block_errors
from torchrl_sparse.evaluation.statistics.intervals import (
    episodes_needed,
    paired_difference,
    tango_interval,
    verdict,
    wilson_interval,
)

__all__ = [
    "Caption",
    "EpisodeLog",
    "EpisodeResult",
    "Latency",
    "MethodRun",
    "action_error",
    "block_errors",
    "build_results",
    "describe_machine",
    "draw_tokens",
    "episodes_needed",
    "format_pairs",
    "format_table",
    "load_results",
    "measure_latency",
    "paired_difference",
    "plot_control",
    "plot_error_surge",
    "plot_pareto",
    "plot_schedule",
    "plot_similarity",
    "plot_token_strip",
    "plot_tokens_per_layer",
    "rollout_episodes",
    "save_results",
    "summarize_latency",
    "tango_interval",
    "totals",
    "validate_results",
    "verdict",
    "wilson_interval",
    "write_video",
]
