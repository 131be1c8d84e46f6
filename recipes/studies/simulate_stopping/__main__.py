"""Simulate benchmarks with early stopping: false claims, episodes saved, and the coverage of intervals over several tasks.

python -m recipes.studies.simulate_stopping out=assets/statistics
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from recipes.studies.simulate_stopping.figure import plot_stopping
from recipes.studies.simulate_stopping.results import save_stopping, simulate_stopping
from torchrl_sparse.cli.options import Count
from torchrl_sparse.cli.recipe import recipe

OPTIONS = {"max_episodes": Count, "analyses": Count, "trials": Count}
"""Options that no recipe of the library has -> type."""


@recipe("simulate_stopping", options=OPTIONS)
def main(config: DictConfig) -> None:
    results = simulate_stopping(config.max_episodes, config.analyses, config.trials, config.seed)
    out = Path(config.out)
    save_stopping(results, out / "stopping.json")
    plot_stopping(results, out / "stopping.png")
    for case in results.type_one:
        print(f"{case.task}, {case.margin}: {100 * case.rate:.1f} % claimed at the margin")
    for case in results.savings:
        saved, decided = 100 * case.savings.saved, 100 * (case.savings.non_inferior + case.savings.inferior)
        print(
            f"{case.task}, {100 * case.difference:+.0f} points: {saved:.0f} % saved, {decided:.0f} % decided"
        )
    for pair in results.pairs:
        at = f"{pair.task}, both {100 * pair.difference:+.0f} points"
        print(f"{at}: {pair.success:.1%} of equal methods seem to differ in success, {pair.time:.1%} in time")
    for case in results.errors:
        print(
            f"{case.analyses} analyses up to {case.max_episodes}: at most {case.non_inferior:.1%} non-inferior at the margin"
        )
    for case in results.aggregates:
        print(f"{case.tasks}: success covered {case.success:.1%} at least, time {case.time:.1%}")


if __name__ == "__main__":
    main()
