from .episodes import (
    EpisodeLog as EpisodeLog,
    EpisodeResult as EpisodeResult,
    totals as totals,
)
from .paired import rollout_episodes as rollout_episodes
