"""A policy in files: what comes back, and what is refused."""

import json

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource


@torch.no_grad()
def test_round_trip_at_half_precision(policy, query, tmp_path):
    policy.source = VLASource("LiftNamed", {"image": "sideview_image"})
    policy.save_pretrained(tmp_path)
    again = VLAPolicy.from_pretrained(tmp_path)
    assert again.network.config == policy.network.config
    assert again.tokenizer.words == policy.tokenizer.words
    assert again.source == again.with_pruner(None).source == policy.source
    for name, value in again.network.state_dict().items():
        assert torch.equal(value, policy.network.state_dict()[name].half().float()), name
    torch.testing.assert_close(
        again(query(3))[keys.CHUNK][..., :6], policy(query(3))[keys.CHUNK][..., :6], rtol=0, atol=0.05
    )


def test_one_camera_checkpoint_for_a_two_camera_config(network, tmp_path):
    VLAPolicy(VLANetwork(VLAConfig.tiny(cameras=(keys.IMAGE,)))).save_pretrained(tmp_path)
    with refused("config.json: cameras"):
        VLAPolicy.from_pretrained(tmp_path, config=network.config)


@pytest.mark.parametrize(
    ("field", "value", "entry"),
    [
        ("format", "other", "config.json: format"),
        ("tokenizer", {"kind": "pickle"}, "config.json: tokenizer"),
        ("network", {}, "config.json"),
        ("source", {"cameras": ["image"]}, "config.json: source.cameras"),
        ("source", {"images": "mine"}, "config.json: source.images"),
    ],
)
def test_a_wrong_config_is_named(policy, tmp_path, field, value, entry):
    policy.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, field: value}))
    with refused(entry):
        VLAPolicy.from_pretrained(tmp_path)


def test_other_sizes_than_the_weights_are_named(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    config["network"]["vocab_size"] = 400
    (tmp_path / "config.json").write_text(json.dumps(config))
    with refused("network.decoder.llama.embed_tokens.weight"):
        VLAPolicy.from_pretrained(tmp_path)
