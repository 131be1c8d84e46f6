"""Say how many episodes a verdict will need.

    torchrl-sparse plan margin=0.05 success=[0.9] correlations=[0,0.3,0.6] picture=outputs/plan.png

Of each method, paired and unpaired, fixed beforehand and sequential: what is expected until the verdict, and the cap. Or from a
pilot's files, of which the first method is compared with, as `compare` reads them:

    torchrl-sparse plan assets/lift/results.json margin=0.03
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe, refuse_unread
from torchrl_sparse.evaluation.compare.files import read_methods
from torchrl_sparse.evaluation.compare.planning import Question, pilot_truths, plan_rows, plot_plan
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.statistics.power import Truth


@recipe("plan", out=None, positional="files")
def main(config: DictConfig) -> None:
    question = Question(config.margin, config.power, config.analyses)
    if config.files:
        refuse_unread(config, ("success", "correlations"), __file__, "with a pilot, which tells them")
        found = pilot_truths(read_methods(config.files, config.errors))
        truths = [(name, replace(truth, difference=config.difference)) for name, truth in found]
    else:
        pairs = product(config.success, config.correlations)
        truths = [("", Truth(rate, rho, config.difference)) for rate, rho in pairs]
    print(f"{markdown_table(plan_rows(truths, question))}\n")
    print(
        f"Episodes of each method that show non-inferiority within {100 * question.margin:g} points with "
        f"{100 * question.power:g} %. Fixed numbers are exact, sequential ones simulated."
    )
    if config.picture:
        print(plot_plan(truths[0][1], question, config.picture))


if __name__ == "__main__":
    main()
