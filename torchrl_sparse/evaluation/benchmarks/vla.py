"""A benchmark of a vision-language-action policy: methods that match each other, and what is measured of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.control.queries import answer
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense
from torchrl_sparse.evaluation.figures.tokens import plot_tokens_per_layer
from torchrl_sparse.evaluation.latency.measure import measure_latency
from torchrl_sparse.evaluation.results.report import MethodRun
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, token_totals
from torchrl_sparse.evaluation.rollouts.vla_methods import TokenMethod, matching_share, mid_episode_query
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.vla.token_budget import replay
