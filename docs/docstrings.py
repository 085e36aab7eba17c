"""Docstrings are written in reStructuredText, pages in Markdown: turn roles into code and formulas into MathML."""

import re
from typing import Any

import griffe
from latex2mathml.converter import convert

ROLE = re.compile(r":(?:attr|class|func|meth|mod):`~?([^`]+)`")
DISPLAY = re.compile(r"^([ \t]*)\.\. math::[ \t]*(.*(?:\n(?:\1[ \t]+\S.*|[ \t]*(?=\n\1[ \t]+\S)))*)", re.M)
EXAMPLE = re.compile(r"^([ \t]*)Example:$", re.M)
INLINE = re.compile(r":math:`([^`]+)`")


def markdown(docstring: str) -> str:
    """The docstring as Markdown with MathML, which browsers draw without a script."""
    docstring = DISPLAY.sub(_display, docstring)
    docstring = INLINE.sub(lambda match: convert(match[1]), docstring)
    docstring = EXAMPLE.sub(r"\1Examples:", docstring)  # the name that the parser knows
    return ROLE.sub(r"`\1`", docstring)


def _display(match: re.Match[str]) -> str:
    formulas = [" ".join(paragraph.split()) for paragraph in re.split(r"\n[ \t]*\n", match[2].strip())]
    return "\n".join(f"{match[1]}<p>{convert(formula, display='block')}</p>" for formula in formulas)


class Docstrings(griffe.Extension):
    """Rewrite each docstring when it is found."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)
