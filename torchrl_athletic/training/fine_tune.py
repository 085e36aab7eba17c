"""A task, learnt from a whole-body controller: the same network goes on, and hears of phases for the first time."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_athletic.envs.whole_body import phase_inputs
from torchrl_athletic.identification import actuation_identity
from torchrl_athletic.networks import RunningNormalizer, open_inputs, pretrained, trunk_of
from torchrl_athletic.recordings.whole_file import whole_file
from torchrl_athletic.training.checkpoint import Checkpoints
from torchrl_athletic.training.curves import draw_curves
from torchrl_athletic.training.evaluation import whole_rollout
from torchrl_athletic.training.logging import LoggerName, make_logger
from torchrl_athletic.training.ppo import FINE_TUNE, PPO, Learner, check_end, train
from torchrl_athletic.training.video import View, draw_episode, frame_strip, write_video
from torchrl_athletic.training.wbc import WATCHED, check_sizes, read_wbc, save_wbc, wbc_learner
from torchrl_athletic.transforms import RewardTerms


@dataclass(frozen=True)
class FineTune:
    """What a recipe that tunes a controller to a task asks on its command line."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Device of simulation and nets."""
    minutes: float | None = None
    """When to stop [min]; None takes 9 on CPUs and 15 on a GPU."""
    iterations: int | None = None
    """When to stop in any case; None takes 1,950 on a GPU, unless ``minutes`` are told. On a GPU the divergence falls
    until then (:meth:`.PPO.annealed`); where only minutes are told it stays."""
    seed: int = 0
    """Seed of robots, disturbances and exploration."""
    start: str | None = "wbc"
    """A shipped controller, or a file of ``pretrain_wbc.py``, to go on from; ``None`` begins anew."""
    actuation: str = "uan"
    """Actuation of the arm: ``uan``, the shipped net; ``ideal``; or the folder of an identified simulator."""
    num_envs: int | None = None
    """Robots; None takes 256 on CPUs and those of ``ppo`` on a GPU."""
    epochs: int | None = None
    """Passes over a batch; None takes those of ``ppo``."""
    ppo: PPO = field(default_factory=lambda: FINE_TUNE)
    """What else is chosen by hand."""
    episodes: int = 100
    """Episodes that judge the policy at the end."""
    logger: LoggerName = "csv"
    """Where numbers go; wandb stays offline."""
    output: Path = Path("outputs/fine_tune")
    """Folder for all that is written."""
    video: bool = True
    """Whether to draw an episode at the end."""


def task_learner(
    env: EnvBase,
    config: PPO = FINE_TUNE,
    *,
    start: str | Path | None = "wbc",
    known: Mapping[str, float] = MappingProxyType({}),
    watch: Sequence[str] = (),
    seed: int = 0,
    cuda_graph: bool = False,
) -> Learner:
    """A controller and its critic, ready to learn a task.

    At first the policy acts as the controller does, whatever phase it is told of: it saw only zeros there
    (:func:`~torchrl_athletic.networks.open_inputs`). A policy whose critic knows the task's entries, or which has heard
    of phases where the task adds none, was tuned before, and goes on as it is. Its standard deviation is that with
    which it was trained last. What inputs are normalised by stays as it was: a policy that is tuned slowly shall not be
    moved by that.

    Args:
        env: Of a task: ``ball_throw_env`` and the like.
        config: Numbers chosen by hand.
        start: A shipped policy, ``"wbc"``, or a file of :func:`~.wbc.save_wbc` or :func:`fine_tune`; None begins anew.
        known: What the task adds to the end of ``privileged``, which the critic learns to listen to, and the usual
            size of each, in its unit.
        watch: Entries of a step whose means are reported, beside those of the pre-training.
        seed: Of the order of samples.
        cuda_graph: Capture control step and update, on a GPU only.

    Raises:
        ValueError: If the controller sees or does something else than this task shows and takes, or was tuned to
            another task whose entries are as many.

    Source:
        Fey et al. 2025, section II-C.

    Example:
        >>> from torchrl_athletic.envs import sled_pull_env
        >>> from torchrl_athletic.envs.sled_pull import KNOWN
        >>> learner = task_learner(sled_pull_env(num_envs=2), PPO(num_envs=2, horizon=4), known=KNOWN)
        >>> learner.actor.in_keys, learner.samples
        (['observation'], 0)
    """
    if start is None:
        return wbc_learner(env, config, watch=watch, seed=seed, cuda_graph=cuda_graph)
    shown = env.observation_spec
    seen, told = (shown[key].shape[-1] for key in ("observation", "privileged"))
    new = [size for key, size in known.items() for _ in range(shown[key].shape[env.ndim :].numel())]
    policy, value = read_wbc(start, trainable=True)
    check_sizes(str(start), {"observation": (policy, seen, env.action_spec.shape[-1])})
    tuned = trunk_of(value).mlp[0].in_features == told if new else _heard_of_phases(policy, env)
    check_sizes(str(start), {"privileged": (value, told if tuned else told - len(new), 1)})
    if tuned:
        _refuse_other_task(str(start), value, env, known, new)
    else:
        open_inputs(policy, phase_inputs(env))
        open_inputs(value, phase_inputs(env, frames=1), new)
    return Learner(
        env,
        policy.to(env.device),
        value.to(env.device),
        config,
        watch=(*WATCHED, *watch),
        seed=seed,
        cuda_graph=cuda_graph,
    )


def _heard_of_phases(policy: Any, env: EnvBase) -> bool:
    """Whether a policy has learnt what phases mean: its normaliser knows a spread of theirs, which are 0 before."""
    normalizer = trunk_of(policy).normalizer
    return isinstance(normalizer, RunningNormalizer) and bool((normalizer.variance[phase_inputs(env)] > 0).any())


def _refuse_other_task(start: str, value: Any, env: EnvBase, known: Mapping[str, float], new: Sequence[float]) -> None:
    """Raise where a critic was opened to the entries of another task, which are as many but of other sizes."""
    normalizer = trunk_of(value).normalizer
    if not new or not isinstance(normalizer, RunningNormalizer):
        return
    if (normalizer.variance[phase_inputs(env, frames=1)] != 1).any():
        return  # it was not opened but begun with the task, whose sizes it measured
    sizes = normalizer.variance[-len(new) :].sqrt()
    if not torch.allclose(sizes, sizes.new_tensor(new), rtol=0.01):
        raise ValueError(
            f"the critic of {start} divides the task's entries by {sizes.tolist()}, this task has {dict(known)}: it "
            "was tuned to another task and would take one quantity for another. Start from the controller that it was "
            "tuned from, wbc or wbc_wide; or give the sizes that it knows."
        )


def controller_for(env: EnvBase, name: str) -> Any:
    """A shipped controller as it begins a task: it acts as in its pre-training, whatever phase it is told of.

    Args:
        env: Of the task.
        name: ``"wbc"``, say.

    Example:
        >>> from torchrl_athletic.envs import sled_pull_env
        >>> controller_for(sled_pull_env(num_envs=1), "wbc").in_keys
        ['observation']
    """
    controller = pretrained(name)
    open_inputs(controller, phase_inputs(env))
    return controller


DRAWN = 400
"""Most policy steps in a video: 8 s."""
NEAR = View(distance=4.0, azimuth=45.0, elevation=-15.0)
"""A robot's video, from its right: a hand overhead is in the picture."""
MakeEnv = Callable[..., TransformedEnv]
"""``make_env(num_envs, exam=False, **told)``."""


def fine_tune(
    cfg: FineTune,
    make_env: MakeEnv,
    *,
    name: str,
    known: Mapping[str, float],
    curves: Mapping[str, str],
    look_at: Sequence[str],
    judge: Callable[[TensorDict], dict[str, float]],
    watch: Sequence[str] = (),
    annotate: Callable[..., None] | None = None,
    view: View = NEAR,
    steps: int,
) -> dict[str, float]:
    """Tune a controller to a task, and leave policy, curves, figures, video and a strip of its frames.

    Called again with the same settings it goes on where it stopped.

    Args:
        cfg: Of the command line.
        make_env: Of the task; ``exam=True`` asks for the episodes by which a policy is judged, and which are drawn.
        name: Of the task, and of the policy's file.
        known: As of :func:`task_learner`.
        curves: Columns of ``progress.csv`` to draw, and their titles.
        look_at: Entries that ``judge`` needs.
        judge: From :func:`~.evaluation.whole_rollout` to figures.
        watch: As of :func:`task_learner`; columns to draw may be among them.
        annotate: Adds shapes to the video, as of :func:`~.video.record_video`.
        view: From where it is seen.
        steps: Of an episode [policy steps].

    Returns:
        The figures, and the reward of the same episodes. They are measured before the training too, on the same robots,
        and so tell what was learnt where a curve of a few hundred robots is too rough.
    """
    for flag, count in {"episodes": cfg.episodes, "num-envs": cfg.num_envs, "epochs": cfg.epochs}.items():
        if count is not None and count < 1:
            raise ValueError(f"--{flag} is {count}: there would be nothing to look at. Give 1 or more.")
    check_end(minutes=cfg.minutes, iterations=cfg.iterations)
    on_gpu = cfg.device == "cuda"
    torch.manual_seed(cfg.seed)
    torch.set_float32_matmul_precision("high")
    rows = cfg.num_envs or (cfg.ppo.num_envs if on_gpu else 256)
    ppo = replace(cfg.ppo, num_envs=rows, epochs=cfg.epochs or cfg.ppo.epochs)
    iterations = 1950 if on_gpu and cfg.iterations is None and cfg.minutes is None else cfg.iterations
    ppo = ppo.annealed(iterations) if on_gpu and iterations else ppo
    if iterations is not None and 0 < iterations <= ppo.critic_first:
        why = f"the critic learns alone in the first {ppo.critic_first}; --ppo.critic-first 0 lets both learn"
        print(f"--iterations {iterations}: the policy will stay as it is, since {why}.")
    env = make_env(ppo.num_envs, device=cfg.device, seed=cfg.seed, staggered=True)
    same = {"seed": str(cfg.seed), "start": str(cfg.start), "actuation": actuation_identity(cfg.actuation)}
    same |= {"task": name, "ppo": str(ppo), **_task_of(env)}
    learner = task_learner(
        env,
        ppo,
        start=cfg.start,
        known=known,
        watch=watch,
        seed=cfg.seed,
        cuda_graph=on_gpu,
    )
    first = cfg.output / "figures_before.json"
    if not (first.exists() and any((cfg.output / "checkpoints").glob("*"))):  # a run that goes on has its own
        _examine(cfg, make_env, learner.actor, first, look_at, judge, steps)
    train(
        learner,
        minutes=(15.0 if on_gpu else 9.0) if cfg.minutes is None else cfg.minutes,
        iterations=iterations,
        logger=make_logger(cfg.logger, cfg.output, f"finetune_{name}"),
        checkpoints=Checkpoints(cfg.output / "checkpoints", made_of=same),
        checkpoint_every=100 if on_gpu else 20,
        show=["reward", "kl"],
    )
    trained_as = str(replace(cfg, ppo=ppo, iterations=iterations))
    told = {"trained_as": trained_as, "history": 10, "actuation": cfg.actuation}
    print("policy:", save_wbc(learner, cfg.output, name=name, **told))
    policy = learner.actor.to("cpu")
    if (progress := cfg.output / "progress.csv").exists():
        alone = (ppo.warm_up + ppo.critic_first) * ppo.horizon * ppo.num_envs if ppo.critic_first else 0
        print("curves:", draw_curves({name: progress}, curves, cfg.output / "curves.png", shaded=alone))
    figures = _examine(cfg, make_env, policy, cfg.output / "figures.json", look_at, judge, steps)
    for key, before in json.loads(first.read_text("utf-8")).items():
        print(f"{key:>20} {before:9.3g} -> {figures[key]:.3g}")
    if cfg.video:
        shown = make_env(1, exam=True, seed=cfg.seed + 1)
        frames = draw_episode(shown, policy, min(steps, DRAWN), annotate=annotate, follow="base", view=view)
        print("video:", write_video(frames, cfg.output / f"{name}.mp4", 50.0))
        frame_strip(frames, 6, cfg.output / f"{name}.png")
    return figures


def _task_of(env: TransformedEnv) -> dict[str, str]:
    """What a run that goes on must find as it was: another reward would be learnt with this one's values."""
    parts = [part for part in env.transform if isinstance(part, RewardTerms)]
    scales = {name: scale for part in parts for name, scale in part.scales.items()}
    return {"reward": str(scales), "shown": str(sorted(map(str, env.observation_spec)))}


def _examine(
    cfg: FineTune,
    make_env: MakeEnv,
    policy: Any,
    path: Path,
    look_at: Sequence[str],
    judge: Callable[[TensorDict], dict[str, float]],
    steps: int,
) -> dict[str, float]:
    """Judge a policy by episodes that no training saw, and write the figures down."""
    copied = deepcopy(policy).to("cpu")  # what a graph has recorded shall stay where it is
    exam = make_env(cfg.episodes, exam=True, seed=cfg.seed + 1_000_003)
    keys = list(dict.fromkeys(["reward", *look_at]))
    episodes = whole_rollout(exam, copied, keys, steps, progress=f"{cfg.episodes} episodes")
    figures = {"reward_per_step": float(episodes["reward"][episodes["counts"]].mean())} | judge(episodes)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_text(json.dumps(figures, indent=1, allow_nan=False), encoding="utf-8")
    return figures
