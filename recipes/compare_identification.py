"""Compare simulators of an arm: how far each drifts from recordings when it gets their commands alone.

python recipes/compare_identification.py --simulators outputs/identification/*

Mean squared error of the position, over whole takes (24 s, 5 min and the 5 s throw), over 20 s and over 0.5 s windows;
a table, a figure and all numbers. Square, sine and the first Gaussian take were seen in training; the second Gaussian
take and the throw were not. What a simulator scored is kept beside it under digests of takes and simulator, so that the
same command goes on after Ctrl-C. Simulators for domain randomisation are left out: until an episode draws an arm, they
are the default one.
Results and figure: docs/identification.md.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm import tqdm

from torchrl_athletic.identification import Replay, Result, Simulator, compare, digest_of, figure, open_loop, table
from torchrl_athletic.identification.comparison import every_seed
from torchrl_athletic.recordings import Recording, read_recordings
from torchrl_athletic.robots import from_mjcf, z1
from torchrl_athletic.training import with_gains_of


@dataclass(frozen=True)
class Config:
    recordings: Path = Path("outputs/recordings/z1")
    """Folder of takes."""
    simulators: tuple[Path, ...] = field(
        default_factory=lambda: tuple(sorted(Path("outputs/identification").glob("*")))
    )
    """Folders that methods of identification wrote."""
    output: Path = Path("outputs/comparison")
    """Folder for the table, the numbers and the figure."""
    robot: str = "z1"
    """``z1``, or the path of an MJCF."""
    windows: tuple[float, ...] = (20.0, 0.5)
    """Beside whole takes: after how long rollouts start anew from the measured state [s]."""


def main(cfg: Config) -> None:
    torch.set_num_threads(1)  # a batch of rollouts is too small for more
    takes = read_recordings(cfg.recordings)
    robot = with_gains_of(z1() if cfg.robot == "z1" else from_mjcf(cfg.robot), takes)
    groups = {name: [t for t in takes if group_of(t) == name] for name in dict.fromkeys(map(group_of, takes))}
    found = {f: Simulator.load(f, robot) for f in cfg.simulators if (f / "simulator.json").exists()}
    judged = {folder: simulator for folder, simulator in found.items() if simulator.randomization is None}
    if not judged:
        raise SystemExit("none of the folders holds a simulator to compare. Make some: recipes/identify.py.")
    refuse_twins(judged)
    results: list[Result] = []
    for folder, simulator in (bar := tqdm(judged.items())):
        bar.set_postfix_str(folder.name)
        results += scored(folder, simulator, groups, (None, *cfg.windows))
    cfg.output.mkdir(parents=True, exist_ok=True)
    (cfg.output / "comparison.json").write_text(json.dumps([r.to_json() for r in results], indent=1))
    (cfg.output / "comparison.md").write_text(table(results) + "\n" + every_seed(results))
    figure(results, examples(list(judged.values()), groups), cfg.output / "comparison.svg")
    print(table(results))
    print("numbers, table and figure:", cfg.output)


def refuse_twins(judged: dict[Path, Simulator]) -> None:
    """One method and seed counts once in a mean."""
    seen: dict[tuple[str, int], Path] = {}
    for folder, simulator in judged.items():
        key = simulator.name, int(simulator.notes.get("seed", 0))
        if key in seen:
            raise SystemExit(
                f"{seen[key]} and {folder} both hold seed {key[1]} of {key[0]!r}. Move one of them out of the way, or "
                "name the folders to compare with --simulators."
            )
        seen[key] = folder


def group_of(take: Recording) -> str:
    kind, aside = str(take.metadata.get("kind")), take.metadata.get("split") == "heldout"
    if kind in ("square", "sine"):
        return "square & sine"
    return {"gaussian": "Gaussian", "throw": "throw"}.get(kind, kind) + (", unseen" if aside else "")


def scored(
    folder: Path, simulator: Simulator, groups: dict[str, list[Recording]], windows: Sequence[float | None]
) -> list[Result]:
    """From the file beside the simulator, if that and the takes are the same, down to the numbers."""
    kept = folder / "scores.json"
    asked: dict[str, Any] = {"windows": [None if w is None else f"{w:g} s" for w in windows]}
    asked |= {"simulator": simulator.digest, "takes": {name: digest_of(of) for name, of in groups.items()}}
    content = json.loads(kept.read_text()) if kept.exists() else {}
    if all(content.get(name) == value for name, value in asked.items()):
        return [Result(**result) for result in content["results"]]
    results = compare(simulator, groups, windows)
    kept.write_text(json.dumps(asked | {"results": [r.to_json() for r in results]}, indent=1))
    return results


def examples(simulators: Sequence[Simulator], groups: dict[str, list[Recording]]) -> dict[str, dict[str, Replay]]:
    """Rollouts of the first seed of each method: of a take that was fitted, and of the throw."""
    shown = {"fitted: Gaussian": [t.slice(0, 4000) for t in groups.get("Gaussian", [])[:1]], "not seen: throw": []}
    shown["not seen: throw"] = groups.get("throw, unseen", [])[:1]
    first = {s.name: s for s in reversed(list(simulators))}
    return {
        title: {name: open_loop(simulator, takes)[0] for name, simulator in first.items()}
        for title, takes in shown.items()
        if takes
    }


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
