"""Does a throw learnt in an identified simulator fly as far on the real arm? The paper's figure 3, and what it hides.

    python benchmarks/throw_transfer.py outputs/throw/* --results benchmarks/results --images docs/images

Throws ten times with each policy that ``train_throws.py`` left, from starts of its own: in the simulator that it was
trained in, in every other one, and on the concealed arm, which stands for the real one. There a policy sees what drives
report, no more; where the ball goes follows from the true motion of the bucket by the very lines that say so in
training. ``reference`` is the throw made by hand, without a policy. Writes ``throw_transfer.md`` and ``.json`` to one
folder, ``throw_transfer.svg`` (the paper's figure) and ``throw_matrix.svg`` (every policy in every world) to the other.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from tqdm import tqdm

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))  # last: the package under test is the installed one

from benchmarks.concealed.arm import ConcealedArm  # noqa: E402
from benchmarks.throw_report import (  # noqa: E402
    ARM,
    Score,
    Throws,
    draw,
    draw_matrix,
    in_order,
    markdown,
    samples_table,
)
from torchrl_athletic.envs import throw_distance, throw_env, throw_task  # noqa: E402
from torchrl_athletic.envs.throw import ARM_POWER, BUCKET, STEPS  # noqa: E402
from torchrl_athletic.identification import Simulator  # noqa: E402
from torchrl_athletic.networks import load_checkpoint  # noqa: E402
from torchrl_athletic.robots import with_bucket, z1  # noqa: E402
from torchrl_athletic.training.evaluation import acting  # noqa: E402
from torchrl_athletic.transforms import BallFlight, Decimation  # noqa: E402
from torchrl_athletic.transforms.stateful import StatefulTransform, spread  # noqa: E402

RECIPE = ROOT / "recipes" / "throw_arm.py"
TOLERANCE = 0.05
"""How far a joint may be beyond its range in a throw that counts [rad]."""
AT_RELEASE = ("release_time", "release_velocity", "release_joint_velocity")

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of policies."""
    results: Path = Path("benchmarks/results")
    """Where table and numbers go."""
    images: Path = Path("docs/images")
    """Where figures go."""
    throws: int = 10
    """With each policy in each world."""
    samples: int | None = None
    """Take of each training the policy that threw farthest in its simulation after no more samples than these; None
    takes ``policy.pt``, the farthest of all."""
    by_samples: tuple[int, ...] = ()
    """Instead of all else, throw with the policies of as many samples as each of these, in their own simulator and on
    the arm, and write ``throw_samples.md`` and ``.json``."""
    jobs: int = 1
    """Worlds at a time."""


def main(cfg: Config) -> None:
    cfg.results.mkdir(parents=True, exist_ok=True)
    cfg.images.mkdir(parents=True, exist_ok=True)
    if cfg.by_samples:
        return compare_samples(cfg)
    scores = score(trained(cfg.folders, cfg.samples), cfg.throws, cfg.jobs)
    write(scores, markdown(scores), cfg.results / "throw_transfer")
    draw(scores, cfg.images / "throw_transfer.svg")
    draw_matrix(scores, cfg.images / "throw_matrix.svg")
    print(markdown(scores))


def compare_samples(cfg: Config) -> None:
    """Policies of as many samples, in their own simulator and on the arm."""
    scores: list[Score] = []
    for samples in cfg.by_samples:
        long_enough = [folder for folder in cfg.folders if examined_up_to(folder) >= samples]
        _, *policies = trained(long_enough, samples)
        of_these = score(policies, cfg.throws, cfg.jobs, everywhere=False) if policies else []
        scores += [replace(each, samples=samples) for each in of_these]
    text = samples_table(scores)
    write(scores, text, cfg.results / "throw_samples")
    print(text)


def write(scores: Sequence[Score], text: str, path: Path) -> None:
    """Numbers and tables."""
    content = json.loads(
        json.dumps([asdict(each) for each in scores]), parse_float=lambda number: round(float(number), 4)
    )
    path.with_suffix(".json").write_text(json.dumps(content) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Trained:
    """A policy, and what it was trained in."""

    name: str
    policy: Policy
    method: str
    world: str
    simulator: Simulator
    samples: int = 0


def trained(folders: Iterable[Path], samples: int | None = None) -> list[Trained]:
    """The throw made by hand, and all policies that are there.

    Args:
        folders: Of trainings.
        samples: Most that a policy may have learnt from, as of :class:`Config`.

    Raises:
        ValueError: If two were trained in simulators of the same name that are not the same.
    """
    recipe = load_recipe()
    found = [Trained("reference", stay_on_reference, "reference", "default", recipe.load_simulator(None))]
    digests: dict[str, str] = {}
    for folder in folders:
        path = farthest(folder, samples)
        if path is None:
            continue
        simulator: Simulator = recipe.load_simulator(folder / "simulator")
        world, now = folder.name.rpartition("-")[0], digest(folder / "simulator")
        if digests.setdefault(world, now) != now:
            raise ValueError(
                f"{folder.name} was trained in another {world} than the policy before it: their throws would be taken "
                "for those of one simulator. Train it again, or score the two apart."
            )
        if simulator.correction is None and simulator.net is None:  # robots are drawn in training alone
            world = "default"
        about = about_policy(path)
        policy = load_policy(recipe, path, about["sizes"])
        found.append(Trained(folder.name, policy, simulator.name, world, simulator, int(about["samples"])))
    return found


def farthest(folder: Path, samples: int | None = None) -> Path | None:
    """The policy of a training that threw farthest in its own simulation, of those of no more samples than these."""
    if samples is None:
        return folder / "policy.pt" if (folder / "policy.pt").exists() else None
    about = {path: about_policy(path) for path in sorted((folder / "examined").glob("*.pt"))}
    few_enough = [path for path, its in about.items() if its["samples"] <= samples]
    return max(few_enough, key=lambda path: float(about[path]["distance_m"]), default=None)


def examined_up_to(folder: Path) -> int:
    """Samples of a training's last policy that was kept."""
    return max((int(about_policy(path)["samples"]) for path in (folder / "examined").glob("*.pt")), default=0)


def about_policy(path: Path) -> dict[str, Any]:
    """What the recipe noted of it."""
    about: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)["metadata"]
    return about


def digest(simulator: Path) -> str:
    files = [path for path in sorted(simulator.iterdir()) if path.suffix in (".json", ".pt")]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def load_policy(recipe: Any, path: Path, sizes: Mapping[str, Any]) -> Policy:
    """What the recipe saved, as it acts on a robot."""
    policy = recipe.make_policy(**sizes)
    load_checkpoint(path, policy=policy)
    deployed: Policy = recipe.deployed(policy, sizes["adapts_to"])
    return deployed


def score(policies: Sequence[Trained], throws: int, jobs: int = 1, *, everywhere: bool = True) -> list[Score]:
    """Throws with policies in all of their worlds, or each in its own, and on the arm, always from the same starts."""
    worlds = {each.world: each.simulator for each in policies}
    first = simulated_env(next(iter(worlds.values())), throws * len(policies))
    starts = first.reset()["joint_position"]  # rows start alike in every world: their draws are their own
    groups = [part.tolist() for part in np.array_split(range(len(policies)), min(jobs, len(policies)))]
    everyone = [(name, list(range(len(policies)))) for name in in_order(worlds)]
    alone = [(each.world, [k]) for k, each in enumerate(policies)]
    tasks = (everyone if everywhere else alone) + [(ARM, group) for group in groups]
    _TASK.update(policies=policies, throws=throws, worlds=worlds, starts=starts, tasks=tasks)  # forks find it there
    outcomes: list[dict[str, Throws]] = [{} for _ in policies]
    with forks(jobs) as mapped:
        found = tqdm(mapped(throws_of, range(len(tasks))), total=len(tasks), desc="worlds")
        for (name, group), ends in zip(tasks, found, strict=True):
            for k, throw in zip(group, ends, strict=True):
                outcomes[k][name] = throw
    return [
        Score(each.method, each.name, each.world, each.samples, of) for each, of in zip(policies, outcomes, strict=True)
    ]


_TASK: dict[str, Any] = {}


def throws_of(number: int) -> list[Throws]:
    """Policies that follow each other in a world, or on the arm."""
    name, group = _TASK["tasks"][number]
    throws, policies = _TASK["throws"], [_TASK["policies"][k] for k in group]
    if name == ARM:
        robot = with_bucket(z1(), BUCKET)
        arms = [ConcealedArm(robot=robot, seed=k % throws) for k in range(throws * len(group))]
        rows = torch.arange(throws) + throws * torch.tensor(group)[:, None]
        env = real_env(arms, _TASK["starts"][rows.flatten()])
    else:
        env = simulated_env(_TASK["worlds"][name], throws * len(group), first_row=throws * group[0])
    end = throw_all(env, side_by_side([each.policy for each in policies], throws))
    return [outcome(rows) for rows in end.split(throws)]


@contextmanager
def forks(jobs: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """``map``, in processes of a core each if there are several."""
    if jobs == 1:
        yield map
        return
    context = multiprocessing.get_context("fork")
    cores = context.Queue()
    for k in range(jobs):
        cores.put(sorted(os.sched_getaffinity(0))[k % len(os.sched_getaffinity(0))])
    with ProcessPoolExecutor(jobs, context, _stay_on_a_core, (cores,)) as pool:
        yield pool.map


def _stay_on_a_core(cores: Any) -> None:
    os.sched_setaffinity(0, {cores.get()})
    torch.set_num_threads(1)


def side_by_side(policies: Sequence[Policy], throws: int) -> Policy:
    """All of them as one, each for so many rows."""

    def act(step: TensorDictBase) -> TensorDictBase:
        rows = zip(policies, step.split(throws), strict=True)
        return step.set("action", torch.cat([policy(its)["action"] for policy, its in rows]))

    return act


def simulated_env(simulator: Simulator, count: int, first_row: int = 0) -> EnvBase:
    """The task in a simulator, which notes what happens at the release."""
    chain = [AtRelease("joint_velocity"), *simulator.chain(arm_power=ARM_POWER, randomize=False)]
    task = partial(throw_env, tolerance=TOLERANCE, ends=False, seed=7, first_row=first_row)
    return task(simulator.robot, num_envs=count, chain=chain)


def real_env(arms: Sequence[ConcealedArm], starts: Tensor) -> EnvBase:
    """The task on arms, each with a throw of its own."""
    task = throw_task(arms[0].robot, ends=False, tolerance=TOLERANCE)
    flight = [BallFlight(1 / arms[0].rate, rim=BUCKET.rim, radius=BUCKET.ball_radius), AtRelease("link_velocity")]
    return TransformedEnv(ArmEnv(arms, starts), Compose(*flight, Decimation(4), *task))


@torch.no_grad()
def throw_all(env: EnvBase, act: Policy) -> TensorDictBase:
    """What throws end with. Shape (N,)."""
    *_, last = (step["next"] for step in acting(env, act, STEPS))
    return last


def outcome(end: TensorDictBase) -> Throws:
    release = {key: end[key].float().mean(0).tolist() for key in AT_RELEASE}
    return Throws(throw_distance(end).tolist(), end["throw_failed"].flatten().tolist(), release)


def stay_on_reference(step: TensorDictBase) -> TensorDictBase:
    return step.set("action", torch.zeros(*step.shape, 6))


class AtRelease(StatefulTransform):
    """Keep what was when the ball left the bucket; zeros until then.

    Writes ``release_time`` (N, 1) since the episode's start [s], ``release_velocity`` (N, 3) of the ball [m/s] and
    ``release_joint_velocity`` (N, J) [rad/s]. It stands behind :class:`~torchrl_athletic.transforms.BallFlight`, at
    the same rate.

    Args:
        velocity_key: Joint velocities.
        dt: Of a step [s].
    """

    def __init__(self, velocity_key: NestedKey, dt: float = 0.005) -> None:
        super().__init__(["ball_age", "ball_linear_velocity", velocity_key], list(AT_RELEASE))
        self.dt = dt

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        values = [torch.zeros_like(tensordict_reset.get(key)) for key in self.in_keys]
        return dict(zip(self.out_keys, (values[0].float(), *values[1:]), strict=True))

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        leaves = next_tensordict.get("ball_away") & ~tensordict.get("ball_away")
        age, *velocities = (next_tensordict.get(key) for key in self.in_keys)
        for key, value in zip(self.out_keys, (age * self.dt, *velocities), strict=True):
            next_tensordict.set(key, torch.where(spread(leaves, value), value, tensordict.get(key)))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        shapes = [observation_spec[key].shape for key in self.in_keys]
        device = observation_spec.device
        return {key: Unbounded(shape=shape, device=device) for key, shape in zip(self.out_keys, shapes, strict=True)}


class ArmEnv(EnvBase):
    """Arms that take position targets and 5 ms for each, beside which cameras follow the buckets.

    Shows what :class:`~torchrl_athletic.envs.TorqueEnv` does; joints as the drives report them, and for the referee
    ``link_velocity``, that of the links.

    Args:
        arms: Each with ``reset``, ``step`` and ``true_state``.
        starts: Joint positions to start from [rad]. Shape (N, J).
    """

    def __init__(self, arms: Sequence[ConcealedArm], starts: Tensor) -> None:
        count, joints = starts.shape
        super().__init__(batch_size=[count])
        self.arms, self.starts = arms, starts
        widths = dict.fromkeys(("joint_position", "joint_velocity", "applied_torque", "link_velocity"), joints)
        widths |= dict.fromkeys(("bucket_position", "bucket_linear_velocity", "bucket_axis", "arm_force"), 3)
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
            "link_velocity": [state.velocity for state in states],
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


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
