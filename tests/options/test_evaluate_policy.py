"""Options of the evaluation of one policy."""

from tests.options.harness import OptionTests, Row
from tests.options.inputs import write_reach
from tests.options.seen import argument, device, first, printed, written


def played(run):
    return run.call("evaluate")["actor"]


def chain(run):
    sampler = played(run).policy.sampler
    return sampler.kind, sampler.num_inference_steps


class TestOptions(OptionTests):
    recipe = "evaluate_policy"
    base = ("task=reach", "episodes=2", "horizon=9")
    watched = ("evaluate", "DiffusionPolicy.to")
    groups = (
        [
            Row("demos", "data/reach_proficient.h5", printed(r"(\d) demonstrations", int), 2),
            Row("sampler", "{kind: ddim, num_inference_steps: 3}", chain, ("ddim", 3)),
            Row("device", "'cpu:0'", device()),
            Row("episodes", "3", printed(r"success \d/(\d)", int)),
            Row("seed", "170000", first("evaluate", "seeds")),
            Row("horizon", "7", lambda run: run.call("evaluate")["make_env"].keywords.get("horizon")),
            Row("n_action_steps", "5", lambda run: played(run).n_action_steps),
            Row("num_envs", "2", argument("evaluate", "num_envs")),
        ],
        [
            Row("policy", "other", lambda run: played(run).policy.horizon, 12),
            Row("engine", "torch", lambda run: played(run).policy.engine),
            Row("out", "elsewhere", written("elsewhere/episodes/dense.jsonl"), True),
        ],
        [Row("task", "touch", lambda run: argument("evaluate", "identity")(run)["task"], "Touch")],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_reach(folder / "other", horizon=12)
        for task in ("Reach", "Touch"):
            write_reach(folder / f"runs/{task.lower()}/policy", task)
