"""Docstrings as Markdown, an extension of griffe: roles become code, ``::`` a colon, and bare doctests are fenced."""

import re

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):(`+)~?([^`]+)\1")
LITERAL = re.compile(r"::$", re.MULTILINE)
DOCTEST = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)  # from its first line to the next empty one


def to_markdown(text: str) -> str:
    """Rewrite what Markdown would read otherwise."""
    text = LITERAL.sub(":", ROLE.sub(r"`\2`", text))
    return DOCTEST.sub(r"```pycon\n\g<0>\n```", text)


class PlainMarkdown(griffe.Extension):
    """Rewrites every docstring when it is read."""

    def on_object(self, *, obj: griffe.Object, **kwargs) -> None:
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
