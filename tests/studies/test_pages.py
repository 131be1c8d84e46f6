"""A page names its tables, and gets them from the files that it names."""

import json
import shutil
from pathlib import Path

import pytest

from recipes.studies.pages.pages import find_pages, write_pages, write_tables
from tests.evaluation.synthetic import make_results
from tests.refusals import refused
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult, read_episodes

ASSETS = Path(__file__).parents[2] / "assets"


@pytest.fixture
def root(tmp_path):
    save_results(make_results(20, names=("dense", "ddim10", "bac")), tmp_path / "results.json")
    return tmp_path


def page(directive):
    return f"# Title\n\n<!-- table: {directive} -->\nold\n<!-- end -->\n\nText.\n"


def table(directive, root):
    """The cells of the one table on a page, the heading first."""
    lines = write_tables(page(directive), root).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in rows]
    return [cells[0], *cells[2:]]


def test_only_what_lies_between_the_comments_changes(root):
    before = page("results.json")
    after = write_tables(before, root)
    assert "old" not in after
    assert after.splitlines()[:3] == before.splitlines()[:3]
    assert after.endswith("<!-- end -->\n\nText.\n")
    assert write_tables(after, root) == after


def test_rows_and_columns_are_those_asked_for_in_their_order(root):
    heading, *rows = table('results.json methods="bac | dense" columns="method | verdict | success, %"', root)
    assert heading == ["method", "verdict", "success, %"]
    assert [row[:2] for row in rows] == [["bac", "inconclusive"], ["dense", "baseline"]]
    assert [row[0] for row in table("results.json", root)[1:]] == ["dense", "ddim10", "bac"]


def test_below_verdicts_stands_how_many_there_are_of_their_file(root):
    def below(directive):
        return write_tables(page(directive), root).partition("\n<!-- end -->")[0].rstrip().splitlines()[-1]

    said = "Of 4 comparisons with dense; † does not survive Holm's correction for them."
    assert below("results.json") == said
    assert below('results.json methods="bac" columns="method | time verdict"') == said
    assert below('results.json columns="method | speed-up"').startswith("| bac")
    save_results(make_results(20, names=("dense", "ddim10")), root / "results_again.json")
    together = "results.json results_again.json"
    assert below(together).startswith("Of 4 and 2 comparisons with dense, file by file; †")
    assert below(f'{together} cells="success | speed-up"').startswith("| bac")


def test_several_files_are_one_table_or_stand_side_by_side():
    can = "can/weaker/development"
    files = (
        f"lift/development/results_development.json {can}/results_development.json {can}/results_steps.json"
    )
    heading, *rows = table(f'{files} methods="sag" tasks="Lift | Can"', ASSETS)
    assert heading[:2] == ["task", "method"]
    assert [row[:2] for row in rows] == [["Lift", "sag"], ["Can", "sag"], ["Can", "sag"]]
    cells = f'{files} methods="dense | sag_played | uniform" cells="success, % | speed-up" tasks="Lift | Can"'
    heading, dense, uniform = table(cells.replace("sag_played | ", ""), ASSETS)
    assert heading == ["method", "Lift", "Can"]
    assert dense[2] == "87.0 [83, 90], 1.00×"  # of 400 episodes: the first file that has the method
    assert uniform[2] == "7.0 [4, 11], 8.85×"
    with refused("page:3: methods"):
        table(cells, ASSETS)
    compared = f'{files} methods="dense | sag" cells="vs dense, points | speed-up"'
    assert table(compared, ASSETS)[1][1] == "1.00×"  # dense is not compared with itself


def test_a_policy_with_cameras_has_a_column_of_its_own():
    files = "lift/results.json lift_image/results.json"
    heading, row = table(f'{files} methods="dense" cells="success, %"', ASSETS)
    assert heading == ["method", "Lift", "Lift, cameras"]
    assert row[1:] == ["99.5 [99, 100]", "100.0 [99, 100]"]


def test_policies_of_one_task_are_told_apart_by_the_names_that_they_are_given():
    files = "lift/development/results_development.json lift/results.json"
    options = 'methods="dense" cells="success, %"'
    heading, row = table(f'{files} {options} policies="older | newer"', ASSETS)
    assert heading == ["method", "older", "newer"]
    older, newer = (table(f"{file} {options}", ASSETS)[1][1] for file in files.split())
    assert older != newer
    assert row[1:] == [older, newer]
    with refused("page:3: policies"):
        table(f'{files} {options} policies="older"', ASSETS)


def test_files_of_one_policy_share_its_column():
    files = "lift/results.json lift/results_reuse.json square/results.json"
    options = 'methods="dense | searched" cells="success, %" policies="Lift | Lift | Square"'
    heading, dense, searched = table(f"{files} {options}", ASSETS)
    assert heading == ["method", "Lift", "Square"]
    assert (dense[1], searched[1]) == tuple(
        table(f'lift/{file}.json methods="{method}" columns="success, %"', ASSETS)[1][0]
        for file, method in (("results", "dense"), ("results_reuse", "searched"))
    )
    with refused("page:3: policies"):
        table(f"{files} {options.replace('Square', 'Lift')}", ASSETS)


def test_a_task_that_is_graded_stands_beside_others_with_its_score():
    files = "lift_two_ways/results.json pusht/results.json"
    cells = f'{files} methods="dense | bac" cells="success or score | time vs dense"'
    _, dense, bac = table(cells, ASSETS)
    results = json.loads((ASSETS / "pusht/results.json").read_text())["methods"]
    assert dense[1].startswith("295/300")
    assert dense[2].startswith(f"{results['dense']['score']['mean']:.3f}")
    assert [cell.count("[") for cell in bac] == [0, 2, 1]  # a score has an interval, and no time beside it


def test_published_figures_stand_before_ours():
    options = 'methods="dense | bac" cells="success, %" tasks=Can published=published.json'
    heading, dense, bac = table(f"can/weaker/development/results_development.json {options}", ASSETS)
    assert heading == ["method", "Can, published", "here"]
    assert dense == ["full / `dense`", "99", "87.0 [83, 90]"]
    assert bac == ["BAC / `bac`", "94, 3.42×", "74.2 [70, 78]"]


def test_pairs_count_the_episodes_beside_the_results(root):
    for name, outcomes in {"bac": [True] * 20, "ddim10": [True] * 15 + [False] * 5}.items():
        log = EpisodeLog(root / "episodes" / f"{name}.jsonl")
        for index, success in enumerate([*outcomes, False]):  # the last is not of these results
            log.append(EpisodeResult(100_000 + index, success, 30 if success else 400, 4, 1e9, 0.0))
    heading, row = table('results.json pairs="bac : ddim10"', root)
    assert heading == ["method", "against", "success", "difference, points", "verdict", "McNemar's p"]
    assert row[:3] == ["bac", "ddim10", "20 : 15"]
    assert row[-1] == "0.062"  # five of five


def test_a_row_counts_as_many_episodes_as_its_results_say_whatever_its_log_has():
    name, results = "ddpm3_logsnr", load_results(ASSETS / "lift_two_ways/results.json")
    counted = results.methods[name].success
    log = [*read_episodes(ASSETS / f"lift_two_ways/episodes/{name}.jsonl")]
    assert counted.n < len(log)  # played further for another table
    heading, row = table(f"lift_two_ways/results.json rows=ways methods={name}", ASSETS)
    told = dict(zip(heading, row, strict=True))
    assert int(told["episodes"]) == counted.n
    assert int(told["way 0"]) + int(told["way 1"]) == counted.k


def test_other_files_of_results_have_their_tables():
    engine = table(
        'engine/engine.json rows=low_dim_b4 methods="native dense" columns="variant | × eager"', ASSETS
    )
    assert engine == [["variant", "× eager"], ["native dense", engine[1][1]]]
    assert table("vla_latency/vla_latency.json rows=parts", ASSETS)[-1][0] == "rest"
    assert table("lift_moving/realtime.json", ASSETS)[1][:3] == ["dense", "0", "0 ms"]


@pytest.mark.parametrize(
    ("directive", "entry"),
    [
        ("results.json methods=magic", "page:3: methods"),
        ("results.json columns=magic", "page:3: columns"),
        ("results.json cells=magic", "page:3: cells"),
        ("results.json rows=magic", "page:3: rows"),
        ("results.json colums=method", "page:3"),
        ('results.json pairs="bac"', "page:3: pairs"),
        ("other.json", "page:3"),
        ("methods=bac", "page:3"),
        ('results.json methods="bac', "page:3"),
    ],
)
def test_what_cannot_be_followed_is_named_with_page_and_line(root, directive, entry):
    with refused(entry):
        write_tables(page(directive), root)


def test_a_missing_file_or_end_is_named(root):
    with refused("page:3", FileNotFoundError):
        write_tables(page("results_9.json"), root)
    begin = "<!-- table: results.json -->"
    with refused("page:1"):
        write_tables(f"{begin}\n{begin}\n<!-- end -->", root)


def test_all_pages_are_written_and_a_dry_run_writes_none(root):
    (root / "assets").mkdir()
    shutil.copy(root / "results.json", root / "assets")
    for name in ("README.md", "assets/README.md", "notes.txt"):
        (root / name).write_text(page("results.json"))
    stale = [root / "README.md", root / "assets" / "README.md"]
    assert find_pages(root) == stale
    assert write_pages(root, dry=True) == stale
    assert "old" in stale[0].read_text()
    assert write_pages(root) == stale
    assert write_pages(root) == []
    assert (root / "notes.txt").read_text() == page("results.json")
