"""The campaign, shortened, and what it is made of."""

import os
import random
import sys
from dataclasses import replace

import pytest

from tests.torture.archives import torture_archives
from tests.torture.contents import contents, difference
from tests.torture.engine_fuzz import torture_engines
from tests.torture.files import fault_of, torture_files
from tests.torture.folders import torture_folder
from tests.torture.kills import KILL, RESUMED, Killer
from tests.torture.limits import Outcome, run_limited
from tests.torture.recipes import tiny_recipes
from tests.torture.report import PAGE, Campaign, Verdict, added, format_report, load_report, render_page

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="kills and limits are Linux's own")
SEED = 0


def assert_survived(verdicts, at_least):
    verdicts = list(verdicts)
    assert len(verdicts) >= at_least
    faults = [verdict for verdict in verdicts if verdict.fault is not None]
    assert not faults, "\n".join(map(str, faults))


def test_malformed_files_are_refused_by_name_and_in_time():
    assert_survived(torture_files(SEED, share=0.02), at_least=36)


def test_hostile_archives_execute_and_exhaust_nothing():
    assert_survived(torture_archives(SEED, share=0.15), at_least=12)


def test_engines_answer_or_refuse():
    assert_survived(torture_engines(SEED, queries=25, library=None, seconds=300), at_least=3 * 25)


@pytest.fixture(scope="module")
def killer(tmp_path_factory):
    """Of the recipe that takes least."""
    work = tmp_path_factory.mktemp("torture")
    return Killer(next(tiny_recipes(work)), work / "runs", random.Random(SEED))


def test_a_killed_recipe_goes_on_as_if_never_killed(killer):
    verdicts = list(killer.chain(kills=1))
    assert {verdict.part for verdict in verdicts} <= {KILL, RESUMED}
    assert verdicts[-1].part == RESUMED
    assert_survived(verdicts, at_least=1)


@pytest.mark.slow
def test_a_shared_folder_and_a_full_disk(killer, tmp_path):
    assert_survived(torture_folder(killer, tmp_path, random.Random(SEED)), at_least=2)


def test_what_breaks_limits_is_told_from_errors():
    assert run_limited(lambda: None) == Outcome(None, "")
    assert run_limited(lambda: int("x")).error == "ValueError"
    assert run_limited(lambda: bytearray(3 << 30)).error == "MemoryError"
    assert run_limited(lambda: sum(iter(int, 1)), seconds=1).text == "took more than its seconds"
    assert "SIGABRT" in run_limited(os.abort).text


@pytest.mark.parametrize(
    ("outcome", "keys", "fault"),
    [
        (Outcome(None, ""), None, None),
        (Outcome(None, ""), ("rate",), "got an answer"),
        (Outcome("InputError", "a.json: rate: expected"), ("rate",), None),
        (Outcome("InputError", "rate: expected"), ("rate",), "the file to be named"),
        (Outcome("InputError", "a.json: expected"), ("rate",), "rate to be named"),
        (Outcome("InputError", "a.json: rate\nmore"), ("rate",), "expected one line"),
        (Outcome("KeyError", "a.json: rate"), None, "expected a refusal"),
        (Outcome("died", "did not end"), None, "expected a refusal"),
    ],
)
def test_faults_of_outcomes(outcome, keys, fault):
    found = fault_of(outcome, "a.json", keys)
    assert (found is None) == (fault is None)
    assert fault is None or fault in found


def test_differences_of_runs_are_found_and_times_are_none(tmp_path):
    line = '{"seed": 1, "length": 30, "latency": [0.1]}\n'
    for name, text in {
        "one": line,
        "later": line.replace("0.1", "0.2"),
        "other": line.replace("30", "31"),
        "twice": 2 * line,
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "dense.jsonl").write_text(text)
    left = {folder.name: contents(folder) for folder in tmp_path.iterdir()}
    assert difference(left["later"], left["one"]) is None
    assert "dense.jsonl differs" in difference(left["other"], left["one"])
    assert "dense.jsonl differs" in difference(left["twice"], left["one"])
    (tmp_path / "one" / ".dense.tmp.jsonl").write_text("half")
    assert ".dense.tmp.jsonl" in difference(contents(tmp_path / "one"), left["later"])


def test_a_report_counts_and_names():
    campaign = Campaign(seed=3, command="make torture")
    campaign.add(Verdict("kill", "sweep", "SIGINT after 1.0 s", tags=("SIGINT",)))
    campaign.add(Verdict("kill", "sweep", "SIGINT after 2.0 s", "hung", ("SIGINT",)))
    text = format_report(campaign.report(minutes=1.0))
    assert "2 cases, 1 survived" in text
    assert "- kill, sweep, SIGINT after 2.0 s: hung" in text
    with pytest.raises(ValueError, match="page: expected one"):
        render_page("no place", campaign.report(minutes=1.0))


def test_reports_add_up():
    one, other = Campaign(seed=3, command="a"), Campaign(seed=4, command="b")
    one.add(Verdict("kill", "sweep", "first", tags=("SIGINT",)))
    other.add(Verdict("kill", "sweep", "second", "hung", ("SIGINT",)))
    other.add(Verdict("kill", "benchmark", "third", tags=("SIGKILL",)))
    total = added(one.report(minutes=1.0), other.report(minutes=2.0))
    assert (total.minutes, total.seeds, total.commands) == (3.0, (3, 4), ("a", "b"))
    assert [(row.subject, row.cases, len(row.faults)) for row in total.rows] == [
        ("sweep", 2, 1),
        ("benchmark", 1, 0),
    ]
    assert total.rows[0].tags == {"SIGINT": 2}
    with pytest.raises(ValueError, match="cpu: expected another"):
        added(replace(one.report(1.0), cpu="another"), other.report(1.0))


def test_the_page_shows_the_report_beside_it():
    text = PAGE.read_text(encoding="utf-8")
    assert text == render_page(text, load_report())
