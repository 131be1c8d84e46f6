"""The page holds everything, asks for nothing, and takes nothing that it reads for markup."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from shutil import copyfile

import pytest

from recipes.studies.pages.page_rows import read_table
from tests.evaluation import synthetic
from tests.evaluation.results.test_realtime import DENSE, FAST, build
from tests.recipe_modules import run
from tests.refusals import refused
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.html_report import find_runs, write_report
from torchrl_sparse.evaluation.results.result_files import read_tables
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.storage.json import write_json

ASSETS = Path(__file__).parents[3] / "assets"


class Page(HTMLParser):
    """Tags with their attributes, and whether every tag that is opened is closed."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta", "link", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def runs(tmp_path):
    root = tmp_path / "runs"
    save_results(synthetic.make_results(20, names=("dense", "bac")), root / "lift" / "results.json")
    write_json(root / "moving" / "realtime.json", build(dense=DENSE, bac=FAST))
    figure, _ = make_figure(2, 2)
    save_figure(figure, root / "lift" / "figures" / "schedule_bac.png")
    (root / "lift" / "rollout_bac.mp4").write_bytes(b"a video")
    return root


def test_everything_is_in_one_file_that_asks_for_nothing(runs, tmp_path):
    assert write_report(runs, tmp_path / "report.html") == {}
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    sources = [
        value for _, attributes in page.tags for key, value in attributes.items() if key in ("src", "href")
    ]
    assert len(sources) == 6  # icon, three figures that are drawn, a mask, a video
    assert all(source.startswith("data:") for source in sources)
    assert "http:" not in text
    assert "https:" not in text
    assert "url(" not in text
    assert ("video", "data:video/mp4;base64,YSB2aWRlbw==") in [(tag, a.get("src")) for tag, a in page.tags]
    for name in ("bac", "lift/results.json", "moving/realtime.json", "schedule bac", "rollout bac"):
        assert name in page.text
    assert not any(tag == "script" for tag, _ in page.tags)


def test_names_are_text_and_never_markup(tmp_path):
    evil = '<img src=x onerror=alert(1)>"&'
    results = synthetic.make_results(20, names=("dense", "bac"))
    methods = {"dense": results.dense, evil: results.methods["bac"]}
    results = replace(results, task=evil, methods=methods)
    folder = tmp_path / "runs" / "<b>bold"
    save_results(results, folder / "results.json")
    (folder / "<i>.mp4").write_bytes(b"")
    write_report(tmp_path / "runs", tmp_path / "report.html", title=evil)
    page = Page((tmp_path / "report.html").read_text())
    assert not {"b", "i"} & {tag for tag, _ in page.tags}
    assert all(attributes["src"].startswith("data:") for tag, attributes in page.tags if tag == "img")
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert page.text.count(evil) >= 3


def test_a_damaged_file_is_named_and_the_others_are_shown(runs, tmp_path):
    (runs / "broken").mkdir()
    (runs / "broken" / "results.json").write_text(json.dumps({"schema": 7}))
    (runs / "cut" / "results.json").mkdir(parents=True)
    (runs / "realtime.json").symlink_to("nowhere")
    (runs / "bytes").mkdir()
    (runs / "bytes" / "realtime.json").write_bytes(b"\xff\xfe")
    faults = write_report(runs, tmp_path / "report.html")
    assert sorted(faults) == [
        "broken/results.json",
        "bytes/realtime.json",
        "cut/results.json",
        "realtime.json",
    ]
    text = (tmp_path / "report.html").read_text()
    assert "schema: expected 2, got 7" in text
    assert text.count("<table>") == 2


def test_pictures_belong_to_the_nearest_run(runs, tmp_path):
    save_results(synthetic.make_results(20, names=("dense",)), runs / "results.json")
    write_report(runs, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().count("YSB2aWRlbw==") == 1


def test_files_that_nothing_is_drawn_of_show_all_their_tables(tmp_path):
    names = ["engine/engine_images", "engine/query_quiet", "vla_smollm2/vla_latency", "statistics/aggregate"]
    for name in names:
        copyfile(ASSETS / f"{name}.json", tmp_path / f"{Path(name).name}.json")
    assert write_report(tmp_path, tmp_path / "report.html") == {}
    text = (tmp_path / "report.html").read_text()
    assert Page(text).open == []
    tables = [table for name in names for table in read_tables(ASSETS / f"{name}.json")]
    assert text.count("<table>") == text.count("<h3>") == len(tables)
    assert all(f"<h3>{table}</h3>" in text for table in tables)


def test_every_file_of_results_that_is_shipped_can_be_shown():
    shipped = find_runs(ASSETS)
    assert {path.name.startswith("query") for path in shipped} == {True, False}
    assert all(read_table(path).rows for path in shipped)


def test_the_recipe_shows_one_of_each_kind(tmp_path):
    shipped = {path.stem.partition("_")[0]: path for path in find_runs("assets")}
    (tmp_path / "runs").mkdir()
    for path in shipped.values():
        copyfile(path, tmp_path / "runs" / path.name)
    assert "report.html: " in run("report", f"runs={tmp_path}/runs", f"out={tmp_path}/report.html")
    page = (tmp_path / "report.html").read_text()
    assert {"results", "realtime", "engine"} < shipped.keys()
    assert all(path.name in page for path in shipped.values())


def test_a_folder_without_results_is_refused(tmp_path):
    with refused(str(tmp_path), FileNotFoundError):
        find_runs(tmp_path)
