"""Options of the studies, whose own tests are of what they measure."""

from dataclasses import replace

from tests.evaluation.synthetic import make_results
from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import STEPS, write_pruner, write_reach, write_state_demos
from tests.options.seen import argument, content, device, written
from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.evaluation import save_results

DEMOS = "data/more.h5"


def write_inputs(folder):
    write_reach(folder / "other", horizon=12)
    for task in ("Reach", "Touch"):
        write_reach(folder / f"assets/{task.lower()}", task)
    write_state_demos(folder / DEMOS, "Reach", (1, 1), 3)


def demonstrations(run):
    return len(run.call("policy_demos").result)


def windows(run):
    return len(run.call("make_targets").result)


def asked(run):
    """The policy that answers policy calls of demonstrations."""
    return run.call("make_targets")["policy"]


class TestCarriedNoise(OptionTests):
    recipe = "studies.carried_noise"
    base = ("task=reach", "samplers=[ddim2]", "draws=3", "targets.share=0.25")
    watched = ("policy_demos", "make_targets", "carried_noise", "DiffusionPolicy.to")
    replaced = {"plot_carried_noise": returning(None)}
    groups = (
        [
            Row("policy", "other", lambda run: asked(run).horizon, 12),
            Row("device", "'cpu:0'", device()),
            Row("demos", DEMOS, demonstrations, 3),
            Row("samplers", "[ddpm2]", lambda run: run.call("carried_noise")["sampler"].kind, "ddpm"),
            Row("draws", "4", argument("carried_noise", "draws")),
            Row("targets.seed", "3", argument("carried_noise", "seed")),
            Row("threads", "2", lambda run: run.call("carried_noise").threads),
        ],
        [
            Row("task", "touch", argument("policy_demos", "task"), "Touch"),
            Row("targets.share", "0.5", windows, STEPS - 1),
            Row("out", "elsewhere", written("elsewhere/carried_noise_Touch.json"), True),
        ],
    )  # fmt: skip
    prepare = staticmethod(write_inputs)


class TestOfflineErrors(OptionTests):
    recipe = "studies.offline_errors"
    base = ("task=reach", "draws=3", "targets.share=0.25", "results=[one.json]")
    watched = ("policy_demos", "make_targets", "make_methods", "draw_answers", "DiffusionPolicy.to")
    replaced = {
        **dict.fromkeys(("plot_offline", "plot_agreement", "save_agreement"), returning(None)),
        **dict.fromkeys(("load_offline", "agreement_of"), returning(None)),
        "together_rows": returning({}),
    }
    groups = (
        [
            Row("policy", "other", lambda run: asked(run).horizon, 12),
            Row("device", "'cpu:0'", device()),
            Row("demos", DEMOS, demonstrations, 3),
            Row("results", "[two.json]", lambda run: [*argument("make_methods", "names")(run)], ["ddim10"]),
            Row("planners", "plans", lambda run: str(argument("make_methods", "planners")(run))),
            Row("num_updates", "5", argument("make_methods", "num_updates")),
            Row("draws", "4", argument("draw_answers", "draws")),
            Row("targets.seed", "3", argument("draw_answers", "seed")),
            Row("threads", "2", lambda run: run.call("draw_answers").threads),
        ],
        [
            Row("task", "touch", argument("policy_demos", "task"), "Touch"),
            Row("targets.share", "0.5", windows, STEPS - 1),
            Row("out", "elsewhere", written("elsewhere/offline_errors_Touch.json"), True),
            "results=[touch.json]",
        ],
        [Row("aggregate", "[a.json,b.json]", lambda run: [call["path"] for call in run.calls["load_offline"]])],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_inputs(folder)
        for name, method, task in (
            *(("one", "uniform", "Reach"), ("two", "ddim10", "Reach")),
            ("touch", "uniform", "Touch"),
        ):
            save_results(
                replace(make_results(20, names=("dense", method)), task=task), folder / f"{name}.json"
            )


class TestStopping(OptionTests):
    recipe = "studies.simulate_stopping"
    base = ("max_episodes=40", "analyses=2", "trials=3")
    replaced = {"plot_stopping": returning(None)}
    groups = (
        [
            Row("max_episodes", "60", content("stopping.json", "max_episodes")),
            Row("analyses", "3", content("stopping.json", "analyses")),
            Row("trials", "4", content("stopping.json", "trials")),
            Row("seed", "5", content("stopping.json", "seed")),
            Row("out", "elsewhere", written("elsewhere/stopping.json"), True),
        ],
    )


class TestSearchSchedule(OptionTests):
    recipe = "studies.search_schedule"
    base = (
        *("task=reach", "lengths=[3]", "targets.share=0.25", "draws=3", "search.population=2"),
        *("search.generations=1", "random_masks=1", "cost=flops"),
    )
    watched = (
        "policy_demos",
        "make_targets",
        "search_schedule",
        "rivals",
        "block_weights",
        "Judge",
        "DiffusionPolicy.to",
    )
    groups = (
        [
            Row("policy", "other", lambda run: asked(run).horizon, 12),
            Row("device", "'cpu:0'", device()),
            Row("demos", DEMOS, demonstrations, 3),
            Row("held_out", "0.9", lambda run: len(run.call("make_targets", 1)["demos"]), 2),
            Row("lengths", "[4]", lambda run: [*argument("search_schedule", "lengths")(run)]),
            Row("cost", "seconds", argument("block_weights", "cost")),
            Row("reuse", "type", argument("Judge", "reuse")),
            Row("fitness", "error", argument("search_schedule", "fitness")),
            Row("draws", "4", argument("Judge", "draws")),
            Row("targets.seed", "3", argument("make_targets", "seed")),
            Row("search.seed", "4", lambda run: argument("search_schedule", "options")(run).seed),
            Row("random_masks", "2", argument("rivals", "random_masks")),
            Row("threads", "2", lambda run: run.call("search_schedule").threads),
        ],
        [
            Row("task", "touch", argument("policy_demos", "task"), "Touch"),
            Row("budget", "1.5", argument("search_schedule", "budget")),
            Row("targets.share", "0.5", argument("make_targets", "share"), 0.5),
            Row("search.population", "3", lambda run: argument("search_schedule", "options")(run).population),
            Row("search.generations", "2", lambda run: argument("search_schedule", "options")(run).generations),
            Row("out", "elsewhere", written("elsewhere/searched.json"), True),
        ],
    )  # fmt: skip
    prepare = staticmethod(write_inputs)


class TestLooking(OptionTests):
    recipe = "studies.looking"
    base = ("task=reach", "episodes=2", "samples=2", "pruner=pruner")
    watched = ("record_queries", "reuse_sources", "oracle", "diffusion_env", "DiffusionPolicy.to")
    replaced = dict.fromkeys(("plot_looking", "plot_reuse_sources"), returning(None))
    groups = (
        [
            Row("device", "'cpu:0'", device()),
            Row("played", "dense", lambda run: run.call("record_queries")["actor"].policy.plan.is_static, True),
            Row("oracle.attempts", "1", lambda run: [call["attempts"] for call in run.calls["oracle"]], [1]),
            Row("oracle.draws", "3", lambda run: [call["draws"] for call in run.calls["oracle"]], [3]),
            Row("episodes", "3", lambda run: len(run.call("record_queries")["seeds"])),
            Row("samples", "3", lambda run: len(run.call("reuse_sources")["queries"])),
            Row("threads", "2", lambda run: run.call("record_queries").threads),
        ],
        [
            Row("policy", "other", lambda run: run.call("record_queries")["actor"].policy.horizon, 12),
            Row("pruner", "null", lambda run: "pruner" in run.json("looking_Reach.json"), False),
            Row("sampler", "ddim3", lambda run: run.call("record_queries")["actor"].policy.num_inference_steps, 3),
            Row("out", "elsewhere", written("elsewhere/looking_Reach.json"), True),
        ],
        [Row("task", "touch", argument("diffusion_env", "task"), "Touch"), "pruner=null"],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_inputs(folder)
        write_pruner(folder / "pruner", DiffusionPolicy.from_pretrained(folder / "assets/reach"))


class TestPages(OptionTests):
    recipe = "studies.pages"
    groups = ([Row("root", "below", lambda run: "below/page.md" in run.printed, True)],)

    @staticmethod
    def prepare(folder):
        save_results(make_results(20, names=("dense", "bac")), folder / "below/results.json")
        (folder / "below/page.md").write_text("<!-- table: results.json -->\n<!-- end -->\n")


class TestFronts(OptionTests):
    recipe = "studies.fronts"
    base = ("results=[one.json]",)
    replaced = dict.fromkeys(("plot_fronts", "plot_spending"), lambda results, path: path)
    groups = (
        [
            Row("results", "[two.json]", lambda run: [*argument("plot_fronts", "results")(run)[0].methods][-1], "ddim10"),
            Row("out", "elsewhere.png", argument("plot_fronts", "path")),
        ],
        [Row("by", "spending", lambda run: len(run.calls["plot_spending"]), 1)],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        save_results(make_results(20, names=("dense", "bac")), folder / "one.json")
        save_results(make_results(20, names=("dense", "ddim10")), folder / "two.json")
