"""The page on the contract lists every clause with what has to hold."""

import importlib.util
import re
from pathlib import Path

from torchrl_athletic.testing import TransformContract

DOCS = Path(__file__).parents[2] / "docs"


def test_every_clause_stands_in_the_table_with_a_sentence():
    spec = importlib.util.spec_from_file_location("tables", DOCS / "tables.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    page = hook.on_page_markdown((DOCS / "testing.md").read_text(encoding="utf-8"))
    listed = set(re.findall(r"^\| `(\w+)` \| [^|]{20,} \|$", page, re.M))
    clauses = {name.removeprefix("test_") for name in dir(TransformContract) if name.startswith("test_")}
    assert clauses <= listed
