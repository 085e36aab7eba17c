"""A ball in a bucket, and on its way."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import ball
from torchrl_athletic.transforms.stateful import StatefulTransform


class BallFlight(StatefulTransform):
    """Follow a ball that is put into the bucket, until it lies on the floor.

    See :mod:`torchrl_athletic.functional.ball`. It runs at the physics rate: put it before
    :class:`~torchrl_athletic.transforms.Decimation` in Compose, on an environment that shows ``every_step``, what
    :func:`~torchrl_athletic.robots.with_bucket` measures, at every step. Until the ball is there, its position is 0.

    Writes ``ball_position``, ``ball_linear_velocity`` (N, 3) in world axes; ``ball_away`` (N, 1), whether it has left
    the bucket; ``ball_age`` (N, 1), steps since the phase or the episode began in which it is put in; and
    ``ball_launch_velocity`` (N, 3), with which it left, or would leave now; 0 until the ball is there.

    Args:
        dt: Of a step at this place in the chain [s].
        rim: Of the bucket, above the centre of a ball that lies on its bottom [m].
        radius: Of the ball [m].
        placed_at: When the ball is put into the bucket [s].
        phase: Number of the task's phase from whose beginning that time counts; an episode that starts in a later one
            has no ball. None counts from the episode's start.
        phase_key: Of the number of the phase, which may be shown at the policy's rate.

    Raises:
        ValueError: If a step takes no time.

    Source:
        Fey et al. 2025, appendix B-A.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import Bucket, with_bucket, z1
        >>> base = TorqueEnv(with_bucket(z1(), Bucket()), num_envs=1, every_step=BallFlight.every_step)
        >>> flight = BallFlight(0.005, rim=Bucket().rim, radius=Bucket().ball_radius, placed_at=0.01)
        >>> shown = TransformedEnv(base, flight).rollout(2)["next"]
        >>> (shown["ball_position"] == shown["bucket_position"]).all(-1)  # put in at the second step
        tensor([[False,  True]])
    """

    every_step = ("bucket_position", "bucket_linear_velocity", "bucket_axis")
    """Sensors that it reads at every step of the physics."""

    def __init__(
        self,
        dt: float,
        *,
        rim: float,
        radius: float,
        placed_at: float = 1.5,
        phase: int | None = None,
        phase_key: NestedKey = "task_phase_index",
    ) -> None:
        if not dt > 0:
            raise ValueError(f"dt is {dt} s, needed is more than 0: the ball would hang in the air.")
        out_keys: list[NestedKey] = [
            "ball_position",
            "ball_linear_velocity",
            "ball_away",
            "ball_age",
            "ball_launch_velocity",
        ]
        super().__init__(list(self.every_step), out_keys)
        self.dt, self.rim, self.radius, self.phase, self.phase_key = dt, rim, radius, phase, phase_key
        self.placed = round(placed_at / dt)

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        position = torch.zeros_like(tensordict_reset.get("bucket_position"))
        age = torch.zeros_like(position[..., :1], dtype=torch.int64)
        values = (position, position.clone(), torch.zeros_like(age, dtype=torch.bool), age, position.clone())
        return dict(zip(self.out_keys, values, strict=True))

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        bucket_position, bucket_velocity, axis = (next_tensordict.get(key) for key in self.every_step)
        position, velocity, away, age, launch = (tensordict.get(key) for key in self.out_keys)
        if self.phase is None:
            age = age + 1
        else:
            age = age + ((tensordict.get(self.phase_key) == self.phase) | (age > 0))
        inside = ball.carry(
            position, velocity, bucket_position, bucket_velocity, axis, tensordict.get("bucket_axis"), self.rim, self.dt
        )
        outside = ball.fly(position, velocity, self.dt, self.radius)
        position, velocity = (torch.where(away, *pair) for pair in zip(outside, inside, strict=False))
        is_put, to_come = age == self.placed, age < self.placed
        position = torch.where(is_put, bucket_position, position).masked_fill(to_come, 0.0)
        velocity = torch.where(is_put, bucket_velocity, velocity).masked_fill(to_come, 0.0)
        launch = torch.where(away, launch, velocity)
        away = (away | inside[2]) & (age > self.placed)
        for key, value in zip(self.out_keys, (position, velocity, away, age, launch), strict=True):
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        place = observation_spec["bucket_position"]
        flag = Bounded(0, 1, shape=(*place.shape[:-1], 1), dtype=torch.bool, device=place.device)
        age = Unbounded(shape=flag.shape, dtype=torch.int64, device=place.device)
        return dict(zip(self.out_keys, (place.clone(), place.clone(), flag, age, place.clone()), strict=True))
