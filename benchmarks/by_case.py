"""What benchmarks that run case by case share: results that stay, and where and from what they were made."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]


def run_cases(
    cases: Sequence[str], run: Callable[[str], Row], table: Callable[[Mapping[str, Row]], str], output: Path
) -> None:
    """Run some cases; their rows replace older ones in ``output`` and the JSON beside it, the others stay."""
    store = output.with_suffix(".json")
    rows = json.loads(store.read_text()) if store.exists() else {}
    for case in cases:
        rows[case] = {**run(case), "commit": commit(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
        store.parent.mkdir(parents=True, exist_ok=True)
        store.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
        output.write_text(table(rows))
        print(table({case: rows[case]}))


def commit() -> str:
    """Commit of the working tree, or what ``COMMIT`` says."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or os.environ.get("COMMIT", "unknown")
