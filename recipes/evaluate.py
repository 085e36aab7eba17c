"""Examine a whole-body controller: 1,000 whole episodes of 20 s in each condition, falls and errors.

python recipes/evaluate.py                                            # the shipped one: four hours of two cores
python recipes/evaluate.py --conditions "all randomised" --episodes 200            # a look, in five minutes
python recipes/evaluate.py --policy outputs/pretrain_wbc/wbc.npz --device cuda --batch 4096

Leaves ``evaluation.json``, a table and a picture of it, and videos of a good and, if there was one, a failed episode.
The same command goes on after Ctrl-C. What came out: docs/whole_body.md.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from torchrl_athletic import training
from torchrl_athletic.envs import draw_command
from torchrl_athletic.networks import pretrained, read_network, shipped_path


@dataclass(frozen=True)
class Config:
    policy: str = "wbc"
    """Name of a shipped network, or a file that ``pretrain_wbc.py`` wrote."""
    conditions: tuple[str, ...] = ()
    """Names of conditions; none takes all."""
    episodes: int = 1000
    """In each condition."""
    seconds: float = 20.0
    """Of an episode [s]."""
    batch: int = 500
    """Robots at once."""
    seed: int = 1_000_003
    """Of robots, commands and pushes: other than in training."""
    net: Literal["uan", "ideal"] = "uan"
    """Of the arm: the shipped actuator net, or ideal motors."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Of the simulation."""
    video: bool = True
    """Whether to draw episodes."""
    output: Path = Path("outputs/evaluate")
    """Folder for all that is written."""


def main(cfg: Config) -> None:
    path = Path(cfg.policy)
    path = path if path.suffix == ".npz" else shipped_path(cfg.policy)
    policy: Any = (read_network(path) if path == Path(cfg.policy) else pretrained(cfg.policy)).to(cfg.device)
    known = training.wbc_conditions()
    if unknown := [name for name in cfg.conditions if name not in known]:
        raise SystemExit(f"there is no condition {unknown[0]!r}; there are {sorted(known)}.")
    chosen = {name: known[name] for name in cfg.conditions or known}
    net = None if cfg.net == "ideal" else cfg.net
    results = training.examine(
        policy,
        chosen,
        cfg.output / "evaluation.json",
        episodes=cfg.episodes,
        steps=round(50 * cfg.seconds),
        batch=cfg.batch,
        seed=cfg.seed,
        made_of=f"{hashlib.sha256(path.read_bytes()).hexdigest()[:16]} {cfg.net}",
        device=cfg.device,
        net=net,
    )
    results = {name: results[name] for name in chosen}
    (cfg.output / "evaluation.md").write_text(training.table_of(results) + "\n")
    print(training.table_of(results))
    print("picture:", training.draw_conditions(results, cfg.output / "evaluation.svg"))
    if cfg.video:
        draw(cfg, policy.to("cpu"), chosen, results, net)


def draw(cfg: Config, policy: Any, chosen: dict[str, training.Condition], results: dict[str, Any], net: Any) -> None:
    """A good episode of the first condition, and a failed one of whichever has one: the very ones that were counted."""
    name = next(iter(chosen))
    good = next(row for row in range(cfg.episodes) if row not in results[name]["fallen"])
    episodes = {"good": (name, good)}
    if fallen := {other: row["fallen"][0] for other, row in results.items() if row["fallen"]}:
        episodes["failed"] = next(iter(fallen.items()))
    steps = round(50 * cfg.seconds)
    for kind, (condition, row) in episodes.items():
        env = chosen[condition].env(1, net=net, max_steps=steps, seed=cfg.seed, first_row=row)
        frames = training.draw_episode(env, policy, steps, (360, 480), annotate=draw_command, follow="base")
        print(f"{kind}, {condition}, robot {row}:", training.write_video(frames, cfg.output / f"{kind}.mp4", 50.0))
        last = frames if kind == "good" else frames[-100:]  # the two seconds before the end
        training.frame_strip(last, 6, cfg.output / f"{kind}.png")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(tyro.cli(Config, description=__doc__))
