"""The ablation of the throw as a table and a picture: ``python -m benchmarks.throw_ablation``.

``benchmarks/results/throw_ablation.json`` holds the figures, and the commands, the commit and the machine that made
them.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

RESULTS = Path("benchmarks/results/throw_ablation.json")
PICTURE = Path("docs/images/throw_ablation.svg")
MEANS = {"release_speed_m_s": ".1f", "peak_leg_power_kw": ".1f", "peak_arm_speed_rad_s": ".0f", "failed": ".0%"}


def main() -> None:
    kept = json.loads(RESULTS.read_text(encoding="utf-8"))
    RESULTS.with_suffix(".md").write_text(table(kept["figures"], kept["minutes"]), encoding="utf-8")
    importlib.import_module("ablate_finetuning").draw(kept["figures"], PICTURE)
    print(RESULTS.with_suffix(".md").read_text(encoding="utf-8"), PICTURE)


def table(found: dict[str, list[dict[str, float]]], minutes: dict[str, str]) -> str:
    """Distances by seed, and means over seeds."""
    lines = [
        "| | minutes | distance by seed [m] | mean [m] | release [m/s] | leg power [kW] | arm, peak [rad/s] | failed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for way, rows in found.items():
        distances = [row["distance_m"] for row in rows]
        means = [f"{np.mean([row[key] for row in rows]):{how}}" for key, how in MEANS.items()]
        seeds = ", ".join(f"{d:.1f}" for d in distances)
        lines.append(f"| {way} | {minutes[way]} | {seeds} | {np.mean(distances):.1f} | {' | '.join(means)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
