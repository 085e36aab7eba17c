"""What pre-training and tuning are each worth: the paper's four ways to a throw, side by side.

python recipes/ablate_finetuning.py                  # CPU: nine minutes for each way and seed, a small version
python recipes/ablate_finetuning.py --device cuda    # the paper's scale: 15 minutes each

``No-Fine-Tuning`` is the controller that follows the reference; ``No-Pre-Training`` begins anew; ``No-E2E`` is a policy
that commands the frozen controller; ``Ours`` goes on from the controller. Each throws 100 times. Leaves a table and a
picture; the same command goes on after Ctrl-C or a crash. What came out: docs/task_throw.md.
"""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads of torch that spin would take cores from the physics
import numpy as np
import tyro
from finetune_throw import CURVES, KNOWN, LOOK_AT, STEPS, judge, make_env  # type: ignore[import-not-found]
from torchrl.envs import TransformedEnv

from torchrl_athletic import training
from torchrl_athletic.envs import FrozenController

FIGURES = {"distance_m": "distance [m]", "release_speed_m_s": "release [m/s]", "peak_leg_power_kw": "leg power [kW]"}
START = "wbc_wide"
"""The controller, which takes its hand behind its head as the throw does."""
ANEW = replace(training.PRE_TRAIN, entropy_coeff=0.0, warm_up=training.FINE_TUNE.warm_up)
"""As in the pre-training, but for no bonus for entropy, and batches that are left out as in a tuning."""
WAYS: dict[str, dict[str, Any]] = {
    "No-Fine-Tuning": {"iterations": 0},
    "No-Pre-Training": {"start": None, "ppo": ANEW},
    "No-E2E": {"start": None, "ppo": ANEW},
    "Ours": {"ppo": replace(training.FINE_TUNE, critic_first=40)},
}


@dataclass(frozen=True)
class Config:
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the trainings."""
    minutes: float | None = None
    """Duration of each training [min]; None takes 9 on CPUs and 15 on a GPU."""
    iterations: int | None = None
    """When to stop, the divergence falling from 0.02 to 0.003 until then; None takes 1,950 on a GPU without minutes."""
    num_envs: int | None = None
    """Robots; None takes 256 on CPUs and 4,096 on a GPU."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    ways: tuple[str, ...] = tuple(WAYS)
    """Which ones."""
    episodes: int = 100
    """Throws to judge each policy by."""
    output: Path = Path("outputs/ablate_finetuning")
    """Folder for all that is written."""


def main(cfg: Config) -> None:
    if unknown := [way for way in cfg.ways if way not in WAYS]:
        raise SystemExit(f"there is no way {unknown[0]!r}; there are {list(WAYS)}.")
    if not cfg.ways or not cfg.seeds:
        raise SystemExit(f"nothing to train: --ways {cfg.ways}, --seeds {cfg.seeds}. Name one of each at least.")
    found = {way: [thrown(way, seed, cfg) for seed in cfg.seeds] for way in cfg.ways}
    (cfg.output / "figures.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    lines = ["| | " + " | ".join(FIGURES.values()) + " | failed |", "|---" * (len(FIGURES) + 2) + "|"]
    for way, rows in found.items():
        cells = [
            f"{np.mean([row[key] for row in rows]):.2f} ± {np.std([row[key] for row in rows]):.2f}" for key in FIGURES
        ]
        lines.append(f"| {way} | {' | '.join(cells)} | {100 * np.mean([row['failed'] for row in rows]):.0f} % |")
    print("\n".join(lines))
    (cfg.output / "figures.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("picture:", draw(found, cfg.output / "figures.svg"))


def thrown(way: str, seed: int, cfg: Config) -> dict[str, float]:
    """Train one way, and throw."""
    same: dict[str, Any] = {key: getattr(cfg, key) for key in ("device", "minutes", "num_envs", "episodes")}
    whole = cfg.device == "cuda" and cfg.iterations is None and cfg.minutes is None
    same["iterations"] = 1950 if whole else cfg.iterations
    tune = training.FineTune(seed=seed, start=START, video=False, output=cfg.output / f"{way}_{seed}", **same)

    def make(num_envs: int, **told: Any) -> TransformedEnv:
        env = make_env(tune.actuation, num_envs, **told)
        return led(env) if way == "No-E2E" else env

    told = {"known": KNOWN, "curves": CURVES, "judge": judge, "look_at": LOOK_AT, "steps": STEPS}
    tune = replace(tune, **WAYS[way])
    if tune.iterations:
        tune = replace(tune, ppo=replace(tune.ppo, kl_target=0.02, kl_target_last=0.003, anneal=tune.iterations))
    return training.fine_tune(tune, make, name="throw", **told)


def led(env: TransformedEnv) -> TransformedEnv:
    """An action moves what the frozen controller is commanded, which is deaf to phases: it has learnt of none."""
    controller = training.controller_for(env, START)
    return env.append_transform(FrozenController(controller.to(env.device)))


def draw(found: dict[str, list[dict[str, float]]], path: Path) -> Path:
    """Bars of the means over seeds, a dot for each seed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3), layout="constrained")
    for axis, (key, title) in zip(figure.subplots(1, len(FIGURES)), FIGURES.items(), strict=True):
        for place, rows in enumerate(found.values()):
            values = [row[key] for row in rows]
            axis.bar(place, np.mean(values), color="tab:blue", alpha=0.6)
            axis.plot([place] * len(values), values, "k.", ms=4)
        axis.set_xticks(range(len(found)), found, fontsize=7, rotation=20, ha="right")
        axis.set_title(title, fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    return path


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
