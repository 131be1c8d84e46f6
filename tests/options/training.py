"""What is seen of a training, whatever it trains."""

import re

from torchrl.record.loggers import get_logger

from tests.options.harness import AS_TYPED, Row

WATCHED = (
    "torchrl_sparse.training.trainer.batch_indices",
    "torch.optim.AdamW",
    "torch.nn.utils.clip_grad_norm_",
    "torch.autocast",
)
AVERAGE = "diffusers.training_utils.EMAModel"
LOGGER = "torchrl_sparse.training.loop.get_logger"


def csv_logger(kind, out, name, **_):
    """In the place of any logger, so that all runs can be read."""
    return get_logger("csv", out, name)


def logged(run, name):
    """Steps and values of a curve."""
    (path,) = (run.out / "log").glob(f"scalars/{name}.csv")
    return [(int(step), float(value)) for step, value in map(_cells, path.read_text().splitlines())]


def _cells(line):
    return line.split(",")


def first_step(name):
    return lambda run: logged(run, name)[0][0]


def total(run):
    return int(re.search(r"step \d+ of (\d+), finished", run.printed)[1])


def batch(argument):
    return lambda run: run.call(WATCHED[0])[argument]


def threads(run):
    return run.call(WATCHED[0]).threads


def peak_lr(run):
    """The rate after as many steps as the warm-up has."""
    return dict(logged(run, "train/lr"))[warmup_steps(run)]


def warmup_steps(run):
    """How much smaller the rate after the first step is than the peak's."""
    values = dict(logged(run, "train/lr"))
    return round(max(values.values()) / values[1])


def weight_decay(run):
    groups = run.call("torch.optim.AdamW")["params"]
    return max(group["weight_decay"] for group in groups)


def clipped(run):
    return max((call["max_norm"] for call in run.calls["torch.nn.utils.clip_grad_norm_"]), default=0.0)


def precision(run):
    enabled = {call["enabled"] for call in run.calls["torch.autocast"]}
    return "bf16" if enabled == {True} else "fp32"


def average(argument):
    return lambda run: run.call(AVERAGE)[argument]


def logger_kind(run):
    return run.call(LOGGER)["logger_type"]


def wandb_rows(seen):
    """The rows of the section ``wandb``, of the arguments that ``seen`` finds for ``wandb.init``."""
    values = {
        "project": "robots",
        "entity": "lab",
        "group": "first",
        "name": "mine",
        "tags": "[a,b]",
        "mode": "disabled",
    }

    def argument(name):
        left_open = {"tags": []}
        return lambda run: seen(run).get(name, left_open.get(name))

    return [Row(f"wandb.{name}", value, argument(name), AS_TYPED) for name, value in values.items()]
