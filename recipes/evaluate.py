"""Examine a whole-body controller: 1,000 whole episodes of 20 s in each condition, falls and errors.

python recipes/evaluate.py                                            # the shipped one: two hours of two cores
python recipes/evaluate.py --conditions "all randomised" --episodes 200            # a look, in five minutes
python recipes/evaluate.py --policy outputs/pretrain_wbc/wbc.npz --device cuda --batch 4096

Leaves ``evaluation.json``, a table and a picture of it, and videos of a good and, if there was one, a failed episode.
The same command goes on after Ctrl-C. What came out: docs/whole_body.md.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from torchrl_athletic import training
from torchrl_athletic.envs import draw_command
from torchrl_athletic.functional.commands import CommandName, command_ranges
from torchrl_athletic.networks import pretrained, read_metadata, read_network, shipped_path


@dataclass(frozen=True)
class Config:
    policy: str = "wbc"
    """Name of a shipped network, or a file that ``pretrain_wbc.py`` wrote."""
    conditions: tuple[str, ...] = ()
    """Names of conditions; none takes all."""
    episodes: int = 1000
    """In each condition."""
    seconds: float = 20.0
    """Length of an episode [s]."""
    batch: int = 500
    """Robots at once."""
    seed: int = 1_000_003
    """Seed of robots, commands and pushes: other than in training."""
    commands: CommandName | None = None
    """Goals of the hand, as of ``pretrain_wbc.py``; None takes those that the policy was trained on."""
    actuation: str | None = None
    """Actuation of the arm, as of ``pretrain_wbc.py``; None takes that with which the policy was trained."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the simulation."""
    video: bool = True
    """Whether to draw episodes."""
    output: Path = Path("outputs/evaluate")
    """Folder for all that is written."""


TRIES = 5
"""Most robots that are played again in search of one that falls again."""


def main(cfg: Config) -> None:
    for name in ("episodes", "seconds", "batch"):
        if not getattr(cfg, name) > 0:
            raise SystemExit(f"{name} is {getattr(cfg, name)}. Give more than 0.")
    own = cfg.policy.endswith(".npz")
    if own and not Path(cfg.policy).is_file():
        raise SystemExit(f"there is no file {cfg.policy}. Give one that pretrain_wbc.py wrote, or a shipped name.")
    policy: Any = (read_network(cfg.policy) if own else pretrained(cfg.policy)).to(cfg.device)
    trained = read_metadata(cfg.policy if own else shipped_path(cfg.policy))
    if list(getattr(policy, "in_keys", ())) != ["observation"]:
        raise SystemExit(f"{cfg.policy} is no controller: it does not act on 'observation'. Give a policy, as wbc.")
    told: dict[str, Any] = {"seed": cfg.seed, "history": trained.get("history", 10)}
    told["actuation"] = cfg.actuation or trained.get("actuation", "uan")
    told["commands"] = command_ranges(cfg.commands or training.commands_of(cfg.policy))
    known = training.wbc_conditions()
    if unknown := [name for name in cfg.conditions if name not in known]:
        raise SystemExit(f"there is no condition {unknown[0]!r}; there are {sorted(known)}.")
    chosen = {name: known[name] for name in cfg.conditions or known}
    results = training.examine(
        policy,
        chosen,
        cfg.output / "evaluation.json",
        episodes=cfg.episodes,
        steps=round(50 * cfg.seconds),
        batch=cfg.batch,
        device=cfg.device,
        **told,
    )
    results = {name: results[name] for name in chosen}
    (cfg.output / "evaluation.md").write_text(training.table_of(results) + "\n")
    print(training.table_of(results))
    print("picture:", training.draw_conditions(results, cfg.output / "evaluation.svg"))
    if cfg.video:
        draw(cfg, policy.to("cpu"), chosen, results, told)


def draw(
    cfg: Config, policy: Any, chosen: dict[str, training.Condition], results: dict[str, Any], told: dict[str, Any]
) -> None:
    """The first good and the first failed episode, if there are such, played again.

    What is played alone differs from what was counted by rounding, so that a robot that fell may stay up: then the next
    one is played.
    """
    steps = round(50 * cfg.seconds)
    fell = {(name, row): row in results[name]["fallen"] for name in chosen for row in range(cfg.episodes)}
    for kind, wanted in {"good": False, "failed": True}.items():
        for ending in ("mp4", "gif", "png"):  # of an earlier examination
            (cfg.output / f"{kind}.{ending}").unlink(missing_ok=True)
        for condition, row in [key for key, failed in fell.items() if failed == wanted][:TRIES]:
            env = chosen[condition].env(1, max_steps=steps, first_row=row, **told)
            frames = training.draw_episode(env, policy, steps, (360, 480), annotate=draw_command, follow="base")
            if (len(frames) < steps) == wanted:
                path = training.write_video(frames, cfg.output / f"{kind}.mp4", 50.0)
                print(f"{kind}, {condition}, robot {row}: {path}")
                last = frames if kind == "good" else frames[-100:]  # the two seconds before the end
                training.frame_strip(last, 6, cfg.output / f"{kind}.png")
                break
        else:
            print(f"{kind}: no video, since no episode was so, or none was again when it was played alone.")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(tyro.cli(Config, description=__doc__))
