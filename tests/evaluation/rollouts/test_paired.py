import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import RewardSum, TransformedEnv, check_env_specs

from tests.evaluation.rollouts.fakes import (
    CHUNK_LENGTH,
    FLOPS_PER_QUERY,
    FakeActor,
    FakeEnv,
    TellingEnv,
    expected_length,
)
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.runtime.threads import num_threads

SEEDS = [7, 3, 10, 4, 25, 6, 1, 8, 15, 2, 11]


def queries(length):
    return -(-length // CHUNK_LENGTH)


def test_fake_env_is_a_sound_env():
    check_env_specs(FakeEnv([1, 2]))


@pytest.mark.parametrize("num_envs", [1, 3, 50])
def test_one_episode_per_seed_in_order(num_envs):
    episodes = rollout_episodes(FakeActor(), FakeEnv, SEEDS, num_envs=num_envs)
    assert [episode.seed for episode in episodes] == SEEDS
    assert [episode.length for episode in episodes] == [expected_length(seed) for seed in SEEDS]
    assert [episode.success for episode in episodes] == [seed % 5 != 0 for seed in SEEDS]


def test_what_tasks_tell_is_kept_where_they_tell_it():
    for episode in rollout_episodes(FakeActor(), FakeEnv, SEEDS, num_envs=3):
        assert (episode.score, episode.completed, episode.way) == (0.0, None, None)
    for episode in rollout_episodes(FakeActor(), TellingEnv, SEEDS, num_envs=3):
        assert episode.score == pytest.approx(0.5)  # the highest of 0.1, 0.5 and less
        assert episode.completed == episode.length // 2
        assert episode.way == episode.seed % 4


@pytest.mark.parametrize("seed", [1.7, "7", -1])
def test_seeds_that_are_no_whole_numbers_are_refused(seed):
    with refused("seed"):
        rollout_episodes(FakeActor(), FakeEnv, [3, seed])


def test_costs_count_only_where_the_policy_was_queried():
    for episode in rollout_episodes(FakeActor(prune_rate=0.3), FakeEnv, SEEDS, num_envs=4):
        count = queries(episode.length)
        assert episode.queries == len(episode.latency) == count
        assert episode.flops_total == pytest.approx(count * FLOPS_PER_QUERY)
        assert episode.prune_rate == pytest.approx(0.3)
        assert episode.latency == pytest.approx([0.01] * count)


def test_a_policy_without_masks_has_prune_rate_zero():
    episodes = rollout_episodes(FakeActor(prune_rate=None), FakeEnv, [1, 2], num_envs=2)
    assert [episode.prune_rate for episode in episodes] == [0.0, 0.0]


def test_workers_get_interleaved_seeds():
    given = []

    def make_env(seeds):
        given.append(list(seeds))
        return FakeEnv(seeds)

    rollout_episodes(FakeActor(), make_env, SEEDS, num_envs=4)
    assert all(SEEDS[worker::4] in given for worker in range(4))


def test_max_steps_truncates():
    episodes = rollout_episodes(FakeActor(), FakeEnv, [5, 1, 2, 3], num_envs=2, max_steps=5)
    assert [episode.length for episode in episodes] == [5, 4, 5, 5]
    assert [episode.success for episode in episodes] == [False, True, True, False]


@pytest.mark.filterwarnings("error:Nested TransformedEnvs")
@pytest.mark.parametrize("num_envs", [1, 2])
def test_max_steps_truncates_environments_that_have_transforms(num_envs):
    def make_env(seeds):
        return TransformedEnv(FakeEnv(seeds), RewardSum())

    episodes = rollout_episodes(FakeActor(), make_env, [5, 1], num_envs=num_envs, max_steps=5)
    assert [episode.length for episode in episodes] == [5, 4]


def test_progress_and_file(tmp_path):
    seen = []
    path = tmp_path / "dense.jsonl"
    rollout_episodes(
        FakeActor(),
        FakeEnv,
        SEEDS,
        num_envs=3,
        results_file=path,
        on_episode=lambda episode, done, total: seen.append((episode.seed, done, total)),
    )
    assert sorted(seed for seed, _, _ in seen) == sorted(SEEDS)
    assert [(done, total) for _, done, total in seen] == [(i + 1, len(SEEDS)) for i in range(len(SEEDS))]
    assert len(path.read_text().splitlines()) == 1 + len(SEEDS)


@pytest.mark.parametrize("torn", [False, True])
def test_resume_after_a_crash_gives_the_same_and_reruns_nothing(tmp_path, torn):
    path = tmp_path / "dense.jsonl"
    whole = rollout_episodes(FakeActor(), FakeEnv, SEEDS, num_envs=3)
    with pytest.raises(RuntimeError, match="injected crash"):
        rollout_episodes(FakeActor(crash_at=20), FakeEnv, SEEDS, num_envs=3, results_file=path)
    finished = len(path.read_text().splitlines()) - 1
    assert 0 < finished < len(SEEDS)
    if torn:
        path.write_bytes(path.read_bytes()[:-5])
        finished -= 1

    new = []
    resumed = rollout_episodes(
        FakeActor(),
        FakeEnv,
        SEEDS,
        num_envs=3,
        results_file=path,
        on_episode=lambda episode, done, total: new.append((episode.seed, done)),
    )
    assert resumed == whole
    assert len(new) == len(SEEDS) - finished
    assert new[0][1] == finished + 1
    assert new[-1][1] == len(SEEDS)

    never_called = FakeActor(crash_at=1)
    assert rollout_episodes(never_called, FakeEnv, SEEDS, results_file=path) == whole
    assert never_called.calls == 0


def test_more_seeds_extend_a_file(tmp_path):
    path = tmp_path / "dense.jsonl"
    rollout_episodes(FakeActor(), FakeEnv, SEEDS[:4], num_envs=2, results_file=path)
    new = []
    rollout_episodes(
        FakeActor(), FakeEnv, SEEDS, results_file=path, on_episode=lambda e, done, total: new.append(e.seed)
    )
    assert sorted(new) == sorted(SEEDS[4:])


def test_a_file_of_another_method_is_refused(tmp_path):
    path = tmp_path / "dense.jsonl"
    rollout_episodes(FakeActor(), FakeEnv, [1], results_file=path, identity={"method": "dense"})
    for kwargs in ({"identity": {"method": "bac"}}, {"identity": {"method": "dense"}, "max_steps": 9}):
        with refused("dense.jsonl"):
            rollout_episodes(FakeActor(), FakeEnv, [1], results_file=path, **kwargs)


def test_missing_keys_are_named():
    actor = TensorDictModule(lambda state: state, in_keys=[keys.STATE], out_keys=[keys.ACTION])
    with pytest.raises(KeyError, match=r"'control', 'queried'"):
        rollout_episodes(actor, FakeEnv, [1])


def test_the_thread_count_survives():
    with num_threads(1):
        rollout_episodes(FakeActor(), FakeEnv, [1, 2], num_envs=2)
        assert torch.get_num_threads() == 1


@pytest.mark.parametrize(
    ("seeds", "kwargs", "entry"),
    [
        ([1, 2, 1], {}, "seeds"),
        ([1], {"num_envs": 0}, "num_envs, max_steps"),
        ([1], {"max_steps": 0}, "num_envs, max_steps"),
    ],
)
def test_faults(seeds, kwargs, entry):
    with refused(entry):
        rollout_episodes(FakeActor(), FakeEnv, seeds, **kwargs)


def test_no_seeds_no_work():
    assert rollout_episodes(FakeActor(crash_at=1), FakeEnv, []) == []
