"""A policy that adapts a language model: what is trained, what its folder holds, and which base it takes."""

import json

import pytest
import torch
from safetensors.torch import load_file

from tests.fixtures.gguf import SIZES, write_llama
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.adapters import AdaptedLinear, add_adapters, fold_adapters
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.language_model import load_base, read_language_model
from torchrl_sparse.storage.vla import AdaptedBase
from torchrl_sparse.tokens.fastv import FastVPruner

LAYERS = 4 * 7


@pytest.fixture
def base(tmp_path):
    return write_llama(tmp_path / "base.gguf")


@pytest.fixture
def adapted(base):
    """A policy as training makes it; its adapters have learnt something."""
    language = read_language_model(base)
    torch.manual_seed(0)
    network = add_adapters(VLANetwork(VLAConfig.tiny(**language.sizes)), rank=3)
    load_base(network, language)
    for part in network.modules():
        if isinstance(part, AdaptedLinear):
            torch.nn.init.normal_(part.up, std=0.1)
    policy = VLAPolicy(network, tokenizer=language.tokenizer)
    policy.base = AdaptedBase(language.sha256, 3)
    return policy


def half(policy):
    """Round a policy's trained weights as its file does."""
    for parameter in policy.network.parameters():
        if parameter.requires_grad:
            parameter.data = parameter.data.half().float()
    return policy


def test_only_adapters_of_the_decoder_are_trained(adapted):
    trained = {n for n, p in adapted.network.decoder.named_parameters() if p.requires_grad}
    assert len(trained) == 2 * LAYERS
    assert all(name.endswith((".down", ".up")) for name in trained)
    assert all(p.requires_grad for p in adapted.network.vision.parameters())


def test_an_adapter_that_has_learnt_nothing_changes_nothing(query):
    torch.manual_seed(0)
    network = VLANetwork(VLAConfig.tiny(**SIZES)).eval()
    with torch.no_grad():
        before = VLAPolicy(network)(query(3))[keys.CHUNK]
        assert torch.equal(VLAPolicy(add_adapters(network, rank=2))(query(3))[keys.CHUNK], before)


@torch.no_grad()
@pytest.mark.parametrize("pruner", [None, FastVPruner(0.5)])
def test_folded_adapters_do_what_they_did(adapted, query, pruner):
    before = adapted.with_pruner(pruner)(query(3))
    fold_adapters(adapted.network)
    assert not any(isinstance(part, AdaptedLinear) for part in adapted.network.modules())
    after = adapted.with_pruner(pruner)(query(3))
    assert torch.equal(after[keys.TOKEN_DEPTH], before[keys.TOKEN_DEPTH])
    torch.testing.assert_close(after[keys.CHUNK], before[keys.CHUNK], atol=1e-5, rtol=0)


@torch.no_grad()
def test_a_folder_holds_what_was_trained_and_the_base_the_rest(adapted, base, query, tmp_path):
    adapted.with_pruner(FastVPruner()).save_pretrained(tmp_path / "policy")
    names = {name.removeprefix("network.") for name in load_file(tmp_path / "policy/model.safetensors")}
    frozen = {n for n, p in adapted.network.named_parameters() if not p.requires_grad}
    assert not names & frozen
    assert {n for n, p in adapted.network.named_parameters() if p.requires_grad} <= names
    again = VLAPolicy.from_pretrained(tmp_path / "policy", base=base, fold=False)
    assert again.base == adapted.base
    assert torch.equal(again(query(3))[keys.CHUNK], half(adapted)(query(3))[keys.CHUNK])
    folded = VLAPolicy.from_pretrained(tmp_path / "policy", base=base)
    torch.testing.assert_close(folded(query(3))[keys.CHUNK], again(query(3))[keys.CHUNK], atol=1e-5, rtol=0)

    # a folded one needs no base
    folded.save_pretrained(tmp_path / "whole")
    whole = VLAPolicy.from_pretrained(tmp_path / "whole")
    assert whole.tokenizer.to_config() == folded.tokenizer.to_config()
    folded.network.requires_grad_(True)
    assert torch.equal(whole(query(3))[keys.CHUNK], half(folded)(query(3))[keys.CHUNK])


def test_another_base_is_refused_and_a_missing_one_asked_for(adapted, base, policy, tmp_path):
    adapted.save_pretrained(tmp_path / "policy")
    other = write_llama(tmp_path / "other.gguf", freq_base=5e4)
    with refused("other.gguf"):
        VLAPolicy.from_pretrained(tmp_path / "policy", base=other)
    with refused("config.json: base"):
        VLAPolicy.from_pretrained(tmp_path / "policy")
    with refused("base", FileNotFoundError):
        VLAPolicy.from_pretrained(tmp_path / "policy", base=tmp_path / "none.gguf")
    policy.save_pretrained(tmp_path / "plain")
    with refused("config.json: base"):
        VLAPolicy.from_pretrained(tmp_path / "plain", base=base)


@pytest.mark.parametrize(
    ("change", "entry"),
    [
        ({"base": {"rank": 0}}, "config.json: rank"),
        ({"base": {"rank": 5}}, "decoder.llama.layers.0.self_attn.q_proj.down"),
        (
            {"network": {"rope_base": 1e4}},
            "config.json: network.rope_base",
        ),
    ],
)
def test_a_config_that_does_not_fit_the_base_is_named(adapted, base, tmp_path, change, entry):
    adapted.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    for part, fields in change.items():
        config[part] |= fields
    (tmp_path / "config.json").write_text(json.dumps(config))
    with refused(entry):
        VLAPolicy.from_pretrained(tmp_path, base=base)
