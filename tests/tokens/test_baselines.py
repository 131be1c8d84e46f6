"""The methods that SpecPrune is compared with: that each chooses what its paper says."""

import torch
from torch.nn import functional

from tests.refusals import refused
from tests.tokens.helpers import CONFIG, LAYERS, PER_CAMERA, SPEC, Recorder, later, make_policy, query
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import TokenKind
from torchrl_sparse.tokens.efficientvla import EfficientVLAPruner, relevant_and_diverse
from torchrl_sparse.tokens.fastv import FastVPruner
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.sparsevlm import SparseVLMPruner, density_peaks, dropped_counts, merge, text_raters
from torchrl_sparse.tokens.vla_cache import REUSED, VLACachePruner, attention_entropy, reusable_set

NUM_VISUAL = CONFIG.num_visual


def recorded(pruner, td, note):
    """Runs a policy call and gives ``note(index, state)`` for each layer, before the pruner answers."""
    recorder, notes = Recorder(pruner), []

    def after_layer(index, state):
        notes.append(note(index, state))
        return pruner.after_layer(index, state)

    recorder.after_layer = after_layer
    return make_policy(recorder)(td), notes


# -- random, frame difference ----------------------------------------------------------------------------------------


def test_random_draws_depend_on_the_episode_and_step_alone():
    policy = make_policy(RandomPruner(0.25))
    first = policy(query())[keys.KEEP_MASK]
    torch.manual_seed(1)
    assert torch.equal(policy(query(seed=3))[keys.KEEP_MASK], first)
    assert not torch.equal(policy(later(query()))[keys.KEEP_MASK], first)
    assert not torch.equal(first[0], first[1])
    assert (first.sum(-1) == 8).all()


def test_random_draws_without_an_episode_come_from_the_generator():
    policy = make_policy(RandomPruner(0.25))
    td = query().exclude(keys.EPISODE_SEED, keys.EPISODE_STEP)
    assert not torch.equal(policy(td.clone())[keys.KEEP_MASK], policy(td.clone())[keys.KEEP_MASK])


def test_frame_difference_keeps_the_most_changed_of_each_camera():
    policy = make_policy(FrameDifferencePruner(3 / PER_CAMERA))
    first = policy(query())
    assert first[keys.KEEP_MASK].all()
    changed = [(0, 1), (0, 9), (0, 11), (1, 2), (1, 3), (1, 15)]
    kept = policy(later(first, changed))[keys.KEEP_MASK]
    assert kept.nonzero()[:, 1].reshape(3, -1).tolist() == [[1, 9, 11, 18, 19, 31]] * 3


# -- FastV -----------------------------------------------------------------------------------------------------------


def test_fastv_keeps_what_the_last_prompt_token_attends_to():
    pruner = FastVPruner(share=0.25, layer=2)
    td, notes = recorded(
        pruner, query(), lambda index, state: (state.scores, pruner.score_rows(state), state)
    )
    assert [scores is not None for scores, _, _ in notes] == [False, True, False, False, False, False]
    scores, rows, state = notes[1]
    assert (rows.sum(-1) == 1).all()
    last_text = (
        torch.where(state.kind == TokenKind.TEXT, state.positions, -1).masked_fill(~state.alive, -1).amax(-1)
    )
    assert torch.equal(state.positions[rows], last_text)
    kept = (td[keys.TOKEN_DEPTH] == LAYERS).nonzero()[:, 1].reshape(3, -1)
    assert torch.equal(kept, scores.topk(8).indices.sort(-1).values)
    assert set(td[keys.TOKEN_DEPTH].flatten().tolist()) == {2, LAYERS}


def test_fastv_refuses_layers_that_are_not_there():
    with refused("layer"):
        make_policy(FastVPruner(layer=6))
    with refused("layer"):
        FastVPruner(layer=0)


# -- EfficientVLA ----------------------------------------------------------------------------------------------------


def test_efficientvla_takes_relevant_tokens_and_then_unlike_ones():
    generator = torch.Generator().manual_seed(0)
    relevance, features = torch.rand(2, 12, generator=generator), torch.randn(2, 12, 5, generator=generator)
    alive = torch.ones(2, 12).bool()
    alive[1, :3] = False
    chosen = relevant_and_diverse(relevance, features, alive, count=7, key_count=2, relevant_share=0.4)
    for row in range(2):
        ids = [i for i in range(12) if alive[row, i]]
        by_relevance = sorted(ids, key=lambda i: -relevance[row, i])
        key, picked = by_relevance[:2], by_relevance[:4]
        likeness = {
            i: max(
                functional.cosine_similarity(features[row, i], features[row, k], dim=0).item() for k in key
            )
            for i in ids
            if i not in picked
        }
        picked = picked + sorted(likeness, key=likeness.get)[:3]
        assert set(chosen[row].nonzero().flatten().tolist()) == set(picked)


def test_efficientvla_skips_layers_and_prunes_after_the_second():
    pruner = EfficientVLAPruner(share=0.25, skipped=[2, 4])
    td, notes = recorded(pruner, query(), lambda index, state: index)
    assert notes == [0, 1, 3, 5]
    assert sorted(set(td[keys.TOKEN_DEPTH].flatten().tolist())) == [2, 4]
    assert ((td[keys.TOKEN_DEPTH] == 4).sum(-1) == 8).all()
    for layer in (1, 6):
        with refused("skipped"):
            make_policy(EfficientVLAPruner(skipped=[layer]))


def test_visual_features_are_indexed_by_token():
    def check(index, state):
        features = state.visual_features
        for row, slot in state.is_visual.nonzero().tolist():
            assert torch.equal(features[row, state.positions[row, slot] - 1], state.hidden[row, slot])
        assert (features[~state.visual_alive] == 0).all()
        return state.visual_alive.sum()

    _, counts = recorded(EfficientVLAPruner(share=0.25), query(), check)
    assert counts[-1] < counts[0]


# -- SparseVLM -------------------------------------------------------------------------------------------------------


def test_raters_are_words_of_the_prompt():
    def rows(index, state):
        text = state.alive & (state.kind == TokenKind.TEXT)
        raters = text_raters(state.hidden, state.is_visual, text)
        assert (raters & ~text).sum() == 0
        assert (raters.any(-1) & (raters.sum(-1) < text.sum(-1))).all()

    recorded(SparseVLMPruner(), query(), rows)


def test_the_rank_of_attention_is_spared():
    attention = torch.zeros(2, 3, 10)
    attention[0, :, :] = 0.1  # rank 1
    attention[1, torch.arange(3), torch.arange(3)] = 1.0  # rank 3
    alive = torch.ones(2, 10).bool()
    assert dropped_counts(attention, alive, 1.0).tolist() == [9, 7]
    assert dropped_counts(attention, alive, 0.5).tolist() == [4, 3]


def test_clusters_are_merged_into_their_means():
    generator = torch.Generator().manual_seed(0)
    truth = torch.arange(12) % 3
    points = torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])[truth] + torch.rand(
        12, 2, generator=generator
    )
    centres, cluster = density_peaks(points, 3)
    assert torch.equal(cluster[centres], torch.arange(3))
    merged = merge(points, cluster, 3)
    for group in range(3):
        members = cluster == group
        assert len(set(truth[members].tolist())) == 1
        torch.testing.assert_close(merged[group], points[members].mean(0))
    assert density_peaks(torch.zeros(1, 4), 1)[1].tolist() == [0]
    assert torch.equal(density_peaks(torch.ones(5, 4), 5)[1].sort().values, torch.arange(5))


def test_sparsevlm_drops_the_least_rated_and_recycles_some_of_them():
    pruner = SparseVLMPruner(scale=0.5, layers=[11], recycled=0.5, clusters=0.25)  # layer 2 of 6
    before = {}

    def note(index, state):
        if state.scores is not None:
            counts = dropped_counts(state.attention, state.visual_alive, 0.5)
            before.update(scores=state.scores, counts=counts, hidden=state.visual_features)
        elif index == 3:
            before.update(alive=state.visual_alive)

    recorded(pruner, query(), note)
    for row in range(3):
        count = int(before["counts"][row])
        order = before["scores"][row].argsort(descending=True)
        kept, dropped = set(order[: NUM_VISUAL - count].tolist()), order[NUM_VISUAL - count :].tolist()
        alive = set(before["alive"][row].nonzero().flatten().tolist())
        assert kept <= alive
        recycled = round(0.5 * count)
        assert alive - kept <= set(dropped[:recycled])
        assert len(alive - kept) == max(1, round(0.25 * recycled))


def test_recycled_tokens_hold_the_mean_of_their_cluster():
    pruner = SparseVLMPruner(recycled=1.0, clusters=0.01)  # one cluster of everything that goes
    hidden = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    dropped, keep = torch.tensor([2, 5, 7]), torch.ones(9).bool()
    keep[dropped] = False
    expected = hidden[dropped].mean(0)
    untouched = hidden.clone()
    pruner._recycle(hidden, keep, dropped)
    (centre,) = (hidden != untouched).any(-1).nonzero().flatten().tolist()
    assert centre in dropped.tolist()
    assert keep[dropped].sum() == keep[centre] == 1
    torch.testing.assert_close(hidden[centre], expected)


def test_recycled_tokens_reach_the_next_layer():
    pruner, changed = SparseVLMPruner(scale=0.5, layers=[11], recycled=0.5), []
    recorder = Recorder(pruner)

    def after_layer(index, state):
        before = state.hidden
        keep = pruner.after_layer(index, state)
        changed.append((state.hidden != before).any(-1))
        assert keep is None or not (changed[-1] & ~keep).any()
        return keep

    recorder.after_layer = after_layer
    make_policy(recorder)(query())
    assert changed[2].any(-1).all()
    assert not any(slots.any() for index, slots in enumerate(changed) if index != 2)


# -- VLA-Cache -------------------------------------------------------------------------------------------------------


def test_reusable_tokens_are_unchanged_and_irrelevant():
    alike = torch.tensor([[1.0, 0.999, 0.998, 0.5, 1.0, 1.0, 0.2, 0.9999]])
    attended = torch.tensor([[0.9, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 0.5]])
    chosen = reusable_set(alike, attended, static=2, relevant=1, threshold=0.996, cameras=2)
    assert chosen.nonzero()[:, 1].tolist() == [1, 4, 5]  # 0 and 7 are attended; 2 is third in its camera


def test_entropy_ignores_rows_that_are_not_there():
    uniform = torch.full((4,), 0.125)
    attention = torch.stack([torch.stack([uniform, torch.zeros(4)]), torch.stack([uniform, uniform])])
    torch.testing.assert_close(attention_entropy(attention), torch.full((2,), 4.0).log())


def test_reuse_of_a_scene_that_stands_still_is_exact():
    policy = make_policy(VLACachePruner(relevant_share=1 / PER_CAMERA))
    first = policy(query())
    assert (first[REUSED] == 0).all()
    second = policy(later(first, changed=[]))
    assert (second[REUSED] > 0).all()
    torch.testing.assert_close(second[keys.CHUNK], first[keys.CHUNK], atol=1e-5, rtol=0)


def test_what_changed_is_computed_anew():
    """A token that is reused keeps what the last policy call made of it; the others, and so the actions, see the change."""
    pruner = VLACachePruner(relevant_share=1 / PER_CAMERA)
    first = make_policy(pruner)(query(1))
    changed = [(0, i) for i in range(8)]
    second = later(first, changed)
    exact = make_policy()(second.clone())
    reused = make_policy(pruner)(second)
    assert not torch.equal(reused[keys.CHUNK], first[keys.CHUNK])
    assert not torch.equal(reused[keys.CHUNK], exact[keys.CHUNK])
    before, after = first["tokens", "cache"][0], reused["tokens", "cache"][0]
    same = (before == after).all(-1)  # [L, N]
    assert not same[:, :8].any()
    assert same[-1].any()
    assert SPEC.num_visual > same[-1].sum() >= same[0].sum()
    assert (same[1:] | ~same[:-1]).all()  # none comes back in a deeper layer
