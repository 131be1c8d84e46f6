"""Pages of Markdown taken apart: code, commands, links and headings."""

import re
from pathlib import Path

from recipes.studies.pages.pages import find_pages

ROOT = Path(__file__).parents[1]
PAGES = {str(page.relative_to(ROOT)): page for page in find_pages(ROOT)}

_FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")


def snippets(text):
    """Python blocks in order, each after as many empty lines as stand before it, so that errors name the line of the page."""
    for match in re.finditer(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield "\n" * text.count("\n", 0, match.start(1)) + match[1]


def commands(text):
    """Recipe and arguments of every command that runs one, with lines joined that end in a backslash."""
    for line in text.replace("\\\n", " ").split("\n"):
        for match in re.finditer(r"python (?:recipes/(\w+)\.py|-m recipes\.(studies\.\w+))([^;`#]*)", line):
            yield match[1] or match[2], re.findall(r'"[^"]*"|[^\s"]+', match[3])


def links(text):
    """Targets of links and pictures that lie in the repository."""
    targets = _LINK.findall(_FENCED.sub("", text))
    return [target for target in targets if not target.startswith(("http:", "https:"))]


def anchors(text):
    """What links to headings of a page may name."""
    titles = re.findall(r"^#+ (.+)$", _FENCED.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def tables(text):
    """Header of every table that nothing generates."""
    rest = re.sub(r"<!-- table: .*?<!-- end -->", "", text, flags=re.DOTALL)
    return re.findall(r"^(\|.*\|)\n\|[-:| ]+\|$", rest, re.MULTILINE)
