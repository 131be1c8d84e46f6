"""Judge methods by anybody's files of episodes.

Ours, LeRobot's eval_info.json, vla-eval's results, robomimic's logs, or a CSV of seed or index, success, steps.

    torchrl-sparse compare runs/a/eval_info.json runs/b/eval_info.json html=outputs/compare.html
    python recipes/compare.py dense.csv fast.csv faster.csv margin=0.1 errors=failure

What the files have in common decides the test: the same seeds make pairs. One file is enough if it has several methods, or
to write its episodes as another kind:

    torchrl-sparse compare outputs/lift/results.json table_file=outputs/episodes.csv lerobot=outputs/lerobot
"""

from __future__ import annotations

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.compare.export import write_episodes, write_lerobot
from torchrl_sparse.evaluation.compare.files import read_methods
from torchrl_sparse.evaluation.compare.page import verdict_notes, verdict_rows, write_verdicts
from torchrl_sparse.evaluation.compare.verdicts import compare_methods
from torchrl_sparse.evaluation.results.tables import markdown_table


@recipe("compare", out=None, positional="files")
def main(config: DictConfig) -> None:
    methods = read_methods(config.files, config.errors)
    written = []
    if len(methods) > 1 or not (config.table_file or config.lerobot):
        verdicts = compare_methods(
            methods, config.reference, config.margin, config.time_margin, config.horizon
        )
        print(markdown_table(verdict_rows(verdicts)))
        print("\n".join(["", *verdict_notes(verdicts)]))
        if config.html:
            written.append(write_verdicts(verdicts, config.files, config.html, title=config.title))
    if config.table_file:
        written.append(write_episodes(methods, config.table_file))
    if config.lerobot:
        written.append(write_lerobot(methods, config.lerobot))
    print(*written, sep="\n", end="\n" if written else "")


if __name__ == "__main__":
    main()
