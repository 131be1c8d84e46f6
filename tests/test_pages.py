"""The tables on the pages are what the committed JSON says."""

from pathlib import Path

from torchrl_sparse.evaluation.results.pages import write_pages

ROOT = Path(__file__).parents[1]


def test_tables_on_pages_are_those_of_their_json():
    differ = write_pages(ROOT, dry=True)
    assert not differ, f"python recipes/pages.py writes them: {', '.join(map(str, differ))}"
