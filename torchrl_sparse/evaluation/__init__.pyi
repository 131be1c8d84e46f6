from .figures import (
    Caption as Caption,
    draw_tokens as draw_tokens,
    plot_control as plot_control,
    plot_error_surge as plot_error_surge,
    plot_pareto as plot_pareto,
    plot_schedule as plot_schedule,
    plot_similarity as plot_similarity,
    plot_token_strip as plot_token_strip,
    plot_tokens_per_layer as plot_tokens_per_layer,
    write_report as write_report,
    write_video as write_video,
)
from .latency import (
    Latency as Latency,
    Machine as Machine,
    describe_machine as describe_machine,
    measure_latency as measure_latency,
    summarize_latency as summarize_latency,
)
from .results import (
    MethodEntry as MethodEntry,
    MethodRun as MethodRun,
    PolicyShape as PolicyShape,
    Results as Results,
    build_results as build_results,
    format_table as format_table,
    load_results as load_results,
    save_results as save_results,
)
from .rollouts import (
    EpisodeLog as EpisodeLog,
    EpisodeResult as EpisodeResult,
    rollout_episodes as rollout_episodes,
    totals as totals,
)
from .rollouts.evaluate import (
    evaluate as evaluate,
    success_rate as success_rate,
)
from .statistics import (
    action_error as action_error,
    block_errors as block_errors,
    episodes_needed as episodes_needed,
    paired_difference as paired_difference,
    tango_interval as tango_interval,
    verdict as verdict,
    wilson_interval as wilson_interval,
)
