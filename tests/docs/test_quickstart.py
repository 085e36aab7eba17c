"""The page of a first diagnosis lists every flag with its help."""

import importlib.util
import re
from dataclasses import fields
from pathlib import Path

from torchrl_athletic.diagnosis.command import Config

DOCS = Path(__file__).parents[2] / "docs"


def test_every_flag_stands_in_the_table_with_its_help():
    spec = importlib.util.spec_from_file_location("tables", DOCS / "tables.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    page = hook.on_page_markdown((DOCS / "quickstart.md").read_text(encoding="utf-8"))
    listed = re.findall(r"^\| `--([\w-]+)` \| [^|]{5,} \|$", page, re.M)
    assert listed == [{"continue_with": "continue"}.get(f.name, f.name.replace("_", "-")) for f in fields(Config)]
