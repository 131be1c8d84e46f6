from .curves import plot_success_within as plot_success_within
from .html_report import write_report as write_report
from .pareto import plot_pareto as plot_pareto
from .plots import (
    plot_error_surge as plot_error_surge,
    plot_schedule as plot_schedule,
    plot_similarity as plot_similarity,
)
from .tokens import (
    draw_tokens as draw_tokens,
    plot_control as plot_control,
    plot_token_strip as plot_token_strip,
    plot_tokens_per_layer as plot_tokens_per_layer,
)
from .video import (
    Caption as Caption,
    write_video as write_video,
)
