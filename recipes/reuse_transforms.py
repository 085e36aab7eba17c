"""Put this library's transforms on environments that know nothing of it: Gymnasium's, and TorchRL's own MuJoCo ones.

    python recipes/reuse_transforms.py
    python recipes/reuse_transforms.py --parallel  # the pendulums in processes of their own

Prints what the policy sees of each; ten seconds. ``docs/reuse.md`` goes through it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import tyro
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import (
    CatTensors,
    Compose,
    EnvBase,
    GymEnv,
    HopperEnv,
    ParallelEnv,
    SerialEnv,
    TransformedEnv,
    UnaryTransform,
)
from torchrl.envs.utils import check_env_specs

from torchrl_athletic.functional.phase import Phase, PhaseSchedule
from torchrl_athletic.transforms import ActionDelay, ObservationHistory, TaskPhase, TorqueSpeedClip

PHASES = PhaseSchedule((Phase("crouch", duration=0.2), Phase("jump", timer=0.5)))
"""A crouch of 0.2 s, then a jump with a timer that runs out after 0.5 s."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag; its docstring is the help text."""

    pendulums: int = 3
    """Gymnasium's Pendulum-v1, each with a delay of its own."""
    parallel: bool = False
    """Give each pendulum a process."""
    steps: int = 20
    """Steps of the rollouts."""
    seed: int = 0
    """Seed of environments, actions and delays."""


def main(cfg: Config) -> dict[str, TensorDictBase]:
    batch = ParallelEnv if cfg.parallel else SerialEnv
    envs = {
        "Gymnasium's pendulum": pendulum(GymEnv("Pendulum-v1"), cfg.seed),
        f"{cfg.pendulums} of them": pendulum(batch(cfg.pendulums, lambda: GymEnv("Pendulum-v1")), cfg.seed),
        "TorchRL's hopper": hopper(HopperEnv(backend="mujoco", seed=cfg.seed), cfg.seed),
    }
    rollouts = {}
    for name, env in envs.items():
        check_env_specs(env)  # TorchRL's own check: what the specs promise is what steps and resets show
        env.set_seed(cfg.seed)
        rollouts[name] = env.rollout(cfg.steps, break_when_any_done=False)
        describe(name, rollouts[name])
        env.close()
    return rollouts


def pendulum(env: EnvBase, seed: int, first_row: int = 0) -> EnvBase:
    """Its action is a torque of at most 2 N·m; the last entry of its observation is the rate."""
    return in_the_real_world(env, 1, torque_limit=2.0, velocity_limit=8.0, dt=0.05, seed=seed, first_row=first_row)


def hopper(env: EnvBase, seed: int) -> EnvBase:
    """Its actions are shares of the motors' torques; its observation ends with the rates of its three joints."""
    return in_the_real_world(env, 3, torque_limit=1.0, velocity_limit=10.0, dt=0.025, seed=seed)


def in_the_real_world(
    env: EnvBase, joints: int, torque_limit: float, velocity_limit: float, dt: float, seed: int, first_row: int = 0
) -> EnvBase:
    """A motor that weakens with speed, actions that come late, and a policy that remembers and knows its phase.

    Actions pass from the last transform to the first, so that the motor gets what the delay lets through; observations
    pass from the first to the last.
    """
    draws = {"seed": seed, "first_row": first_row}
    return TransformedEnv(
        env,
        Compose(
            UnaryTransform(["observation"], ["joint_velocity"], fn=partial(last, count=joints)),
            TorqueSpeedClip(torque_limit, velocity_limit, torque_key="action"),
            ActionDelay(max_steps=2, before=0.0, **draws),
            ObservationHistory(["observation"], length=4, flatten=True),
            TaskPhase(PHASES, dt, **draws),
            CatTensors(["observation_history", "task_phase"], "policy_input", del_keys=False, sort=False),
        ),
    )


def last(observation: Tensor, count: int) -> Tensor:
    return observation[..., -count:]


def describe(name: str, rollout: TensorDictBase) -> None:
    history, phases = (rollout[key].shape[-1] for key in ("observation_history", "task_phase"))
    delays = rollout["action_delay"][..., 0, 0].flatten().tolist()
    print(f"{name}: the policy sees {history} of history + {phases} of the phase; its actions come {delays} steps late")
    phase = rollout["task_phase"].reshape(-1, *rollout["task_phase"].shape[-2:])[0]
    for step in range(0, len(phase), 5):
        print(f"  step {step:2d}: crouch, jump, timer = {[round(share, 2) for share in phase[step].tolist()]}")


if __name__ == "__main__":
    main(tyro.cli(Config))
