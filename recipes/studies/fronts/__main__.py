"""Draw success against speed-up for all methods on all tasks of this repository in one picture.

    python -m recipes.studies.fronts results=[assets/lift/results.json,assets/pusht/results.json]

Of several files of a task the first that has a method counts. With ``by=spending`` methods that ask more often, or for several
samples, are drawn against what a second of the robot's time costs.
"""

from __future__ import annotations

from typing import Literal

from omegaconf import DictConfig

from recipes.studies.fronts.figure import plot_fronts, plot_spending
from torchrl_sparse.cli.options import Words
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.results.schema import load_results

OPTIONS = {"results": Words, "by": Literal["speed", "spending"]}
"""Options that no recipe of the library has -> type."""


@recipe("fronts", out="file", options=OPTIONS)
def main(config: DictConfig) -> None:
    plot = plot_spending if config.by == "spending" else plot_fronts
    print(plot([load_results(path) for path in config.results], config.out))


if __name__ == "__main__":
    main()
