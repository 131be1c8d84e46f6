"""Rewrite every table of results on the pages from the committed JSON files.

python -m recipes.studies.pages
"""

from __future__ import annotations

from omegaconf import DictConfig

from recipes.studies.pages.pages import write_pages
from torchrl_sparse.cli.options import Word
from torchrl_sparse.cli.recipe import recipe

OPTIONS = {"root": Word}
"""Options that no recipe of the library has -> type."""


@recipe("pages", out=None, options=OPTIONS)
def main(config: DictConfig) -> None:
    changed = write_pages(config.root)
    print("\n".join(map(str, changed)) or "every table is as its JSON says")


if __name__ == "__main__":
    main()
