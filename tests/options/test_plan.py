"""Options of the plan: what is asked, and of which methods."""

from tests.options.harness import OptionTests, Row
from tests.options.seen import written


def question(name):
    return lambda run: getattr(run.call("plan_rows")["question"], name)


def truths(name):
    return lambda run: sorted({getattr(truth, name) for _, truth in run.call("plan_rows")["truths"]})


class TestOptions(OptionTests):
    recipe = "plan"
    base = ("success=[0.9]", "correlations=[0.5]", "margin=0.2", "analyses=4")
    watched = ("plan_rows", "read_methods")
    groups = (
        [
            Row("success", "[0.7]", truths("success"), [0.7]),
            Row("correlations", "[0.25]", truths("correlation"), [0.25]),
            Row("difference", "-0.05", truths("difference"), [-0.05]),
            Row("margin", "0.3", question("margin"), 0.3),
            Row("power", "0.8", question("power")),
            Row("analyses", "3", question("analyses"), 3),
        ],
        [Row("picture", "plan.png", written("plan.png"), True)],
        [
            Row("files", "[a.csv]", lambda run: [call["paths"] for call in run.calls["read_methods"]], [["a.csv"]]),
            Row("errors", "exclude", lambda run: [call["errors"] for call in run.calls["read_methods"]], ["exclude"]),
            "success=[0.8,0.9,0.95]",
            "correlations=[0.0,0.5]",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        rows = [f"{name},{seed},{int(seed % 3 > 0)}" for name in ("slow", "fast") for seed in range(12)]
        (folder / "a.csv").write_text("\n".join(["method,seed,success", *rows]) + "\n")
