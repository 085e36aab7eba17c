"""A supervised actuator net in the place of the torque law, and torque commands as targets, which such nets look at."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import Transform

from torchrl_athletic.transforms.actuation import PerJoint, UANCorrection
from torchrl_athletic.transforms.stateful import Joints, joint_index, unbounded_like


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
        super().__init__(
            net,
            joints,
            length=length,
            torque_key=torque_key,
            target_key=target_key,
            position_key=position_key,
            velocity_key=velocity_key,
            correction_key=actuator_key,
            history_key=history_key,
            reset_key=reset_key,
        )

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get(self.torque_key).clone()
        torque[..., joint_index(self, self.joints)] = 0.0
        return super()._inv_call(tensordict.set(self.torque_key, torque))


class EquivalentTarget(Transform):
    r"""The action is a torque; note the position target whose PD law would command it.

    .. math:: q^* = q + (\tau + k_d \dot q) / k_p

    It takes the place of :class:`PDControl` where a robot is driven by torques, so that nets which look at errors of
    position and velocity see those that a drive with these gains would.

    Args:
        kp: Stiffness [N·m/rad]. Shape (J,) or ().
        kd: Damping [N·m·s/rad]. Shape (J,) or ().
        torque_key: What the environment takes [N·m]. Shape (*B, J).
        action_key: What the policy gives, the same torque [N·m]. Shape (*B, J).
        position_key: [rad].
        velocity_key: [rad/s].
        target_key: Where to note the target [rad].

    Raises:
        ValueError: If a stiffness is not positive: no target would command a torque.

    Example:
        >>> from tensordict import TensorDict
        >>> note = EquivalentTarget(kp=10.0, kd=2.0)
        >>> seen = TensorDict(action=[[5.0]], joint_position=[[1.0]], joint_velocity=[[0.5]], batch_size=[1])
        >>> note.inv(seen)["position_target"]
        tensor([[1.6000]])
    """

    kp: Tensor
    kd: Tensor

    def __init__(
        self,
        kp: PerJoint,
        kd: PerJoint,
        *,
        torque_key: NestedKey = "torque",
        action_key: NestedKey = "action",
        position_key: NestedKey = "joint_position",
        velocity_key: NestedKey = "joint_velocity",
        target_key: NestedKey = "position_target",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[torque_key], out_keys_inv=[action_key])
        for name, gain in (("kp", kp), ("kd", kd)):
            self.register_buffer(name, torch.as_tensor(gain, dtype=torch.float32).clone())
        if not (self.kp > 0).all():
            raise ValueError(
                f"kp is {self.kp.tolist()}: with a stiffness of zero no target commands a torque, so the errors that "
                "nets look at would be infinite. Give the gains of a drive that could hold the robot."
            )
        self.torque_key, self.action_key, self.target_key = torque_key, action_key, target_key
        self.position_key, self.velocity_key = position_key, velocity_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        torque = tensordict.get(self.action_key, None)
        if torque is None:
            raise KeyError(
                f"EquivalentTarget found no {self.action_key!r}: there is no torque to find a target for. Give it data "
                "of the policy's side; on an environment, name the policy's action with action_key=..."
            )
        position, velocity = tensordict.get(self.position_key), tensordict.get(self.velocity_key)
        tensordict.set(self.target_key, position + (torque + self.kd * velocity) / self.kp)
        return tensordict.set(self.torque_key, torque)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: the transform acts on the way in, as :meth:`inv` does."""
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        action = input_spec["full_action_spec"]
        torque = action[self.torque_key]
        if unravel_key(self.torque_key) != unravel_key(self.action_key):
            del action[self.torque_key]
        action[self.action_key] = unbounded_like(torque, torque.shape)
        return input_spec
