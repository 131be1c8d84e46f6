"""Every page is true: its tables, its snippets, its commands, its links, and what it says of the package's layers."""

import sys
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import pytest
import yaml
from importlinter.api import read_configuration

from recipes.studies.pages.pages import write_pages
from tests.pages import PAGES, ROOT, anchors, commands, links, snippets, tables
from tests.recipe_modules import options_file
from tests.storage.published import openvla
from tests.storage.published.checkpoints import LowDimPolicy, write_checkpoint
from torchrl_sparse.blocks.engine import ENGINES
from torchrl_sparse.envs.tasks import TASKS, find_task
from torchrl_sparse.methods import METHODS, TOKEN_METHODS

TABLES = {"METHODS": METHODS, "TOKEN_METHODS": TOKEN_METHODS, "TASKS": TASKS, "ENGINES": ENGINES}
WITH_SNIPPETS = [name for name, page in PAGES.items() if "```python" in page.read_text()]
WITH_SNIPPETS.remove("README.md")  # whose output a test of its own reads
every_page = pytest.mark.parametrize("page", PAGES)


def test_readme_is_short():
    assert PAGES["README.md"].read_text().count("\n") <= 90


def test_tables_on_pages_are_those_of_their_json():
    differ = write_pages(ROOT, dry=True)
    assert not differ, f"python -m recipes.studies.pages writes them: {', '.join(map(str, differ))}"


@pytest.mark.parametrize("page", [name for name in PAGES if name.endswith("README.md")])
def test_the_site_leads_to_it(page):
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    assert f": {page}\n" in navigation


@every_page
def test_no_table_of_results_is_written_by_hand(page):
    of_results = ("success", "p50", "speed-up", "FLOPs ratio", "verdict")
    by_hand = [head for head in tables(PAGES[page].read_text()) if any(word in head for word in of_results)]
    assert not by_hand


@every_page
def test_links_lead_somewhere(page):
    for link in links(PAGES[page].read_text()):
        file, _, anchor = link.partition("#")
        target = (PAGES[page].parent / file).resolve() if file else PAGES[page]
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


@every_page
def test_commands_name_recipes_and_their_options(page):
    for recipe, arguments in commands(PAGES[page].read_text()):
        options = yaml.safe_load(options_file(recipe).read_text())
        keys = [argument.strip('"').partition("=")[0] for argument in arguments if "=" in argument]
        for key in keys:
            assert key[0] in "+$" or _takes(options, key.split(".")), f"{recipe}: {key}"


def _takes(options, path):
    """Whether an option stands in the yaml, or in an empty section, which takes whatever it configures does."""
    for name in path:
        if options == {}:
            return True
        if name not in options:
            return False
        options = options[name]
    return True


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with what the repository has and with the files of others that snippets read."""
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    write_checkpoint(tmp_path / "latest.ckpt", LowDimPolicy())
    for size, width in {
        "dino": 64,
        "siglip": 64,
        "llm": 128,
    }.items():  # widths that the published heads divide
        monkeypatch.setitem(openvla.SIZES, size, width)
    folder = tmp_path / "openvla-oft"
    folder.mkdir()
    openvla.write(folder, openvla.make_tensors(), *openvla.make_heads())
    monkeypatch.chdir(tmp_path)
    with ExitStack() as registered:
        for table in TABLES.values():
            registered.enter_context(patch.dict(table))
        yield tmp_path


@pytest.fixture
def run(desk, monkeypatch):
    """Runs the snippets of a page, in order, as one module; returns its names."""

    def run_page(page):
        module = ModuleType("page")
        monkeypatch.setitem(sys.modules, "page", module)
        for code in snippets(PAGES[page].read_text()):
            exec(compile(code, page, "exec"), vars(module))
        return vars(module)

    return run_page


@pytest.mark.parametrize("page", WITH_SNIPPETS)
def test_snippets_run(page, run):
    run(page)


def test_the_readme_ends_in_success(run, capsys):
    run("README.md")
    solved, _, of = capsys.readouterr().out.partition(" episodes solved in ")
    assert int(solved.split()[-1]) >= 2
    assert of.startswith("128 steps")


def test_the_four_toys_are_found_by_their_tables(run):
    names = run("torchrl_sparse/README.md")
    assert names["METHODS"]["skip_odd"].make is not None
    assert isinstance(names["TOKEN_METHODS"]["keep_half"].make(), names["KeepHalf"])
    assert find_task("reach").make(seeds=[1]).horizon == 50
    assert names["policy"].engine_info().startswith("counting")


def test_the_table_of_folders_is_the_contract():
    page = PAGES["torchrl_sparse/README.md"].read_text()
    rows = page.partition("| folder | what it holds |\n")[2].partition("\n\n")[0].split("\n")[1:]
    written = [{part.strip(" `") for part in row.split("|")[1].split(",")} for row in rows]
    contracts = read_configuration(str(ROOT / "pyproject.toml"))["contracts_options"]
    package, *inside = [contract for contract in contracts if contract["type"] == "layers"]
    assert written == [{part.strip() for part in layer.split("|")} for layer in package["layers"]]
    for contract in inside:
        folders = ", ".join(name.removeprefix("torchrl_sparse.") for name in contract["containers"])
        assert f"    {folders}: {' > '.join(contract['layers'])}\n" in page


def test_the_table_of_tasks_has_their_sizes():
    page = PAGES["recipes/README.md"].read_text()
    rows = page.partition("| `task=` |")[2].partition("\n\n")[0].split("\n")[2:]
    written = {row.split("`")[1]: row.split("|")[2].strip() for row in rows}
    assert written == {task.alias: f"{task.state_dim}, {task.action_dim}" for task in TASKS.values()}


def test_every_recipe_has_its_row():
    page = PAGES["recipes/README.md"].read_text()
    for recipe in sorted(Path(ROOT / "recipes").glob("*.py")):
        assert page.count(f"| [`{recipe.stem}`]({recipe.stem}.yaml) |") == 1
