"""A two-joint arm that is quick to simulate, and recordings of it under a simulator that stands for the real one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import Compose, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.identification import Simulator
from torchrl_athletic.recordings import Recording
from torchrl_athletic.robots import Robot, from_mjcf

XML = """
<mujoco model="two_joints">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hip" axis="0 1 0" armature="0.03" damping="0.5" frictionloss="0.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
      <body pos="0 0 -0.3">
        <joint name="knee" axis="0 1 0" armature="0.02" damping="0.3" frictionloss="0.3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hip" forcerange="-30 30"/><motor joint="knee" forcerange="-20 20"/></actuator>
</mujoco>"""


def last_layer(net: nn.Module) -> nn.Linear:
    return [layer for layer in net.modules() if isinstance(layer, nn.Linear)][-1]


def robot() -> Robot:
    return from_mjcf(XML, kp=(40.0, 30.0), kd=(1.0, 0.8), velocity_limit=12.0)


def commands(samples: int, seed: int = 0, scale: float = 0.5, hold: int = 30) -> np.ndarray:
    """Random steps after a rest. Shape (T, 2)."""
    steps = scale * np.random.default_rng(seed).standard_normal((samples // hold + 1, 2))
    steps[0] = 0.0
    return np.repeat(steps, hold, axis=0)[:samples]


def recorded(simulator: Simulator, command: np.ndarray, torques: bool = False) -> Recording:
    """What the simulator does in an environment stepped in the ordinary way, from rest at the default pose."""
    chain = simulator.chain(command="torque" if torques else "position", decimation=1, randomize=False)
    env = TransformedEnv(TorqueEnv(simulator.robot, num_envs=1), Compose(*chain))
    rows = iter(torch.as_tensor(command, dtype=torch.float32))
    policy = TensorDictModule(lambda position: next(rows)[None], in_keys=["joint_position"], out_keys=["action"])
    steps = env.rollout(len(command) - 1, policy=policy, break_when_any_done=False)
    now, last = steps[0], steps[0, -1]["next"]
    position, velocity, applied = (  # the torque is that of the step before, as a drive reports it
        torch.cat([now[key], last[key][None]]).double().numpy()
        for key in ("joint_position", "joint_velocity", "applied_torque")
    )
    given = simulator.robot
    take = Recording(
        0.005 * np.arange(len(command)),
        given.joint_names,
        position,
        velocity,
        torque_command=command if torques else None,
        position_target=None if torques else command,
        kp=None if torques else np.array(given.kp),
        kd=None if torques else np.array(given.kd),
    )
    if torques:
        return take
    return replace(take, torque_measured=applied, torque_semantics="current_derived")
