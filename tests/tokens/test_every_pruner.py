"""What holds for every method that prunes visual tokens, on a small model of the official architecture."""

import pytest
import torch

from tests.tokens.helpers import (
    CONFIG,
    KEEP_ALL,
    LAYERS,
    PER_CAMERA,
    PRUNERS,
    Recorder,
    later,
    make_grouped_policies,
    make_policy,
    query,
)
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import TokenKind

METHODS = list(PRUNERS)
DROPS = [name for name in METHODS if name != "vla_cache"]  # which reuses tokens instead


@pytest.fixture(scope="module")
def dense():
    policy = make_policy()
    return [policy(td)[keys.CHUNK] for td in (query(), later(query()))]


@pytest.mark.parametrize("name", METHODS)
def test_keeping_all_is_the_dense_model_to_the_bit(name, dense):
    policy = make_policy(KEEP_ALL[name]())
    first = policy(query())
    second = policy(later(first))
    assert torch.equal(first[keys.CHUNK], dense[0])
    assert torch.equal(second[keys.CHUNK], dense[1])
    assert (second[keys.KEPT] == CONFIG.num_visual).all()


@pytest.mark.parametrize("name", METHODS)
def test_pruning_changes_the_actions(name, dense):
    policy = make_policy(PRUNERS[name]())
    second = policy(later(policy(query())))
    assert not torch.equal(second[keys.CHUNK], dense[1])
    if name in DROPS:
        assert (second[keys.KEPT] < CONFIG.num_visual).all()
        assert (second[keys.FLOPS] < make_policy()(later(query()))[keys.FLOPS]).all()


@pytest.mark.parametrize("name", METHODS)
def test_positions_are_a_sorted_subset_and_only_visual_tokens_go(name):
    recorder = Recorder(PRUNERS[name]())
    policy = make_policy(recorder)
    first = policy(query())
    recorder.seen.clear()
    policy(later(first))
    whole = Recorder(KEEP_ALL[name]())
    make_policy(whole)(query())
    originals, original_kinds, original_alive = whole.seen[0]
    gone = 0
    for positions, kinds, alive in recorder.seen:
        for row in range(len(positions)):
            mine = positions[row][alive[row]]
            everything = originals[row][original_alive[row]]
            assert (mine.diff() > 0).all()
            assert set(mine.tolist()) <= set(everything.tolist())
            others = set(everything.tolist()) - set(mine.tolist())
            assert all(1 <= position <= CONFIG.num_visual for position in others)
            lookup = dict(zip(everything.tolist(), original_kinds[row].tolist(), strict=False))
            assert [lookup[position] for position in mine.tolist()] == kinds[row][alive[row]].tolist()
            gone += len(others)
    assert (gone > 0) == (name in DROPS)


@pytest.mark.parametrize("name", METHODS)
def test_a_row_of_a_batch_is_the_row_alone(name):
    policy = make_policy(PRUNERS[name]())
    first = policy(query(4))
    second = policy(later(first))
    if name in ("specprune", "release", "no_local", "look_back", "sparsevlm"):
        assert len(set(second[keys.KEPT].flatten().tolist())) > 1  # rows of different lengths
    for before, after in ((query(4), first), (later(first), second)):
        for row in range(4):
            alone = policy(before[row : row + 1].clone())
            assert torch.equal(alone[keys.TOKEN_DEPTH][0], after[keys.TOKEN_DEPTH][row])
            torch.testing.assert_close(alone[keys.CHUNK][0], after[keys.CHUNK][row], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", METHODS)
def test_heads_that_share_keys_are_pruned_as_those_that_have_them_each(name):
    grouped, each = make_grouped_policies(PRUNERS[name])
    td = grouped(query()), each(query())
    for mine, other in (td, (grouped(later(td[0])), each(later(td[1])))):
        assert torch.equal(mine[keys.TOKEN_DEPTH], other[keys.TOKEN_DEPTH])
        torch.testing.assert_close(mine[keys.CHUNK], other[keys.CHUNK], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", METHODS)
def test_a_new_episode_forgets_the_last(name):
    """The scene is the last episode's to the pixel, so that whoever remembers it would prune."""
    policy = make_policy(PRUNERS[name]())
    used = policy(later(policy(query())))
    again = later(used, changed=[])
    again[keys.IS_INIT] = torch.tensor([[True], [False], [True]])
    fresh = again.exclude(*policy.out_keys)
    got, expected = policy(again), policy(fresh)
    for row in (0, 2):
        assert torch.equal(got[keys.TOKEN_DEPTH][row], expected[keys.TOKEN_DEPTH][row])
        torch.testing.assert_close(got[keys.CHUNK][row], expected[keys.CHUNK][row], atol=1e-5, rtol=0)
    # The one that goes on remembers, where there is something to remember.
    remembers = (got[keys.TOKEN_DEPTH][1] != expected[keys.TOKEN_DEPTH][1]).any()
    assert remembers == (name in ("specprune", "release", "no_local", "look_back", "frame_difference"))


@pytest.mark.parametrize("name", METHODS)
def test_everything_that_is_written_is_declared_and_the_other_way_round(name):
    policy = make_policy(PRUNERS[name]())
    td = query()
    before = set(td.keys(True, True))
    written = set(policy(td).keys(True, True)) - before
    assert written == set(policy.out_keys)
    carried = written & set(policy.in_keys)
    assert (keys.TOKEN_FRAMES in carried) == (
        name in ("specprune", "release", "no_local", "look_back", "vla_cache", "frame_difference")
    )


@pytest.mark.parametrize(
    "name", [name for name in DROPS if name not in ("random", "random_dense_first", "frame_difference")]
)
def test_tokens_that_were_dropped_before_the_decoder_stay_dropped(name):
    """Random and frame difference write that mask themselves."""
    policy = make_policy(PRUNERS[name]())
    td = query()
    td[keys.KEEP_MASK] = torch.arange(CONFIG.num_visual).remainder(3).ne(0).expand(3, -1).clone()
    td = policy(td)
    assert torch.equal(td[keys.TOKEN_DEPTH] > 0, td[keys.KEEP_MASK])


def test_depth_names_the_cameras_in_their_order():
    """One patch of each camera changes; the token that is left of each is that very one."""
    policy = make_policy(PRUNERS["frame_difference"]())
    policy.pruner = type(policy.pruner)(share=1 / PER_CAMERA)
    td = policy(later(policy(query(1)), changed=[(0, 6), (1, 13)]))
    assert (td[keys.TOKEN_DEPTH][0] == LAYERS).nonzero().flatten().tolist() == [6, PER_CAMERA + 13]


def test_kinds_follow_the_cameras_in_any_order_of_pruning():
    """Whichever camera loses tokens first, ids below the first camera's count are its own."""
    for name in DROPS:
        recorder = Recorder(PRUNERS[name]())
        policy = make_policy(recorder)
        policy(later(policy(query())))
        for positions, kinds, alive in recorder.seen:
            primary = (positions >= 1) & (positions <= PER_CAMERA)
            wrist = (positions > PER_CAMERA) & (positions <= 2 * PER_CAMERA)
            assert torch.equal(primary & alive, (kinds == TokenKind.PRIMARY) & alive)
            assert torch.equal(wrist & alive, (kinds == TokenKind.WRIST) & alive)
