"""All that stands between a policy's position targets and the motors of a robot, in its order."""

from __future__ import annotations

from torch import nn
from torchrl.envs import Compose

from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms import ActionDelay, Decimation, PDControl, PowerClip, TorqueSpeedClip, UANCorrection


def actuation_chain(
    robot: Robot,
    *,
    net: nn.Module | None = None,
    arm_power: float | None = None,
    max_delay: int = 0,
    decimation: int = 4,
    seed: int = 0,
) -> Compose:
    """The chain that runs at the physics rate, from the motor outwards, ready to be followed by other transforms.

    Args:
        robot: Gives gains, limits and the joints of its arm.
        net: Unsupervised Actuator Net of the arm; None leaves its torques as they are.
        arm_power: Greatest power of the arm [W]; None sets no limit.
        max_delay: Greatest delay of the action, drawn per episode [physics steps].
        decimation: Physics steps per action.
        seed: Of the delays.

    Source:
        Fey et al. 2025, section II.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> robot = z1()
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), actuation_chain(robot, arm_power=200.0, max_delay=6))
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 7])
    """
    chain = [TorqueSpeedClip(robot.torque_limit, robot.velocity_limit)]
    if arm_power is not None:
        chain.append(PowerClip(arm_power, joints="arm"))
    if net is not None:
        chain.append(UANCorrection(net, joints="arm"))
    chain.append(PDControl(robot.kp, robot.kd))
    if max_delay:
        chain.append(ActionDelay(max_delay, before=robot.default_pose, seed=seed))
    return Compose(*chain, Decimation(decimation))
