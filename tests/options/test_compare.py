"""Options of the verdicts on anybody's files."""

from tests.options.harness import OptionTests, Row
from tests.options.seen import argument, printed, written

HEAD = "method,seed,success,steps,error\n"


def page(run):
    path = run.folder / "verdicts.html"
    return path.read_text() if path.exists() else ""


class TestOptions(OptionTests):
    recipe = "compare"
    base = ("files=[a.csv]",)
    watched = ("read_methods", "compare_methods")
    groups = (
        [
            Row("files", "[b.csv]", argument("read_methods", "paths")),
            Row("errors", "failure", argument("read_methods", "errors")),
        ],
        [
            Row("reference", "fast", argument("compare_methods", "reference")),
            Row("margin", "0.1", argument("compare_methods", "margin")),
            Row("time_margin", "0.2", argument("compare_methods", "time_margin")),
            Row("horizon", "400", argument("compare_methods", "horizon")),
        ],
        [
            Row("html", "verdicts.html", written("verdicts.html"), True),
            Row("title", "mine", lambda run: "<title>mine" in page(run), True),
            Row("table_file", "t.csv", printed(r"(t\.csv)"), "t.csv"),
            Row("lerobot", "out", written("out/fast/eval_info.json"), True),
        ],
    )

    @staticmethod
    def prepare(folder):
        rows = [f"{name},{seed},{int(seed % 3 > 0)},400," for name in ("slow", "fast") for seed in range(6)]
        (folder / "a.csv").write_text("\n".join([HEAD.strip(), *rows]) + "\n")
        (folder / "b.csv").write_text("\n".join([HEAD.strip(), *rows, "fast,9,,,crashed"]) + "\n")
