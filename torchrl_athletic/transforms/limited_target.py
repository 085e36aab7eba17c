"""Position targets no further off than motors can follow."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_athletic.functional import actuation
from torchrl_athletic.transforms.actuation import PerJoint, scaled


class LimitedTarget(Transform):
    r"""Move a position target to where the PD law commands no more than the motor has at its speed.

    .. math:: q^* \leftarrow q + (\mathrm{clip}(k_p (q^* - q) - k_d \dot q) + k_d \dot q) / k_p

    It stands for :class:`TorqueSpeedClip` where the torque goes on changing behind the drive's limit, by a lag, a delay
    or friction that no motor limits: further out than :class:`CorrectedActuation`.

    Args:
        kp: Stiffness of the law > 0 [N·m/rad]. Shape (J,) or ().
        kd: Damping of the law [N·m·s/rad]. Shape (J,) or ().
        torque_limit: At standstill [N·m]. Shape (J,) or ().
        velocity_limit: Without load [rad/s]. Shape (J,) or ().
        action_key: The target [rad]. Shape (*B, J).
        position_key: [rad]. Shape (*B, J).
        velocity_key: [rad/s]. Shape (*B, J).
        scale_keys: Entries that multiply ``kp`` and ``kd``, as of :class:`PDControl`.
        limit_scale_key: Entry that multiplies ``torque_limit``, as of :class:`TorqueSpeedClip`.

    Raises:
        ValueError: If a stiffness is not positive: no target would command a torque.

    Example:
        >>> from tensordict import TensorDict
        >>> near = LimitedTarget(kp=100.0, kd=1.0, torque_limit=30.0, velocity_limit=3.0)
        >>> seen = TensorDict(action=[[1.0]], joint_position=[[0.0]], joint_velocity=[[0.0]], batch_size=[1])
        >>> near.inv(seen)["action"]
        tensor([[0.3000]])
    """

    kp: Tensor
    kd: Tensor
    torque_limit: Tensor
    velocity_limit: Tensor

    def __init__(
        self,
        kp: PerJoint,
        kd: PerJoint,
        torque_limit: PerJoint,
        velocity_limit: PerJoint,
        *,
        action_key: NestedKey = "action",
        position_key: NestedKey = "joint_position",
        velocity_key: NestedKey = "joint_velocity",
        scale_keys: tuple[NestedKey, NestedKey] = ("kp_scale", "kd_scale"),
        limit_scale_key: NestedKey = "torque_limit_scale",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[action_key], out_keys_inv=[action_key])
        values = {"kp": kp, "kd": kd, "torque_limit": torque_limit, "velocity_limit": velocity_limit}
        for name, value in values.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32).clone())
        if not (self.kp > 0).all():
            raise ValueError(
                f"kp is {self.kp.tolist()}: without stiffness no target commands a torque. Give the gains of the "
                "law that follows, or leave LimitedTarget out."
            )
        self.action_key, self.position_key, self.velocity_key = action_key, position_key, velocity_key
        self.scale_keys, self.limit_scale_key = scale_keys, limit_scale_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        target, position = tensordict.get(self.action_key, None), tensordict.get(self.position_key, None)
        if target is None or position is None:
            raise KeyError(
                f"LimitedTarget found no {self.action_key!r} or {self.position_key!r}: it cannot tell how far off the "
                "target is. Give it data of the policy's side."
            )
        velocity = tensordict.get(self.velocity_key)
        kp, kd = (scaled(gain, tensordict, k) for gain, k in zip((self.kp, self.kd), self.scale_keys, strict=True))
        limit = scaled(self.torque_limit, tensordict, self.limit_scale_key)
        torque = actuation.pd_torque(target, position, velocity, kp, kd)
        limited = actuation.clip_torque_speed(torque, velocity, limit, self.velocity_limit)
        return tensordict.set(self.action_key, target + (limited - torque) / kp)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: the transform acts on the way in, as :meth:`inv` does."""
        return tensordict
