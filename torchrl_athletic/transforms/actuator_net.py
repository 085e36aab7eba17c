"""A supervised actuator net in the place of the torque law."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import nn

from torchrl_athletic.transforms.actuation import UANCorrection, UANKeys
from torchrl_athletic.transforms.stateful import Joints, joint_index


class ActuatorNet(UANCorrection):
    r"""Put the torque that a supervised actuator net predicts in the place of the one commanded.

    The net sees what a :class:`UANCorrection`'s does, the position errors :math:`q^* - q` and the velocity errors
    :math:`-\dot q` of a joint's last steps, and gives the whole torque instead of a correction. Place it further in
    than :class:`PDControl`, which notes the target; joints outside the group keep the torque that they have there.

    Args:
        net: Maps (*B, J, 2 * length) to (*B, J, 1) [N·m], position errors before velocity errors.
        joints: Whose torque it predicts.
        length: Steps that it sees, the newest included.
        torque_key: What is replaced [N·m]. Shape (*B, J).
        target_key: [rad]. Shape (*B, J).
        position_key: [rad].
        velocity_key: [rad/s].
        actuator_key: Where to note the prediction [N·m]. Shape (*B, J of the group).
        history_key: Where the errors are remembered. Shape (*B, J of the group, 2, length).
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Hwangbo et al. 2019, section "Modeling the actuation", https://arxiv.org/abs/1901.08652.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl_athletic.transforms import PDControl
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> robot, net = z1(), nn.Linear(40, 1)
        >>> chain = Compose(ActuatorNet(net, joints="arm"), PDControl(robot.kp, robot.kd))
        >>> steps = TransformedEnv(TorqueEnv(robot, num_envs=2), chain).rollout(3)
        >>> bool((steps["next", "applied_torque"][..., :6] == steps["next", "actuator_torque"]).all())
        True
    """

    def __init__(
        self,
        net: nn.Module,
        joints: Joints = None,
        *,
        length: int = 20,
        torque_key: NestedKey = "torque",
        target_key: NestedKey = "position_target",
        position_key: NestedKey = "joint_position",
        velocity_key: NestedKey = "joint_velocity",
        actuator_key: NestedKey = "actuator_torque",
        history_key: NestedKey = "error_history",
        reset_key: NestedKey | None = None,
    ) -> None:
        keys = UANKeys(torque_key, target_key, position_key, velocity_key, actuator_key, history_key)
        super().__init__(net, joints, length=length, keys=keys, reset_key=reset_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get(self.torque_key).clone()
        torque[..., joint_index(self, self.joints)] = 0.0
        return super()._inv_call(tensordict.set(self.torque_key, torque))
