"""Teach a net the torques that a simulation of your robot lacks, from what its encoders said: no torque sensor needed.

python recipes/train_uan.py --recordings outputs/recordings/z1                              # down the gradient
python recipes/train_uan.py --method ppo --credit arm --device cuda --output outputs/identification/uan_ppo  # paper's
python recipes/train_uan.py --model outputs/diagnosis --output outputs/identification/left       # what that left

Takes that say ``split: heldout``, and throws, are not looked at. A window of each other take is validated on: ``mse``
of the open-loop replays against time stands in ``progress.csv``. The same command goes on after a kill; a run of other
takes or another model is refused its folder. ``Simulator.load`` reads the result. How the methods compare: docs/uan.md.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import nn

from torchrl_athletic import training
from torchrl_athletic.envs import Takes, replay_env
from torchrl_athletic.identification import Simulator, digest_of, name_of_uan, on_a_fit
from torchrl_athletic.networks import uan
from torchrl_athletic.recordings import read_recordings
from torchrl_athletic.robots import from_mjcf, z1

ROWS = {("ppo", "cpu"): 256, ("ppo", "cuda"): 4096, ("gradient", "cpu"): 128, ("gradient", "cuda"): 512}


@dataclass(frozen=True)
class Config:
    recordings: Path = Path("outputs/recordings/z1")  # file or folder of takes
    method: Literal["gradient", "ppo"] = "gradient"
    """Down the position error's own gradient, or the paper's reinforcement learning."""
    credit: Literal["arm", "joint"] = "joint"
    """Credit in PPO: one reward for all joints, as the paper has it, or each joint its own."""
    knows: training.Knows = "errors"
    """What the net is told of a joint: its errors, as in the paper; which one it is; how the arm stands and moves."""
    memory: tuple[float, ...] = ()
    """Ways [rad]: the net is also shown how far its joint has wound up since it turned, within each of them."""
    hidden: tuple[int, ...] = (128, 128)  # layers of the net
    robot: str = "z1"
    """``z1``, or the path of an MJCF."""
    model: Path | None = None
    """Folder of a diagnosis or of CEM's simulator, or a ``corrected.json``: the net learns what that leaves."""
    inertia_only: bool = False  # whether the model gives the rotors' inertia alone, and friction is the net's
    num_envs: int | None = None
    """Rows; None takes what suits the method and the device."""
    minutes: float = 3.0  # when to stop
    iterations: int | None = None
    """When to stop in any case. The gradient method then plans by them, however busy the machine is."""
    seed: int = 0  # of weights, starts and exploration
    device: Literal["cpu", "cuda"] = "cuda" if torch.cuda.is_available() else "cpu"
    """Device of simulation and nets."""
    window: float = 5.0
    """Length of one piece kept aside for validation, in all a tenth of the takes [s]."""
    evaluate_every: int = 20  # iterations between validations
    logger: training.LoggerName = "csv"  # where numbers go; wandb stays offline
    output: Path = Path("outputs/identification/uan")
    """Folder for the simulator and all else that is written."""


def main(cfg: Config) -> Simulator:
    torch.manual_seed(cfg.seed)
    torch.set_float32_matmul_precision("high")
    recordings = training.for_training(read_recordings(cfg.recordings))
    robot = training.with_gains_of(z1() if cfg.robot == "z1" else from_mjcf(cfg.robot), recordings)
    told = name_of_uan(cfg.method, cfg.credit, cfg.knows, bool(cfg.memory))
    given = Simulator(told, robot) if cfg.model is None else on_a_fit(cfg.model, told, robot, cfg.inertia_only)
    pieces, windows = training.set_aside(recordings, seconds=cfg.window)
    takes = training.takes_of(pieces, robot)
    net = uan(hidden=cfg.hidden, **training.units_of(takes, robot, cfg.knows, cfg.memory)).to(cfg.device)
    validate = training.validation_of(given, windows, net, device=cfg.device)
    before = validate()["mse"]  # of a net that corrects nothing yet

    chosen = ("method", "credit", "knows", "memory", "hidden", "seed", "window")
    made_of = {name: str(getattr(cfg, name)) for name in chosen}
    made_of |= {"recordings": digest_of(recordings), "model": given.digest}
    learner = make_learner(cfg, given, takes, net)
    numbers = training.train(
        learner,
        minutes=cfg.minutes,
        iterations=cfg.iterations,
        evaluate=validate,
        evaluate_every=cfg.evaluate_every,
        logger=training.make_logger(cfg.logger, cfg.output, "train_uan"),
        checkpoints=training.Checkpoints(cfg.output / "checkpoints", made_of=made_of, beside={"validation": validate}),
        checkpoint_every=cfg.evaluate_every,
        show=["reward", "mse", "lost"],
        step=training.iterate if cfg.method == "ppo" else training.descend,
    )
    best, state = validate.best
    net.load_state_dict(state)
    notes: dict[str, Any] = {"device": cfg.device, **made_of}
    notes |= {"training_seconds": learner.seconds, "data_seconds": sum(r.duration for r in (*pieces, *windows))}
    notes |= {"validation_mse": best, "validation_mse_last": numbers["mse"], "validation_mse_before": before}
    notes |= {"validation_lost_last": numbers["lost"]}
    found = replace(given, net=net.cpu(), kind="correction", notes=notes)
    print(f"mean square error of replays not trained on: {before:.3g} rad² before, {best:.3g} rad² after")
    print("simulator:", found.save(cfg.output))
    return found


def make_learner(cfg: Config, given: Simulator, takes: Takes, net: nn.Sequential) -> Any:
    rows, robot, unit = cfg.num_envs or ROWS[cfg.method, cfg.device], given.robot, training.torque_unit(net)
    chain = training.chain_with(given, net, takes)
    if cfg.method == "gradient":
        moved = robot.joint_groups.get("arm")
        base = training.DifferentiableTorqueEnv(robot, joints=moved, num_envs=rows, device=cfg.device, along=takes)
        env = replay_env(robot, takes, chain=chain, unit=unit, base=base, max_steps=1000, seed=cfg.seed)
        return training.GradientLearner(env, net, minutes=cfg.minutes, iterations=cfg.iterations)
    env = replay_env(robot, takes, chain=chain, unit=unit, num_envs=rows, device=cfg.device, seed=cfg.seed)
    ppo, on_gpu = replace(training.UAN, num_envs=rows, micro_batch=98_304), cfg.device == "cuda"
    return training.uan_learner(env, net, ppo, credit=cfg.credit, seed=cfg.seed, cuda_graph=on_gpu)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
