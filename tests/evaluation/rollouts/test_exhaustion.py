"""Small episode logs that ask for much: each is read or refused within the limits of `tests.limits`."""

import gzip
import json
from dataclasses import asdict

import pytest

from tests.limits import SMALL_FILE, check_limits
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult

HEADER = '{"episode_log": 1, "identity": {}}\n'
EPISODE = asdict(EpisodeResult(0, True, 8, 1, 10.0, 0.5))


def episode(**changes):
    return json.dumps({**EPISODE, **changes}) + "\n"


def fill(line):
    return line * ((SMALL_FILE - 1000) // len(line))


@pytest.fixture
def write(tmp_path):
    def write(text):
        (tmp_path / "dense.jsonl").write_text(text)
        return tmp_path / "dense.jsonl"

    return write


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + fill(episode()), None),
        (HEADER + episode(latency=[0.5] * 1_500_000), None),
        (HEADER + fill("\n"), "dense.jsonl:2: expected a complete JSON file"),
        (HEADER + episode(seed=10**4000), None),
        (HEADER + "[" * (SMALL_FILE - 1000) + "\n", "dense.jsonl:2: expected at most"),
        (HEADER + fill('{"a":[]},'), None),
        (HEADER + "{" * 250_000 + "\n", "dense.jsonl:2: expected a complete JSON file"),
        (HEADER + episode(kept="x" * 9_000_000), "dense.jsonl:2: kept: expected"),
        (
            json.dumps({"episode_log": 1, "identity": {"a": "x" * 9_000_000}}) + "\n" + episode(),
            "holds other episodes",
        ),
        (fill("x"), "dense.jsonl:1: expected a complete JSON file"),
    ],
    ids=["many", "long", "blank", "huge number", "deep", "torn", "objects", "text", "identity", "noise"],
)
def test_a_log_is_read_or_refused(write, text, message):
    found = check_limits(EpisodeLog, write(text))
    assert found is None if message is None else message in found


@pytest.mark.parametrize("line", [b"0" * 1_000_000, b"{}\n" * 300_000], ids=["one line", "many"])
def test_a_compressed_log_that_unfolds_into_more_is_refused(tmp_path, line):
    packed = tmp_path / "dense.jsonl.gz"
    with gzip.open(packed, "wb") as file:
        for _ in range(1000):
            file.write(line)
    assert packed.stat().st_size < SMALL_FILE
    assert "expected at most" in check_limits(EpisodeLog, tmp_path / "dense.jsonl")
    assert not (tmp_path / "dense.jsonl").exists()
