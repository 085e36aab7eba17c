"""All that stands between a policy's position targets and the motors of a robot, in its order."""

from __future__ import annotations

from torch import nn
from torchrl.envs import Transform

from torchrl_athletic.networks import describe, pretrained
from torchrl_athletic.robots import Robot
from torchrl_athletic.transforms import ActionDelay, Decimation, PDControl, PowerClip, TorqueSpeedClip, UANCorrection


def actuation_chain(
    robot: Robot,
    *,
    net: nn.Module | None = None,
    arm_power: float | None = None,
    max_delay: int = 0,
    min_delay: int = 0,
    decimation: int = 4,
    seed: int = 0,
    first_row: int = 0,
) -> list[Transform]:
    """The chain that runs at the physics rate, from the joint outwards, ready to be followed by other transforms.

    Power is limited after torque and speed are, as in the paper: that of torques which no motor gives would throttle
    the whole arm. Scaled torques stay within the first limits. What a net corrects, friction above all, acts on the
    joint, past the motor, so no limit of the motor cuts it off; nor does any in the replays that it learns from.

    Args:
        robot: Gives gains, limits and the joints of its arm.
        net: Unsupervised Actuator Net of the arm; None leaves its torques as they are.
        arm_power: Greatest power of the arm [W]; None sets no limit.
        max_delay: Greatest delay of the action, drawn per episode [torques].
        min_delay: Least delay.
        decimation: Torques per action.
        seed: Of the delays.
        first_row: Number of the first row, for parts of a larger batch.

    Source:
        Fey et al. 2025, section II.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> robot = z1()
        >>> chain = Compose(*actuation_chain(robot, arm_power=200.0, max_delay=6))
        >>> env = TransformedEnv(TorqueEnv(robot, num_envs=2), chain)
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 7])
    """
    chain: list[Transform] = [] if net is None else [UANCorrection(net, joints="arm")]
    if arm_power is not None:
        chain.append(PowerClip(arm_power, joints="arm"))
    chain.append(TorqueSpeedClip(robot.torque_limit, robot.velocity_limit))
    chain.append(PDControl(robot.kp, robot.kd))
    if max_delay:
        chain.append(ActionDelay(max_delay, min_delay, before=robot.default_pose, seed=seed, first_row=first_row))
    return [*chain, Decimation(decimation)]


def shipped_net(name: str, robot: Robot) -> nn.Module:
    """A shipped actuator net, for the arm that it was trained on.

    Args:
        name: ``"uan"``.
        robot: With a group ``arm``.

    Raises:
        ValueError: If the robot's arm has other joints or gains: what the net makes of their errors would mean nothing.

    Example:
        >>> from torchrl_athletic.robots import b2z1
        >>> type(shipped_net("uan", b2z1())).__name__
        'Sequential'
    """
    arm = robot.joint_groups.get("arm", ())
    known = describe(name)
    wanted = [(joint, kp, kd) for joint, kp, kd in zip(known["joint_names"], known["kp"], known["kd"], strict=True)]
    found = [(robot.joint_names[j], robot.kp[j], robot.kd[j]) for j in arm]
    if found != wanted:
        raise ValueError(
            f"the net {name!r} knows an arm of {_told(wanted)}, but that of {robot.name} has {_told(found)}: it would "
            "push another arm by the errors of its own. Take ideal motors, net=None or --actuation ideal; a simulator "
            f"that was identified for this arm; or, if you know better, the net itself, net=pretrained({name!r})."
        )
    return pretrained(name)


def _told(joints: list[tuple[str, float, float]]) -> str:
    return ", ".join(f"{name} (kp {kp:g}, kd {kd:g})" for name, kp, kd in joints) or "no joints"
