"""Make one HTML page of any number of results.

Tables with intervals, Pareto fronts, masks and videos, nothing to fetch.

    python recipes/report.py runs=outputs out=outputs/report.html

Or put several tasks together:

    python recipes/report.py aggregate=[assets/lift/results.json,assets/can/results.json] out=outputs/aggregate.json

Or draw what pruners of visual tokens lose over the tokens that they keep, as `calibrate_tokens` measured it:

    python recipes/report.py budgets=[outputs/specprune.json,outputs/fastv.json] out=outputs/budgets.png
"""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.html_report import write_report
from torchrl_sparse.evaluation.figures.tokens import plot_token_budgets
from torchrl_sparse.evaluation.results.aggregate import aggregate_results, aggregate_rows
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.methods.token_budget import TokenBudget
from torchrl_sparse.storage.json import write_json


@recipe("report", out="file")
def main(config: DictConfig) -> None:
    asked = [name for name in ("aggregate", "budgets") if config[name]]
    if len(asked) > 1:
        raise InputError(f"{asked[1]}: expected [] with {asked[0]}, got {list(config[asked[1]])}")
    if config.aggregate:
        results = aggregate_results(config.aggregate)
        write_json(config.out, results)
        print(f"{markdown_table(aggregate_rows(results))}\n\n{config.out}: {', '.join(results.tasks)}")
    elif config.budgets:
        print(plot_token_budgets([TokenBudget.from_pretrained(path) for path in config.budgets], config.out))
    else:
        faults = write_report(config.runs, config.out, title=config.title)
        for fault in faults.values():
            print(fault, file=sys.stderr)
        print(f"{config.out}: {Path(config.out).stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
