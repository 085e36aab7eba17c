"""Does a throw learnt in an identified simulator fly as far on the real arm? The paper's figure 3.

    python benchmarks/throw_transfer.py train outputs/identification/*                        # on two cores
    python benchmarks/throw_transfer.py train outputs/identification/* --device cuda --num-envs 2048 --jobs 4
    python benchmarks/throw_transfer.py score outputs/throw/* --results benchmarks/results

``train`` runs ``recipes/throw_arm.py`` in each simulator, several at a time, and leaves a folder for each under
``--output``; what is there already stays. ``score`` throws ten times with each policy, in its own simulator and on the
concealed arm, which stands for the real one, from the same starts, and writes ``throw_transfer.md``, ``.json`` and
``.svg``. On the concealed arm a policy sees what drives report, no more; where the ball goes follows from the true
motion of the bucket by the very lines that say so in training. ``reference`` is the throw made by hand, without a
policy.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, pstdev
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from tqdm import tqdm

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))  # last: the package under test is the installed one

from benchmarks.concealed.arm import ConcealedArm  # noqa: E402
from torchrl_athletic.envs import BallFlight, throw_distance, throw_task  # noqa: E402
from torchrl_athletic.envs.throw import BUCKET, STEPS  # noqa: E402
from torchrl_athletic.identification import Simulator  # noqa: E402
from torchrl_athletic.networks import load_checkpoint  # noqa: E402
from torchrl_athletic.robots import with_bucket, z1  # noqa: E402
from torchrl_athletic.training import play  # noqa: E402
from torchrl_athletic.transforms import Decimation  # noqa: E402

RECIPE = ROOT / "recipes" / "throw_arm.py"
METHODS = ("reference", "default", "roa", "dr", "cem", "actuator_net", "uan", "diagnosed", "diagnosed_uan")
"""In the order of the figure; others follow."""
TOLERANCE = 0.05
"""How far a joint may be beyond its range in a throw that counts [rad]."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    action: Annotated[Literal["train", "score"], tyro.conf.Positional]
    """Train policies, or throw with them."""
    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Of simulators to train in, or of policies to score."""
    output: Path = Path("outputs/throw")
    """Where folders of policies go."""
    results: Path = Path("benchmarks/results")
    """Where table and figure go."""
    seeds: tuple[int, ...] = (0,)
    """Of training, each in every simulator."""
    jobs: int = 2
    """Trainings at a time, which share the cores."""
    iterations: int = 120
    """Of each, so that all have learnt from as many samples."""
    minutes: float = 20.0
    """Of each at most [min]; what was stopped goes on from its checkpoint when it is trained again."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    num_envs: int = 512
    """Of each training."""
    evaluate_every: int = 60
    """Iterations between measurements, each of which takes as long as some tens of iterations."""
    throws: int = 10
    """With each policy."""
    timeout: float = 2.0
    """Minutes after its own that a training is stopped."""


@dataclass(frozen=True)
class Throws:
    """What came of one policy."""

    method: str
    name: str
    """Of the folder."""
    simulated: list[float]
    """[m]; 0 where the throw failed."""
    real: list[float]
    """[m]."""
    failed: list[bool]
    """On the real arm."""

    @property
    def differences(self) -> list[float]:
        """Throw by throw [m]."""
        return [abs(a - b) for a, b in zip(self.simulated, self.real, strict=True)]


def main(cfg: Config) -> None:
    if cfg.action == "train":
        train_all(cfg)
        return
    arms = [ConcealedArm(robot=with_bucket(z1(), BUCKET), seed=k) for k in range(cfg.throws)]
    folders = [Path("reference"), *(folder for folder in cfg.folders if (folder / "policy.pt").exists())]
    found = [score(folder, arms) for folder in tqdm(folders)]
    cfg.results.mkdir(parents=True, exist_ok=True)
    content = json.dumps([asdict(throws) for throws in found], indent=1)
    (cfg.results / "throw_transfer.json").write_text(content + "\n", encoding="utf-8")
    (cfg.results / "throw_transfer.md").write_text(markdown(found), encoding="utf-8")
    draw(found, cfg.results / "throw_transfer.svg")
    print(markdown(found))


def train_all(cfg: Config) -> None:
    """Policies that are not there yet, ``jobs`` at a time; each has a log of its own."""
    waiting = [
        (folder, seed, cfg.output / f"{folder.name}-{seed}")
        for seed in cfg.seeds
        for folder in cfg.folders
        if (folder / "simulator.json").exists() and not (cfg.output / f"{folder.name}-{seed}" / "policy.pt").exists()
    ]
    running: list[tuple[subprocess.Popen[bytes], float, Path]] = []
    limit = 60 * (cfg.minutes + cfg.timeout)
    with tqdm(total=len(waiting)) as bar:
        while waiting or running:
            while waiting and len(running) < cfg.jobs:
                running.append(start(*waiting.pop(0), cfg))
            time.sleep(1.0)
            for job in list(running):
                process, began, output = job
                if process.poll() is None and time.monotonic() - began > limit:
                    process.kill()
                    process.wait()
                if process.returncode is not None:
                    running.remove(job)
                    bar.update()
                    tqdm.write(f"{output.name}: {last_line(output / 'log.txt', process.returncode)}")


def start(folder: Path, seed: int, output: Path, cfg: Config) -> tuple[subprocess.Popen[bytes], float, Path]:
    """A training as a process of its own."""
    output.mkdir(parents=True, exist_ok=True)
    flags = {
        "simulator": folder,
        "seed": seed,
        "output": output,
        "iterations": cfg.iterations,
        "minutes": cfg.minutes,
        "device": cfg.device,
        "ppo.num-envs": cfg.num_envs,
        "evaluate-every": cfg.evaluate_every,
    }
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    threads = str(max(1, len(os.sched_getaffinity(0)) // cfg.jobs))
    with (output / "log.txt").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, str(RECIPE), *words],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | {"OMP_NUM_THREADS": threads},
        )
    (output / "simulator.txt").write_text(f"{folder}\n", encoding="utf-8")
    return process, time.monotonic(), output


def last_line(log: Path, code: int) -> str:
    lines = log.read_text(errors="replace").replace("\r", "\n").strip().splitlines()
    measured = [line for line in lines if " m, " in line and "failed" in line]
    return measured[-1] if measured else f"ended with {code}: {lines[-1] if lines else 'said nothing'}"


def score(folder: Path, arms: Sequence[ConcealedArm]) -> Throws:
    """Throws from the same starts, in the policy's own simulator and on the arm.

    Args:
        folder: With ``policy.pt`` and ``simulator.txt``; one that is called ``reference`` needs neither.
        arms: The same arm again and again, one for each throw.
    """
    recipe = load_recipe()
    alone = folder.name == "reference"
    simulator: Simulator = recipe.load_simulator(
        None if alone else Path((folder / "simulator.txt").read_text(encoding="utf-8").strip())
    )
    env = recipe.make_env(simulator, len(arms), seed=7, randomize=False, ends=False, tolerance=TOLERANCE)
    policy = stay_on_reference if alone else load_policy(recipe, folder / "policy.pt")
    steps = play(env, policy, STEPS)
    simulated = steps[:, -1]["next"]
    real = throw_with(arms, policy, starts=steps["joint_position"][:, 0])
    return Throws(
        "reference" if alone else simulator.name,
        folder.name,
        throw_distance(simulated).tolist(),
        throw_distance(real).tolist(),
        real["throw_failed"].flatten().tolist(),
    )


def load_policy(recipe: Any, path: Path) -> Callable[[TensorDictBase], TensorDictBase]:
    """What the recipe saved, as it acts on a robot."""
    sizes = torch.load(path, map_location="cpu", weights_only=True)["metadata"]["sizes"]
    policy = recipe.make_policy(**sizes)
    load_checkpoint(path, policy=policy)
    return recipe.deployed(policy, sizes["adapts_to"])


def throw_with(
    arms: Sequence[ConcealedArm], policy: Callable[[TensorDictBase], TensorDictBase], starts: Tensor
) -> TensorDictBase:
    """What a throw with each arm ends with. Shape (N,)."""
    task = throw_task(arms[0].robot, ends=False, tolerance=TOLERANCE)
    env = TransformedEnv(ArmEnv(arms, starts), Compose(BallFlight(1 / arms[0].rate), Decimation(4), *task))
    return play(env, policy, STEPS)[:, -1]["next"]


def stay_on_reference(step: TensorDictBase) -> TensorDictBase:
    return step.set("action", torch.zeros(*step.shape, 6))


class ArmEnv(EnvBase):
    """Arms that take position targets and 5 ms for each, beside which cameras follow the buckets.

    Shows what :class:`~torchrl_athletic.envs.TorqueEnv` does; joints as the drives report them.

    Args:
        arms: Each with ``reset``, ``step`` and ``true_state``.
        starts: Joint positions to start from [rad]. Shape (N, J).
    """

    def __init__(self, arms: Sequence[ConcealedArm], starts: Tensor) -> None:
        count, joints = starts.shape
        super().__init__(batch_size=[count])
        self.arms, self.starts = arms, starts
        widths = {"joint_position": joints, "joint_velocity": joints, "applied_torque": joints, "arm_force": 3}
        widths |= dict.fromkeys(("bucket_position", "bucket_linear_velocity", "bucket_axis"), 3)
        shown = {key: Unbounded(shape=(count, width)) for key, width in widths.items()}
        self.observation_spec = Composite(shown, shape=[count])
        self.action_spec = Composite(action=Unbounded(shape=(count, joints)), shape=[count])
        self.reward_spec = Unbounded(shape=(count, 1))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        starts = self.starts.double().numpy()
        return self._shown([arm.reset(start) for arm, start in zip(self.arms, starts, strict=True)])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        targets = tensordict["action"].double().numpy()
        shown = self._shown([arm.step(target) for arm, target in zip(self.arms, targets, strict=True)])
        return shown.set("reward", torch.zeros(*self.batch_size, 1))

    def _set_seed(self, seed: int | None) -> None:
        """The arms have their own."""

    def _shown(self, readings: Sequence[Any]) -> TensorDict:
        states = [arm.true_state() for arm in self.arms]
        values = {
            "joint_position": [reading.position for reading in readings],
            "joint_velocity": [reading.velocity for reading in readings],
            "applied_torque": [reading.torque for reading in readings],
            "arm_force": [np.zeros(3)] * len(states),
            "bucket_position": [state.site_position for state in states],
            "bucket_linear_velocity": [state.site_velocity for state in states],
            "bucket_axis": [state.site_rotation[:, 2] for state in states],
        }
        shown = {key: torch.from_numpy(np.stack(rows)).float() for key, rows in values.items()}
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        flags = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        return TensorDict({**shown, **flags}, batch_size=self.batch_size)


def load_recipe() -> Any:
    """The recipe as a module."""
    spec = importlib.util.spec_from_file_location("recipes_throw_arm", RECIPE)
    assert spec is not None
    assert spec.loader is not None
    if spec.name not in sys.modules:
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # where dataclasses look for annotations
        spec.loader.exec_module(module)
    return sys.modules[spec.name]


def by_method(found: Iterable[Throws]) -> dict[str, list[Throws]]:
    """In the figure's order."""
    groups: dict[str, list[Throws]] = {}
    for throws in found:
        groups.setdefault(throws.method, []).append(throws)
    known = [method for method in METHODS if method in groups]
    return {method: groups[method] for method in (*known, *sorted(set(groups) - set(known)))}


def markdown(found: Iterable[Throws]) -> str:
    """A row for each policy, and the mean of each method that has several."""
    lines = [
        "| simulator | policy | simulated | real | difference | share | real throws that failed |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, group in by_method(found).items():
        rows = [(throws.name, [throws]) for throws in group]
        if len(group) > 1:
            rows.append((f"mean of {len(group)}", group))
        lines += [f"| {method} | {name} | {cells(some)} |" for name, some in rows]
    return "\n".join(lines) + "\n"


def cells(some: list[Throws]) -> str:
    simulated, real, differences = gathered(some)
    share = f"{100 * fmean(differences) / fmean(simulated):.1f} %" if fmean(simulated) > 0 else "-"
    failed = sum(sum(throws.failed) for throws in some)
    numbers = " | ".join(f"{fmean(x):.3f} ± {pstdev(x):.3f} m" for x in (simulated, real, differences))
    return f"{numbers} | {share} | {failed} of {len(real)}"


def gathered(some: list[Throws]) -> tuple[list[float], list[float], list[float]]:
    """All throws of several policies: simulated, real, difference [m]."""
    return (
        [x for throws in some for x in throws.simulated],
        [x for throws in some for x in throws.real],
        [x for throws in some for x in throws.differences],
    )


def draw(found: Iterable[Throws], path: Path) -> None:
    """Two bar charts: how far simulation and reality are apart, and how far the real arm throws."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    groups = by_method(found)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4))
    place = np.arange(len(groups))
    colours = [f"C{k}" for k in range(len(groups))]
    for axes, which, title in (
        (left, 2, "simulated less real distance, absolute [m]"),
        (right, 1, "real throw distance [m]"),
    ):
        values = [gathered(group)[which] for group in groups.values()]
        heights, spreads = [fmean(x) for x in values], [pstdev(x) for x in values]
        axes.bar(place, heights, yerr=spreads, capsize=3, color=colours, edgecolor="black")
        for x, group in zip(place, groups.values(), strict=True):
            each = [fmean((throws.simulated, throws.real, throws.differences)[which]) for throws in group]
            axes.plot([x] * len(each), each, "k.", markersize=4)
        axes.set_xticks(place, list(groups), rotation=30, ha="right")
        axes.set_title(title, fontsize="medium")
        axes.grid(axis="y", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
