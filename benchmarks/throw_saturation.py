"""How long are motors at their limits while an arm throws? Where they are, a better simulator makes no longer throw.

    python benchmarks/throw_saturation.py outputs/throw/default-* outputs/throw/cem_*

Throws with each policy that ``train_throws.py`` left, in the simulator that it was trained in, and counts the physics
steps from the throw's beginning to the ball's release in which a motor gives all that the torque-speed line leaves it.
Prints a share for each joint of the arm, means over the throws of each policy. What it says: docs/throwing.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT))  # last: the package under test is the installed one

from benchmarks.throw_transfer import TOLERANCE, Trained, trained  # noqa: E402
from torchrl_athletic.envs import throw_env  # noqa: E402
from torchrl_athletic.envs.throw import ARM_POWER, STEPS  # noqa: E402
from torchrl_athletic.functional.actuation import torque_speed_limits  # noqa: E402
from torchrl_athletic.functional.phase import throw_phases  # noqa: E402
from torchrl_athletic.robots import Robot  # noqa: E402
from torchrl_athletic.training.evaluation import acting  # noqa: E402
from torchrl_athletic.transforms import CorrectedActuation, TorqueSpeedClip  # noqa: E402
from torchrl_athletic.transforms.stateful import StatefulTransform  # noqa: E402

NEAR = 1e-3
"""Share of the torque limit: how near to what is left counts as all of it."""


@dataclass(frozen=True)
class Config:
    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of policies."""
    throws: int = 10
    """With each policy."""
    samples: int | None = None
    """As of ``throw_transfer.py``: the farthest policy of no more samples than these."""


def main(cfg: Config) -> None:
    _, *policies = trained(cfg.folders, cfg.samples)
    print("| policy | " + " | ".join(f"joint {j + 1}" for j in range(6)) + " |\n|" + " --- |" * 7)
    for each in policies:
        shares = [f"{100 * share:.0f} %" for share in share_at_limit(each, cfg.throws).tolist()]
        print(f"| {each.name} | " + " | ".join(shares) + " |", flush=True)


@torch.no_grad()
def share_at_limit(of: Trained, throws: int) -> Tensor:
    """Share of the time between the throw's beginning and the ball's release. Shape (6,).

    Raises:
        ValueError: If a ball was away before.
    """
    chain = of.simulator.chain(arm_power=ARM_POWER, randomize=False)
    motor = next(k for k, law in enumerate(chain) if isinstance(law, (TorqueSpeedClip, CorrectedActuation)))
    chain.insert(motor, AtLimit(of.simulator.robot))
    env = throw_env(of.simulator.robot, num_envs=throws, chain=chain, tolerance=TOLERANCE, ends=False, seed=7)
    throw, counted, steps = throw_phases().index("throw"), torch.zeros(throws, 6), torch.zeros(throws, 1)
    before = torch.zeros(throws, 6)
    for step in acting(env, of.policy, STEPS):
        swings = (step["task_phase_index"] == throw) & ~step["next", "ball_away"]
        after = step["next", "steps_at_limit"][:, :6]
        counted += swings * (after - before)
        steps, before = steps + 4 * swings, after
    if not steps.all():
        raise ValueError(f"{of.name}: in some throws the ball was away before the throw began. Train it for longer.")
    return (counted / steps).mean(0)


class AtLimit(StatefulTransform):
    """Count the steps in which a motor gives all that its speed leaves it, whichever way it pushes.

    Writes ``steps_at_limit`` (N, J) since the episode's start. It stands one further in than the motor.

    Args:
        robot: Whose limits they are.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__([], ["steps_at_limit"], in_keys_inv=["torque"], out_keys_inv=["torque"])
        self.limits = torch.tensor(robot.torque_limit), torch.tensor(robot.velocity_limit)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get("torque")
        low, high = torque_speed_limits(tensordict.get("joint_velocity"), *self.limits)
        near = NEAR * self.limits[0]
        at_limit = (torque >= high - near) | (torque <= low + near)
        return tensordict.set("steps_at_limit", tensordict.get("steps_at_limit") + at_limit)

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {"steps_at_limit": torch.zeros_like(tensordict_reset.get("joint_position"))}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        next_tensordict.set("steps_at_limit", tensordict.get("steps_at_limit"))

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        position = observation_spec["joint_position"]
        return {"steps_at_limit": Unbounded(shape=position.shape, device=position.device)}


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
