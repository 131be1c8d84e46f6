"""Options of the calibrations of a diffusion policy."""

from tests.options.harness import OptionTests, Row
from tests.options.inputs import STEPS, write_reach, write_state_demos
from tests.options.seen import argument, content, device, first, size, written


def schedules(run):
    return [path.stem for path in sorted(run.out.glob("*.json")) if path.stem.startswith("bac")]


class TestBac(OptionTests):
    recipe = "calibrate_bac"
    base = ("task=reach", "num_updates=7")
    watched = ("calibrate_policy", "diffusion_env", "DiffusionPolicy.to")
    groups = (
        [
            Row("device", "'cpu:0'", device()),
            Row("sampler", "ddpm10", lambda run: {name[-6:] for name in schedules(run)} == {"ddpm10"}, True),
            Row("samples", "2", size("calibrate_policy", "seeds")),
            Row("seed", "170000", first("calibrate_policy", "seeds")),
        ],
        [
            Row("policy", "other", lambda run: run.call("calibrate_policy")["policy"].horizon, 12),
            Row("out", "elsewhere", written("elsewhere/bac.json"), True),
            Row("num_updates", "3", content("bac.json", "settings", "num_updates")),
            Row("objective", "consecutive", content("bac.json", "settings", "objective")),
            Row("top_k", "2", lambda run: len(content("bac.json", "settings", "upstream_blocks")(run)), 2),
        ],
        [
            Row("task", "touch", argument("diffusion_env", "task"), "Touch"),
            Row("methods", "[bac_unified]", schedules, ["bac_unified"]),
        ],
    )

    @staticmethod
    def prepare(folder):
        write_reach(folder / "other", horizon=12)
        for task in ("Reach", "Touch"):
            write_reach(folder / f"assets/{task.lower()}", task)


class TestTimesteps(OptionTests):
    recipe = "calibrate_timesteps"
    base = ("task=reach", "targets.share=0.25", "num_inference_steps=2", "strides=[20]")
    watched = ("find_timesteps", "make_targets", "policy_demos", "DiffusionPolicy.to")
    groups = (
        [
            Row("policy", "other", lambda run: run.call("make_targets")["policy"].horizon, 12),
            Row("demos", "data/more.h5", lambda run: len(run.call("policy_demos").result), 3),
            Row("device", "'cpu:0'", device()),
            Row("eta", "0.5", lambda run: run.call("find_timesteps").result.sampler.eta),
            Row("spacings", "[leading]", lambda run: [*run.call("find_timesteps").result.spacings]),
            Row("strides", "[30,20]", argument("find_timesteps", "strides")),
            Row("targets.seed", "3", argument("make_targets", "seed")),
            Row("threads", "2", lambda run: run.call("find_timesteps").threads),
        ],
        [
            Row("task", "touch", argument("policy_demos", "task"), "Touch"),
            Row("kind", "dpmpp2m", lambda run: run.call("find_timesteps").result.sampler.kind),
            Row("num_inference_steps", "3", lambda run: run.call("find_timesteps").result.sampler.num_inference_steps),
            Row("targets.share", "0.5", lambda run: len(run.call("make_targets").result), STEPS - 1),
            Row("out", "elsewhere", lambda run: len([*(run.folder / "elsewhere").glob("*.json")]), 1),
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_reach(folder / "other", horizon=12)
        for task in ("Reach", "Touch"):
            write_reach(folder / f"assets/{task.lower()}", task)
        write_state_demos(folder / "data/more.h5", "Reach", (1, 1), 3)
