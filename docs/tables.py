"""Write tables of flags, thresholds and the contract's clauses into the pages from the code: a hook of mkdocs."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = Path(__file__).parents[1] / "torchrl_athletic"
THRESHOLDS = {
    "<!-- thresholds of a diagnosis -->": (
        "recordings.quality recordings.resampling effects.signals effects.base"
    ).split(),
    "<!-- thresholds of experiments -->": [],
}
SECTIONS = {
    "<!-- thresholds of a diagnosis -->": "Torques Search Simulation Decision Statement Spending".split(),
    "<!-- thresholds of experiments -->": ["Plan"],
}
"""Classes of diagnosis/thresholds.py."""
CLAUSES = "<!-- clauses of the contract -->"
FLAGS = "<!-- flags of a diagnosis -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put a table in the place of each marker."""
    for marker, modules in THRESHOLDS.items():
        if marker in markdown:
            markdown = markdown.replace(marker, thresholds(modules, SECTIONS[marker]))
    for marker, table in ((CLAUSES, clauses), (FLAGS, flags)):
        if marker in markdown:
            markdown = markdown.replace(marker, table())
    return markdown


def thresholds(modules: list[str], sections: list[str]) -> str:
    """A row for each number that is set by hand: of the diagnosis with unit and kind, of the other modules without."""
    rows = [f"| `{name}` | {' | '.join(rest)} |" for name, *rest in numbers(sections)]
    rows += [
        f"| `{module}.{name}` | {value} | | | {why} |" for module in modules for name, value, why in constants(module)
    ]
    return "\n".join(["| number | value | unit | kind | what it is |", "|---|---|---|---|---|", *rows])


def numbers(sections: list[str]) -> Iterator[tuple[str, str, str, str, str]]:
    """Name with its section, value, unit, kind and docstring of each field of the thresholds."""
    tree = ast.parse((PACKAGE / "diagnosis/thresholds.py").read_text(encoding="utf-8"))
    for section in (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name in sections):
        for field, after in pairwise(section.body):
            match field, after:
                case ast.AnnAssign(target=ast.Name(id=name), value=given), ast.Expr(value=ast.Constant(value=str(why))):
                    told = re.fullmatch(r"(.*) \[([^;\]]+); ([^\]]+)\]\.?", _line(why))
                    assert told is not None, f"{section.name}.{name} lacks its unit and kind"
                    value = f"{eval(ast.unparse(given), {'np': np}):g}"  # a number, such as 2 * np.log(20)
                    yield f"{section.name.lower()}.{name}", value, told[2], told[3], told[1]


def clauses() -> str:
    """A row for each test of the contract, with the sentence that its docstring begins with."""
    tree = ast.parse((PACKAGE / "testing/contract.py").read_text(encoding="utf-8"))
    tests = [f for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) and f.name.startswith("test_")]
    told = [(f.name.removeprefix("test_"), (ast.get_docstring(f) or "").split("\n\n")[0]) for f in tests]
    rows = [f"| `{name}` | {_line(sentence)} |" for name, sentence in told]
    return "\n".join(["| clause, after `test_` | what has to hold |", "|---|---|", *rows])


def flags() -> str:
    """A row for each flag of a diagnosis, with its help text."""
    tree = ast.parse((PACKAGE / "diagnosis/command.py").read_text(encoding="utf-8"))
    [config] = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Config"]
    rows = []
    for field, after in pairwise(config.body):
        match field, after:
            case ast.AnnAssign(target=ast.Name(id=name), annotation=kind), ast.Expr(value=ast.Constant(value=str(why))):
                said = re.search(r"arg\(name='(\w+)'\)", ast.unparse(kind))
                rows.append(f"| `--{said[1] if said else name.replace('_', '-')}` | {_line(why)} |")
    return "\n".join(["| flag | meaning |", "|---|---|", *rows])


def constants(module: str) -> Iterator[tuple[str, str, str]]:
    """Name, value and docstring of each number, or tuple of numbers, at the top of a module."""
    body = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")).body
    for statement, after in pairwise(body):
        match statement, after:
            case (
                ast.Assign(targets=[ast.Name(id=name)], value=given)
                | ast.AnnAssign(target=ast.Name(id=name), value=given),
                ast.Expr(value=ast.Constant(value=str(why))),
            ) if given and name.isupper() and not name.startswith("_"):
                if numbers := _numbers(given):
                    yield name, ", ".join(f"{number:g}" for number in numbers), _line(why)


def _numbers(value: ast.expr) -> tuple[float, ...]:
    try:
        given = ast.literal_eval(value)
    except ValueError:
        return ()
    found = given if isinstance(given, tuple) else (given,)
    return found if all(isinstance(each, int | float) and not isinstance(each, bool) for each in found) else ()


def _line(docstring: str) -> str:
    words = " ".join(docstring.split())
    for role in (":data:`", ":func:`", ":class:`", ":meth:`", ":mod:`"):
        words = words.replace(role, "`")
    return words.replace("``", "`").replace("|", "∣")
