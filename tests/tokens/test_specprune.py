"""SpecPrune's two stages, on a small model and on the published shape."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from tests.tokens.helpers import CONFIG, LAYERS, PER_CAMERA, SPEC, Recorder, later, make_policy, query
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.decoder import pack
from torchrl_sparse.networks.vla.flops import query_flops
from torchrl_sparse.networks.vla.hooks import LayerState, TokenKind, VisualSpec
from torchrl_sparse.tokens.specprune import SpecPrune, confidence, layer_score, rank_weight, updated_score


def lengths(pruner, td):
    """Visual tokens that each layer worked on, [L][B]."""
    recorder = Recorder(pruner)
    make_policy(recorder)(td)
    visual = [
        ((kind == TokenKind.PRIMARY) | (kind == TokenKind.WRIST)) & alive for _, kind, alive in recorder.seen
    ]
    return [mask.sum(1).tolist() for mask in visual]


def second_query(pruner, changed=(), **kwargs):
    return later(make_policy(pruner)(query(**kwargs)), changed=list(changed))


def test_static_pruning_alone_keeps_the_union_after_two_layers():
    def pruner():
        return SpecPrune(budget=2, dynamic=False)

    policy = make_policy(pruner())
    policy_dense = make_policy(SpecPrune(budget=PER_CAMERA, dynamic=False))  # keeps all, scores all
    td = later(policy(query(1)), changed=[(0, 5), (1, 1)])
    carried = td[keys.TOKEN_SCORE]
    scores = []
    recorder = Recorder(policy_dense.pruner)
    recorder.after_layer = lambda index, state: scores.append(state.scores)
    policy_dense.pruner = recorder
    policy_dense(td.clone())
    expected = {5, PER_CAMERA + 1}
    for values in (carried, scores[0], scores[1]):
        for camera in range(2):
            part = values[0, camera * PER_CAMERA : (camera + 1) * PER_CAMERA]
            expected |= {camera * PER_CAMERA + i for i in part.topk(2).indices.tolist()}
    depth = policy(td)[keys.TOKEN_DEPTH][0]
    assert set((depth == LAYERS).nonzero().flatten().tolist()) == expected
    assert set(depth.tolist()) == {2, LAYERS}


@pytest.mark.parametrize("without", ["carry", "changed", "local"])
def test_each_of_the_three_sets_can_be_left_out(without):
    """What stays for good is the union of the other two."""
    options = {"budget": 2, "dynamic": False, "threshold": 0.9}
    first = make_policy(SpecPrune(**options))(query(1))
    td = later(first, changed=[(0, 5), (1, 1)])
    sets = {}
    for only in ("carry", "changed", "local"):
        alone = SpecPrune(**options, **{name: name == only for name in ("carry", "changed", "local")})
        sets[only] = make_policy(alone)(td.clone())[keys.TOKEN_DEPTH] == LAYERS
    assert sets["changed"].nonzero()[:, 1].tolist() == [5, PER_CAMERA + 1]
    others = [chosen for name, chosen in sets.items() if name != without]
    found = make_policy(SpecPrune(**options, **{without: False}))(td.clone())[keys.TOKEN_DEPTH] == LAYERS
    assert torch.equal(found, others[0] | others[1])
    with refused("SpecPrune"):
        SpecPrune(carry=False, changed=False, local=False)


def test_first_query_of_an_episode_keeps_all_until_the_dynamic_layers():
    assert lengths(SpecPrune(budget=2, dynamic=False), query(1)) == [[2 * PER_CAMERA]] * LAYERS


def test_dynamic_layers_keep_their_share_of_what_is_left():
    pruner = SpecPrune(budget=2, keep_share=0.5)
    pruner.bind(SPEC)
    assert sorted(pruner.layers_scored(LAYERS)) == [0, 1, 2, 3, 4]
    assert lengths(pruner, query(1)) == [[32], [32], [32], [16], [8], [4]]  # layers 2, 3 and 4 prune


def test_carried_scores_are_means_and_zero_where_tokens_were_gone():
    pruner, scores = SpecPrune(budget=2, keep_share=0.5), []
    recorder = Recorder(pruner)

    def after_layer(index, state):
        scores.append(state.scores)
        return pruner.after_layer(index, state)

    recorder.after_layer = after_layer
    policy = make_policy(recorder)
    td = policy(query())
    torch.testing.assert_close(td[keys.TOKEN_SCORE], (scores[3] + scores[4]) / 2)
    gone = td[keys.TOKEN_DEPTH] < 4  # before the first layer whose scores are carried
    assert gone.any()
    assert (td[keys.TOKEN_SCORE][gone] == 0).all()
    assert (td[keys.TOKEN_SCORE][~gone] > 0).all()


def walk(pruner, spec, td, scores):
    """Visual tokens, bool [num_layers, N], that each layer of a decoder would see for given scores of Eq. 1."""
    kinds = [TokenKind.BOS, *[TokenKind.PRIMARY] * 256, *[TokenKind.WRIST] * 256, TokenKind.PROPRIO]
    kinds = torch.tensor([kinds + [TokenKind.TEXT] * 34 + [TokenKind.ACTION] * 56 + [TokenKind.STOP]])
    positions = torch.arange(kinds.shape[1])[None]
    alive = torch.ones_like(kinds, dtype=torch.bool)
    hidden = positions[..., None].float()
    state = LayerState(0, hidden, alive, positions, kinds, kinds == TokenKind.TEXT, spec.num_visual, td)
    pruner.begin(td)
    seen = []
    for layer in range(spec.num_layers):
        seen.append(state.visual_alive[0])
        scored = layer in pruner.layers_scored(spec.num_layers)
        state = replace(state, layer=layer, scores=scores[layer] * state.visual_alive if scored else None)
        keep = pruner.after_layer(layer, state)
        if keep is not None:
            state, _ = pack(state, state.alive & keep)
        assert torch.equal(state.hidden[..., 0].long(), state.positions)
    pruner.end(td)
    return torch.stack(seen)


def test_published_counts():
    """Four disjoint sets of 24 in each camera: what was carried, what changed, and the picks of the first two layers."""
    config = VLAConfig()
    spec, pruner = config.visual_spec, SpecPrune()
    pruner.bind(spec)
    black = torch.zeros(1, 2, 3, 224, 224, dtype=torch.uint8)
    frames, carried, scores = black + 9, torch.zeros(1, 512), torch.full((32, 1, 512), 0.5)
    rows = slice(14, 28)  # patches 16 to 31, and eight of the next row
    frames[..., rows, :], frames[..., 28:42, : 8 * 14] = black[..., rows, :], black[..., 28:42, : 8 * 14]
    for camera in (0, 256):
        carried[:, camera + 48 : camera + 72] = 1.0
        scores[0, :, camera + 80 : camera + 104] = 1.0
        scores[1, :, camera + 112 : camera + 136] = 1.0
    td = TensorDict({keys.IS_INIT: torch.zeros(1, 1, dtype=torch.bool), keys.TOKEN_SCORE: carried}, [1])
    td[keys.TOKEN_FRAMES] = black + 9
    td[keys.IMAGE], td[keys.WRIST_IMAGE] = frames[:, 0], frames[:, 1]
    seen = walk(pruner, spec, td, scores).sum(1).tolist()
    expected = [512] * 2 + [192] * 4 + [154] * 5 + [124] * 5 + [100] * 5 + [80] * 11
    assert seen == expected
    dense = torch.full((1, 32), 605)
    sparse = dense - 512 + torch.tensor([seen])
    none = torch.zeros(1, dtype=torch.int64)
    ratio = query_flops(config, sparse, none) / query_flops(config, dense, none)
    assert ratio.item() == pytest.approx(0.44, abs=0.005)


def still_scene(first):
    """A policy call at the published shape whose images are those of the last one."""
    frames = torch.full((1, 2, 3, 224, 224), 9, dtype=torch.uint8)
    td = TensorDict({keys.IS_INIT: torch.tensor([[first]]), keys.TOKEN_FRAMES: frames}, [1])
    td[keys.IMAGE], td[keys.WRIST_IMAGE] = frames.unbind(1)
    return td


def test_dynamic_layers_drop_by_the_running_score():
    spec, pruner = VLAConfig().visual_spec, SpecPrune()
    pruner.bind(spec)
    scores = torch.rand(32, 1, 512, generator=torch.Generator().manual_seed(0))
    seen = walk(pruner, spec, still_scene(first=True), scores)
    alive, running = torch.ones(512, dtype=torch.bool), None
    for layer in (0, 1, 5, 10, 15, 20):
        order = sorted(alive.nonzero().flatten().tolist(), key=lambda i: -scores[layer, 0, i])
        rank = torch.full((1, 512), 512).index_put(
            (torch.tensor([0]), torch.tensor(order)), torch.arange(len(order))
        )
        weight = rank_weight(rank, alive[None], 0.05)
        now = layer_score(weight, confidence(scores[layer], alive[None]))
        running = now if running is None else updated_score(running, now, 0.2)
        if layer > 1:
            best_first = sorted(alive.nonzero().flatten().tolist(), key=lambda i: -running[0, i])
            kept = best_first[: math.ceil(0.8 * len(best_first))]
            alive = torch.zeros(512, dtype=torch.bool).index_fill(0, torch.tensor(kept), True)
            assert torch.equal(seen[layer + 1], alive)


def test_release_prunes_after_the_first_layer_to_three_times_as_many():
    spec, pruner = VLAConfig().visual_spec, SpecPrune("release")
    pruner.bind(spec)
    scores = torch.arange(512.0).flip(0).expand(32, 1, 512)
    counts = walk(pruner, spec, still_scene(first=False), scores).sum(1).tolist()
    moving = (
        256 - 200
    )  # of each camera, at least so many count as not static; here the last ones, which score low
    assert counts[:3] == [512, 2 * moving + 3 * (16 + 12), 2 * moving + 16 + 12]


def test_published_depth_prunes_where_the_paper_does():
    pruner = SpecPrune()
    pruner.bind(VisualSpec(32, SPEC.cameras, (16, 16), 224, 4096))
    assert sorted(pruner.layers_scored(32)) == [0, 1, 5, 10, 15, 20]
    release = SpecPrune("release", dynamic=True)
    release.bind(VisualSpec(32, SPEC.cameras, (16, 16), 224, 4096))
    assert sorted(release.layers_scored(32)) == [0, 1, 5, 10, 15, 20, 25]


@pytest.mark.parametrize(("budget", "expected"), [(20, [16, 12]), (32, [25, 19])])
def test_release_counts(budget, expected):
    """int(20 r), int(15 r) coarse and int(40 r^2), int(30 r^2) fine at r = 0.8."""
    pruner = SpecPrune("release")
    pruner.bind(VisualSpec(32, SPEC.cameras, (16, 16), 224, 4096))
    td = query(1).set(keys.TOKEN_BUDGET, torch.tensor([[float(budget)]]))
    assert [count.item() for count in pruner._counts(td)] == expected


def test_release_keeps_whatever_is_not_static_and_prunes_twice():
    pruner = SpecPrune("release", alpha=1.0, budget=1, early=2.0, static_share=(1.0, 0.5))
    changed = [(0, i) for i in range(4)]
    td = second_query(pruner, changed, batch=1)
    sizes = [row[0] for row in lengths(pruner, td.clone())]
    assert sizes[0] == 2 * PER_CAMERA
    assert sizes[0] > sizes[1] >= sizes[2] >= len(changed)
    td[keys.FINE] = torch.ones(1, 1, dtype=torch.bool)  # half of each camera may be static then
    assert [row[0] for row in lengths(pruner, td)][-1] >= PER_CAMERA


def test_budget_is_per_sample():
    td = second_query(SpecPrune(budget=2, dynamic=False))
    td[keys.TOKEN_BUDGET] = torch.tensor([[1.0], [4.0], [16.0]])
    few, more, all_of_them = make_policy(SpecPrune(dynamic=False, budget=2))(td)[keys.KEPT].flatten().tolist()
    assert few < more < all_of_them == CONFIG.num_visual


def test_alpha_multiplies_the_budget():
    td = second_query(SpecPrune(budget=2))
    halved = make_policy(SpecPrune(budget=8, alpha=0.5))(td.clone())
    assert torch.equal(
        make_policy(SpecPrune(budget=4))(td.clone())[keys.TOKEN_DEPTH], halved[keys.TOKEN_DEPTH]
    )


def test_mistakes_are_named():
    with refused("alpha * budget"):
        make_policy(SpecPrune())
    policy = make_policy(SpecPrune(budget=4))
    with refused("alpha * budget"):
        policy(query().set(keys.TOKEN_BUDGET, torch.tensor([[4.0], [17.0], [4.0]])))
    with refused("preset"):
        SpecPrune("both")
    with refused("keep_share"):
        SpecPrune(keep_share=0)
    with refused("SpecPrune"):
        SpecPrune().bind(VisualSpec(2, SPEC.cameras, (16, 16), 224, 4096))
    with pytest.raises(TypeError, match="beta_"):
        SpecPrune(beta_=0.1)
