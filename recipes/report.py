"""Make one HTML page of any number of results.

Tables with intervals, Pareto fronts, masks and videos, nothing to fetch.

    python recipes/report.py runs=outputs out=outputs/report.html

Or make a `results.json` of schema 1 anew in schema 2, with times from the episodes beside it; or put several tasks together:

    python recipes/report.py upgrade=[outputs/can/results.json,outputs/lift/results.json]
    python recipes/report.py aggregate=[assets/lift/results.json,assets/can/results.json] out=outputs/aggregate.json

Or draw what methods gain and lose on all tasks in one picture; of several files of a task the first that has a method counts:

    python recipes/report.py fronts=[assets/lift/test_split/results.json,assets/pusht/results.json] out=outputs/fronts.png

and ``spending=`` what methods that ask more often, or for several samples, spend a second, ``budgets=`` what pruners of visual
tokens lose over the tokens that they keep, as `calibrate_tokens` measured it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.figures.curves import plot_success_within
from torchrl_sparse.evaluation.figures.fronts import plot_fronts, plot_spending
from torchrl_sparse.evaluation.figures.html_report import write_report
from torchrl_sparse.evaluation.figures.tokens import plot_token_budgets
from torchrl_sparse.evaluation.results.aggregate import aggregate_results, aggregate_rows, save_aggregate
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.upgrade import upgrade_results
from torchrl_sparse.methods.token_budget import TokenBudget


@recipe("report", out="file")
def main(config: DictConfig) -> None:
    asked = [name for name in ("upgrade", "aggregate", "fronts", "spending", "budgets") if config[name]]
    if len(asked) > 1:
        raise ValueError(f"{asked[1]}: expected [] with {asked[0]}, got {list(config[asked[1]])}")
    if config.upgrade:
        for path in map(Path, config.upgrade):
            upgrade(path)
    elif config.aggregate:
        results = aggregate_results(config.aggregate)
        save_aggregate(results, config.out)
        print(f"{markdown_table(aggregate_rows(results))}\n\n{config.out}: {', '.join(results.tasks)}")
    elif config.fronts:
        print(plot_fronts([load_results(path) for path in config.fronts], config.out))
    elif config.spending:
        print(plot_spending([load_results(path) for path in config.spending], config.out))
    elif config.budgets:
        print(plot_token_budgets([TokenBudget.from_pretrained(path) for path in config.budgets], config.out))
    else:
        faults = write_report(config.runs, config.out, title=config.title)
        for fault in faults.values():
            print(fault, file=sys.stderr)
        print(f"{config.out}: {Path(config.out).stat().st_size / 1e6:.1f} MB")


def upgrade(path: Path) -> None:
    """Write schema 2 in the place of schema 1, and the curves of success that it makes possible beside it."""
    results, lacking = upgrade_results(path)
    save_results(results, path)
    plot_success_within(results, path.parent / "figures" / f"success_within_{path.stem}.png")
    for name, why in lacking.items():
        print(f"{path}: {name}: no times, {why}")
    print(f"{path}: times of {len(results.methods) - len(lacking)} of {len(results.methods)} methods")


if __name__ == "__main__":
    main()
