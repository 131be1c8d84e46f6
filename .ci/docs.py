"""Contents of the site, a script of mkdocs-gen-files: the pages with all they link to, and the API's public names.

A public name is one that the stub of a package re-exports. It is documented on the page of the package whose module defines it,
and the page of the library itself lists what ``import torchrl_sparse`` offers.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import mkdocs_gen_files

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "torchrl_sparse"
FOLDERS = ("assets", "recipes", "tests", "torchrl_sparse")


def linked_files(page: Path) -> Iterator[Path]:
    """Yield the files of the repository that a page links to."""
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:")):
            yield (page.parent / target).resolve()


def add_pages() -> None:
    """Lay pages, pictures and whatever else they link to out as in the repository, so that links hold."""
    pages = {ROOT / "README.md", *(page for name in FOLDERS for page in (ROOT / name).rglob("README.md"))}
    for file in pages.union(*map(linked_files, pages)):
        with mkdocs_gen_files.open(file.relative_to(ROOT), "wb") as out:
            out.write(file.read_bytes())


def public_names(package: Path) -> Iterator[tuple[Path, str]]:
    """Yield every name that the stub of a package re-exports, and the folder or file that the name is from."""
    for node in ast.parse((package / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            origin = package / node.module.replace(".", "/")
            yield from ((origin, name.name) for name in node.names)


def dotted(place: Path) -> str:
    """Return the name of a package or module."""
    return ".".join(place.relative_to(ROOT).parts)


def defining_module(origin: Path, name: str) -> Path:
    """Follow a name through the packages that re-export it."""
    if origin.with_suffix(".py").exists():
        return origin
    return next(defining_module(deeper, name) for deeper, other in public_names(origin) if other == name)


def write_page(name: str, *parts: str) -> dict[str, str]:
    """Write a page of the reference and return its entry in the navigation."""
    file = f"api/{name}.md"
    with mkdocs_gen_files.open(file, "w") as out:
        out.write("\n\n".join([f"# {name}", *parts]) + "\n")
    return {name: file}


def about(package: str) -> str:
    """Return the directive that shows the docstring of a package alone."""
    return f"::: {package}\n    options: {{members: false, show_root_heading: false}}"


def library_page() -> dict[str, str]:
    """List what ``import torchrl_sparse`` offers, each name with a link."""
    found = sorted(
        {f"{dotted(defining_module(origin, name))}.{name}" for origin, name in public_names(LIBRARY)}
    )
    names = "\n".join(f"- [`{full.rpartition('.')[2]}`][{full}]" for full in found)
    return write_page("torchrl_sparse", about("torchrl_sparse"), names)


def package_pages() -> Iterator[dict[str, str]]:
    """Document each package that has public names of its own."""
    for stub in sorted(LIBRARY.rglob("*/__init__.pyi")):
        modules = [(o, name) for o, name in public_names(stub.parent) if o.with_suffix(".py").exists()]
        if modules:
            package = dotted(stub.parent)
            yield write_page(package, about(package), *(f"::: {dotted(o)}.{name}" for o, name in modules))


def keys_page() -> dict[str, str]:
    """Show the table of keys, which its module has in plain text."""
    text = ast.get_docstring(ast.parse((LIBRARY / "keys.py").read_text(encoding="utf-8")))
    return write_page("torchrl_sparse.keys", f"```text\n{text}\n```")


add_pages()
mkdocs_gen_files.config.nav.append({"API": [library_page(), keys_page(), *package_pages()]})
