"""Options of the report: each asks for something else, so each is a run of its own."""

import shutil
from types import SimpleNamespace

from tests.evaluation.synthetic import make_results
from tests.options.harness import OptionTests, Row, returning
from tests.options.seen import written
from tests.recipe_modules import RECIPES
from torchrl_sparse.evaluation import save_results

VLA = RECIPES.parent / "assets/vla/specprune.json"


def page(run):
    path = run.folder / run.options["out"]
    return path.read_text() if path.suffix == ".html" else ""


def drawn(run):
    return [path.name for path in run.folder.glob("*.png")]


def put_together(run):
    return [path for call in run.calls["aggregate_results"] for path in call["paths"]]


class TestOptions(OptionTests):
    recipe = "report"
    replaced = {
        "aggregate_results": lambda paths: SimpleNamespace(tasks={}),
        "write_json": returning(None),
        "aggregate_rows": returning([{"method": "dense"}]),
    }
    groups = (
        [Row("title", "mine", lambda run: "<title>mine" in page(run), True)],
        [
            Row("runs", "others", lambda run: "ddim10" in page(run), True),
            Row("out", "elsewhere.html", written("elsewhere.html"), True),
        ],
        [
            Row("aggregate", "[others/results.json,can.json]", put_together),
            "out=together.json",
        ],
        [Row("budgets", "[budget.json]", drawn, ["budgets.png"]), "out=budgets.png"],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        save_results(make_results(20, names=("dense", "bac")), folder / "outputs/results.json")
        save_results(make_results(20, names=("dense", "ddim10")), folder / "others/results.json")
        shutil.copy(VLA, folder / "budget.json")
