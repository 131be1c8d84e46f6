"""Make one HTML page on any set of results: tables with intervals, Pareto fronts, masks and videos, nothing to fetch.

python recipes/report.py runs=outputs out=outputs/report.html
"""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.figures.html_report import write_report


@recipe("report", out="file")
def main(config: DictConfig) -> None:
    faults = write_report(config.runs, config.out, title=config.title)
    for fault in faults.values():
        print(fault, file=sys.stderr)
    print(f"{config.out}: {Path(config.out).stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
