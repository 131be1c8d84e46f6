import gzip
import json
from dataclasses import asdict

import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.rollouts.episodes import (
    EpisodeLog,
    EpisodeResult,
    TokensKept,
    read_episodes,
    read_identity,
    tokens_kept,
    totals,
)
from torchrl_sparse.storage.atomic import atomic_path


def episode(seed, **kwargs):
    values = {"success": True, "length": 30, "queries": 4, "flops_total": 4e9, "prune_rate": 0.5}
    return EpisodeResult(seed, **{**values, **kwargs})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "runs" / "bac.jsonl"


def test_log_survives_reopening(path):
    first = EpisodeLog(path, {"method": "bac"})
    first.append(episode(3, latency=(0.1, 0.2), kept=(9.0, 4.5), fine=(False, True), score=0.7, way=-1))
    first.append(episode(1, success=False))
    again = EpisodeLog(path, {"method": "bac"})
    assert list(again.episodes.values()) == [*first.episodes.values()]
    assert again.episodes[3].fine == (False, True)
    assert again.missing([0, 1, 2, 3]) == [0, 2]


def test_a_line_tells_what_is_not_at_its_default_and_one_that_tells_all_is_the_same(path):
    EpisodeLog(path).append(episode(3, score=0.0))
    header, line = path.read_text().splitlines()
    told = {"seed", "success", "length", "queries", "flops_total", "prune_rate", "score"}
    assert json.loads(line).keys() == told
    path.write_text(f"{header}\n{json.dumps(asdict(episode(3, score=0.0)))}\n")
    assert EpisodeLog(path).episodes == {3: episode(3, score=0.0)}


def test_every_append_is_on_disk_at_once(path):
    log = EpisodeLog(path)
    for seed in range(3):
        log.append(episode(seed))
        assert len(path.read_text().splitlines()) == seed + 2


def test_a_file_torn_anywhere_keeps_all_whole_episodes(path):
    log = EpisodeLog(path, {"method": "bac"})
    for seed in range(3):
        log.append(episode(seed))
    content = path.read_bytes()
    for length in [*range(0, len(content), 7), *range(len(content) - 3, len(content) + 1)]:
        path.write_bytes(content[:length])
        whole = max(content[:length].count(b"\n") - 1, 0)
        reopened = EpisodeLog(path, {"method": "bac"})
        assert list(reopened.episodes) == list(range(whole))
        reopened.append(episode(99))
        assert list(EpisodeLog(path, {"method": "bac"}).episodes) == [*range(whole), 99]


def test_another_identity_is_refused_and_the_file_left_alone(path):
    EpisodeLog(path, {"method": "bac", "policy": "abc"}).append(episode(0))
    before = path.read_bytes() + b'{"seed": 1, "succ'
    path.write_bytes(before)
    with refused("bac.jsonl"):
        EpisodeLog(path, {"method": "bac", "policy": "xyz"})
    assert path.read_bytes() == before


@pytest.fixture
def packed(path):
    """A compressed log of three episodes."""
    log = EpisodeLog(path, {"method": "bac"})
    for seed in range(3):
        log.append(episode(seed))
    packed = path.with_name("bac.jsonl.gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    return packed


def test_a_compressed_log_is_read_where_it_lies(path, packed):
    for asked in (path, packed):
        assert [*read_episodes(asked)] == [episode(seed) for seed in range(3)]
        assert read_identity(asked) == {"method": "bac"}
    assert not path.exists()


def test_a_compressed_log_is_gone_on_with(path, packed):
    before = packed.read_bytes()
    log = EpisodeLog(path, {"method": "bac"})
    assert list(log.episodes) == [0, 1, 2]
    log.append(episode(7))
    seeds = [found.seed for found in read_episodes(path)]
    assert seeds == [0, 1, 2, 7]  # not those of the compressed one any more
    assert packed.read_bytes() == before


def test_a_compressed_log_of_other_episodes_is_refused_and_left_packed(path, packed):
    with refused("bac.jsonl"):
        EpisodeLog(path, {"method": "sag"})
    assert not path.exists()


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-9], lambda b: b[:40] + b"~~~~" + b[44:], lambda b: b"{" + b[1:]]
)
def test_a_damaged_compressed_log_is_named(path, packed, damage):
    packed.write_bytes(damage(packed.read_bytes()))
    for read in (lambda: [*read_episodes(path)], lambda: EpisodeLog(path, {"method": "bac"})):
        with refused("bac.jsonl.gz"):
            read()
        assert not path.exists()


def test_a_log_that_is_not_there_is_named(path):
    with refused("bac.jsonl", FileNotFoundError):
        next(read_episodes(path))


def test_a_log_without_an_episode_is_anybodys(path):
    EpisodeLog(path, {"method": "bac"})  # and then the run failed
    EpisodeLog(path, {"method": "sag"}).append(episode(0))
    assert list(EpisodeLog(path, {"method": "sag"}).episodes) == [0]
    with refused("bac.jsonl"):
        EpisodeLog(path, {"method": "bac"})


@pytest.mark.parametrize(
    "content", [b"my only copy of a poem", b"first line\nsecond line", b'{"schema": 1}\n', b"[1]\n"]
)
def test_a_foreign_file_is_refused_and_left_alone(path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bac.jsonl:1: .*expected"):
        EpisodeLog(path, {"method": "bac"})
    assert path.read_bytes() == content


def test_damage_before_the_last_line_names_the_line(path):
    log = EpisodeLog(path)
    log.append(episode(0))
    log.append(episode(1))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1][:-9], lines[2]]) + "\n")
    with refused("bac.jsonl:2"):
        EpisodeLog(path)
    missing = json.loads(lines[1])
    del missing["queries"]
    path.write_text("\n".join([lines[0], json.dumps(missing)]) + "\n")
    with refused("bac.jsonl:2: queries"):
        EpisodeLog(path)


def test_a_seed_is_logged_once(path):
    log = EpisodeLog(path)
    log.append(episode(5))
    with refused("bac.jsonl"):
        log.append(episode(5))


def test_totals_weigh_queries():
    sums = totals([episode(0), episode(1, queries=1, flops_total=6e9, prune_rate=0.0, length=50)])
    assert sums.flops_per_query == 2e9
    assert sums.prune_rate == pytest.approx(0.4)
    assert sums.episode_length == 40
    with refused("episodes"):
        totals([])


def test_tokens_are_averaged_over_queries_and_modes():
    sighted = [
        episode(0, kept=(100.0, 40.0), fine=(False, True)),
        episode(1, kept=(60.0,), fine=(True,)),
    ]
    assert tokens_kept(sighted) == TokensKept(
        kept_mean=pytest.approx(200 / 3), kept_fine=50.0, kept_coarse=100.0
    )
    assert tokens_kept([episode(0, kept=(100.0, 40.0))]) == TokensKept(70.0, None, None)
    assert tokens_kept([episode(0)]) is None


def test_a_log_from_before_there_were_tokens_is_read(path):
    log = EpisodeLog(path)
    log.append(episode(0))
    header, line = path.read_text().splitlines()
    old = {key: value for key, value in json.loads(line).items() if key not in ("kept", "fine")}
    path.write_text(f"{header}\n{json.dumps(old)}\n")
    assert EpisodeLog(path).episodes == {0: episode(0)}


def test_atomic_path_leaves_the_old_file_when_the_writer_fails(tmp_path):
    target = tmp_path / "figure.png"
    target.write_text("old")

    def interrupted_write():
        with atomic_path(target) as temporary:
            assert temporary.suffix == ".png"
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_write()
    assert [file.name for file in tmp_path.iterdir()] == ["figure.png"]
    assert target.read_text() == "old"
