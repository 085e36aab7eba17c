"""How far does the concealed arm throw if the throw is searched on the arm itself, with no simulator at all?

    python benchmarks/throw_search.py --seeds 0 1 2

Takes the throw made by hand and moves its position targets, at twelve times for the three joints of the plane that it
swings in, by CMA-ES on the distance on the concealed arm: a thousand throws that nobody could make on a real one.
Then throws ten times from the starts that policies are scored from. A search is no proof that nothing throws farther,
but nothing that is learnt in a simulator has this advantage. Writes ``throw_search.md``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))  # last: the package under test is the installed one

from benchmarks.concealed.arm import ConcealedArm  # noqa: E402
from benchmarks.throw_transfer import Policy, load_recipe, real_env, simulated_env, throw_all  # noqa: E402
from torchrl_athletic.envs import throw_distance  # noqa: E402
from torchrl_athletic.envs.throw import BUCKET, DT, STEPS  # noqa: E402
from torchrl_athletic.robots import with_bucket, z1  # noqa: E402

Array = NDArray[np.float64]

KNOTS = np.array([1.9, *np.arange(2.5, 3.55, 0.1)])
"""When targets may be moved [s]: back, and all through the throw. Between them in a straight line."""
BEGIN = 1.4
"""Until then nothing is moved [s]."""
SWINGING = (1, 2, 3)
"""Shoulder, elbow and wrist, whose axes are parallel."""
SIGMA = 0.3
"""Standard deviation of the first generation [rad]."""


@dataclass(frozen=True)
class Config:
    seeds: tuple[int, ...] = (0,)
    """Seeds of the search, one after another."""
    generations: int = 60
    population: int = 16
    """Throws of a generation."""
    throws: int = 10
    """With the best targets, from the starts that policies are scored from."""
    results: Path = Path("benchmarks/results")


def main(cfg: Config) -> None:
    begin = starts(cfg.throws)
    by_hand = distances(np.zeros((1, len(KNOTS), len(SWINGING))), begin)
    lines = ["| targets | searched throw [m] | real throws [m] | farthest [m] |", "|---|---|---|---|"]
    lines.append(f"| by hand | | {by_hand.mean():.2f} ± {by_hand.std():.2f} | {by_hand.max():.2f} |")
    for seed in cfg.seeds:
        targets, best = search(cfg, seed)
        real = distances(targets[None], begin)
        lines.append(f"| seed {seed} | {best:.2f} | {real.mean():.2f} ± {real.std():.2f} | {real.max():.2f} |")
        table = "\n".join(lines)
        made = f"`python benchmarks/throw_search.py`, {cfg.generations} generations of {cfg.population} throws a seed."
        text = f"{table}\n\n{made}\n"
        (cfg.results / "throw_search.md").write_text(text, encoding="utf-8")
        print(table, flush=True)


def search(cfg: Config, seed: int) -> tuple[Array, float]:
    """The farthest throw that CMA-ES finds from the default pose: what is added at the knots [rad], and how far [m]."""
    from cmaes import CMA  # type: ignore[import-untyped]  # only this benchmark's search needs it

    shape = len(KNOTS), len(SWINGING)
    optimizer = CMA(np.zeros(shape).ravel(), SIGMA, seed=seed, population_size=cfg.population)
    home = torch.tensor(with_bucket(z1(), BUCKET).default_pose)[None].expand(cfg.population, -1)
    best, found = -np.inf, np.zeros(shape)
    for _ in tqdm(range(cfg.generations), desc=f"seed {seed}"):
        asked = [optimizer.ask() for _ in range(cfg.population)]
        far = distances(np.stack(asked).reshape(-1, *shape), home)
        optimizer.tell([(x, -float(d)) for x, d in zip(asked, far, strict=True)])
        if far.max() > best:
            best, found = float(far.max()), asked[int(far.argmax())].reshape(shape)
    return found, best


def starts(count: int) -> Tensor:
    """As of ``throw_transfer.py``. Shape (count, J) [rad]."""
    rows: Tensor = simulated_env(load_recipe().load_simulator(None), count).reset()["joint_position"]
    return rows


def distances(knots: Array, begin: Tensor) -> Array:
    """Distances of throws on the arm, 0 where one fails [m].

    Args:
        knots: What is added to targets [rad]. Shape (1 or N, K, joints).
        begin: Where the arm starts [rad]. Shape (N, J).

    Returns:
        Shape (N,).
    """
    robot = with_bucket(z1(), BUCKET)
    arms = [ConcealedArm(robot=robot, seed=k) for k in range(len(begin))]
    end = throw_all(real_env(arms, begin), along(actions(knots)))
    return throw_distance(end).double().numpy()


def actions(knots: Array) -> Tensor:
    """What is added to the reference at every step of a policy [rad]. Shape (N, STEPS, 6)."""
    time, out = np.arange(STEPS) * DT, np.zeros((len(knots), STEPS, 6))
    for row, of in zip(out, knots, strict=True):
        for joint, values in zip(SWINGING, of.T, strict=True):
            row[:, joint] = np.interp(time, [BEGIN, *KNOTS], [0.0, *values])
    return torch.from_numpy(out).float()


def along(planned: Tensor) -> Policy:
    """A policy that plays what is planned, whatever happens."""
    steps = iter(planned.unbind(1))
    return lambda tensordict: tensordict.set("action", next(steps).expand(*tensordict.shape, -1))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
