"""Parts of a policy call of an image policy."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import Sampler
from torchrl_sparse.evaluation.latency.engine_cases import make_network
from torchrl_sparse.evaluation.latency.stages import example_query, image_policy, stage_seconds

SMALL = {"n_layer": 2, "n_emb": 32}


def test_a_whole_query_of_the_image_shape_is_timed_by_parts():
    torch.manual_seed(0)
    policy = image_policy(make_network("image", **SMALL), width=16)
    policy.sampler = Sampler("ddim", 2)
    query = example_query(policy, batch=2)
    seconds = stage_seconds(policy, query, repeats=2)
    cameras = ["camera image", "camera wrist_image"]
    assert list(seconds) == ["query", "encode", "pixels", *cameras, "denoise", "rest", "encode, plain"]
    assert min(seconds[name] for name in seconds if name != "rest") > 0
    assert seconds["query"] == pytest.approx(seconds["encode"] + seconds["denoise"] + seconds["rest"])
    assert set(query.keys()) == {"history", "episode"}
    assert policy(query)["vla_action", "chunk"].shape[0] == 2


def test_a_condition_without_room_for_features_is_refused():
    with refused("cond_dim"):
        image_policy(make_network("low_dim", **SMALL), width=16)
