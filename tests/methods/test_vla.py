"""The table of token methods: names that are written, pruners that are made, and a method registered from outside."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.methods.vla import TOKEN_METHODS, TokenMethod, check_matches, make_controller, make_pruner
from torchrl_sparse.tokens.base import TokenPruner


def test_names_make_pruners():
    assert make_pruner("dense") is None
    assert make_pruner("specprune@0.4").options.alpha == 0.4
    assert not make_pruner("specprune_static").options.dynamic
    gentle = {"specprune": {"keep_share": 0.9, "dynamic": True}}
    options = make_pruner("specprune_static@0.4", settings=gentle).options
    assert (options.keep_share, options.dynamic, options.alpha) == (0.9, False, 0.4)
    assert make_pruner("random@0.25", settings=gentle).share == 0.25
    assert make_pruner("vla_cache@0.5").static_share == 0.5
    assert make_pruner("fastv@specprune", number=0.125).share == 0.125


def test_specprune_runs_with_a_controller_and_so_do_its_variants():
    controlled = [name for name in TOKEN_METHODS if make_controller(name) is not None]
    lacking = {f"specprune_no_{name}": name for name in ("carry", "changed", "local")}
    assert controlled == ["specprune", "specprune_look_back", *lacking]
    assert make_pruner("specprune_look_back").options.look_back == 4
    assert make_controller("specprune", {"controller": {"coarse": 9}}).budgets == (9, 40)
    for name, ingredient in lacking.items():
        options = make_pruner(f"{name}@0.3").options
        assert {key: getattr(options, key) for key in lacking.values()} == {
            key: key != ingredient for key in lacking.values()
        }
    check_matches(["specprune@0.2", "specprune_no_local@specprune@0.2"])


def test_controls_are_made_as_they_are_named():
    assert make_pruner("random_dense_first@0.25").inner.share == 0.25
    assert make_pruner("fastv_dense_first").inner.layer == 2
    assert make_pruner("fastv_scaled").layers_scored(8) == {0}
    assert make_pruner("sparsevlm_embeddings@0.2").raters == "embeddings"
    skipping = make_pruner("efficientvla_layers@0.5", settings={"efficientvla": {"skipped": [3, 4]}})
    assert skipping.layers_skipped(8) == {3, 4}
    assert make_pruner("efficientvla@0.5").layers_skipped(8) == set()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("fastw", "one of dense, specprune, .*"),
        ("dense@0.5", "dense"),
        ("fastv@", "NAME, NAME@RATE, NAME@COARSE-FINE or NAME@METHOD, .*"),
        ("fastv@0.3-0.4", "fastv or fastv@NUMBER or fastv@METHOD"),
        ("fastv_every2", "fastv or fastv@NUMBER or fastv@METHOD"),
        ("fastv@-1", "NAME, .*"),
        ("sparsevlm@specprune", "sparsevlm or sparsevlm@NUMBER"),
        ("specprune@fastv", "specprune or specprune@NUMBER"),
    ],
)
def test_other_names_are_refused(text, expected):
    with refused("methods"):
        make_pruner(text)


def test_a_match_of_a_match_is_refused():
    check_matches(["specprune@0.4", "fastv@specprune@0.4"])
    with refused("methods: random@fastv@specprune"):
        check_matches(["dense", "specprune", "fastv@specprune", "random@fastv@specprune"])


class KeepFirst(TokenPruner):
    """Keeps the first visual tokens, after the first layer."""

    def __init__(self, share=0.5):
        self.share = share

    def after_layer(self, index, state):
        if index:
            return None
        keep = torch.arange(state.num_visual) < round(self.share * state.num_visual)
        return state.keep_visual(keep.expand(len(state.hidden), -1))


@torch.no_grad()
def test_a_method_from_outside_is_one_line(monkeypatch):
    """Its pruner drops what it says in a policy, at the number that is written and at one that matches another method."""
    pytest.importorskip("transformers")
    from tests.tokens.helpers import LAYERS, make_policy, query
    from torchrl_sparse import keys
    from torchrl_sparse.evaluation.rollouts.vla_methods import matching_share

    monkeypatch.setitem(TOKEN_METHODS, "mine", TokenMethod(KeepFirst, "share", matches=True))
    policy = make_policy(make_pruner("mine@0.25"))
    depth = policy(query(1))[keys.TOKEN_DEPTH][0]
    assert depth.tolist() == [LAYERS] * 8 + [1] * 24
    check_matches(["specprune", "mine@specprune"])
    dense, episodes = make_policy(), [[query(1)[0]]]
    share = matching_share(lambda share: make_pruner("mine@specprune", number=share), dense, episodes, 12.0)
    assert dense.with_pruner(make_pruner("mine", number=share))(query(1))[keys.KEPT] == pytest.approx(
        12.0, abs=1
    )


def test_a_number_that_a_method_does_not_take_is_refused():
    with refused("number"):
        make_pruner("dense", number=0.5)
