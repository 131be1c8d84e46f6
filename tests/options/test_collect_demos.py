"""Options of the collection of demonstrations: what arrives in `Collection` and `collect`, whose own tests play episodes."""

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_policy, write_state_demos
from tests.options.seen import argument
from torchrl_sparse.data.demos import Summary


def collection(name):
    return lambda run: getattr(run.call("collect")["collection"], name)


def driving(name):
    return lambda run: getattr(collection("driving")(run), name, None)


class TestOptions(OptionTests):
    recipe = "collect_demos"
    base = ("task=pusht",)
    replaced = {"collect": returning(Summary(3, 2, 2, 10.0))}
    groups = (
        [
            Row("task", "block_push", collection("task")),
            Row("episodes", "3", collection("episodes")),
            Row("seed", "7", collection("seed")),
            Row("keep_failures", "true", collection("keep_failures")),
            Row("workers", "2", argument("collect", "workers")),
            Row("backend", "ray", argument("collect", "backend")),
            Row("out", "elsewhere.h5", argument("collect", "path")),
        ],
        [
            Row("policy", "other", driving("policy")),
            Row("method", "ddim2", driving("method"), "ddim2"),
            Row("mixing", "0.5", driving("mixing"), 0.5),
        ],
        [Row("quality", "recovering", collection("quality")), "task=lift"],
    )

    @staticmethod
    def prepare(folder):
        demos = write_state_demos(folder / "data/pusht.h5", "PushT", (20, 2))
        write_policy(folder / "other", demos, "pusht")
