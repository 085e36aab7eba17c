"""A small environment in which everything that can trip a transform happens within a few steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase


class ToyEnv(EnvBase):
    """A batch of joints that follow their action; no two rows behave alike.

    Rows differ in gain, in start and in the length of their episodes, and the row's number alone says how: an
    environment of one row with ``first_row=2`` does, bit for bit, what row 2 of a larger one does. Episodes end after
    ``shortest`` to ``shortest`` + 4 steps, terminated or truncated in turn. It honours the mask ``_step`` and, at a
    reset, ``reset_qpos`` and ``reset_qvel`` (*B, J).

    Entries, J joints: the action (*B, J); ``joint_position``, ``joint_velocity`` (*B, J) and both in ``observation``
    (*B, 2 J); what ``extra`` names, which is made of the position.

    Args:
        num_envs: Rows; None makes an environment without batch dimension.
        first_row: Number of the first.
        joints: J.
        groups: Robots in a row. Each has the action and the observations under its name; without any they stand at the
            root.
        done_in_groups: Put the flags of the episode's end there too.
        action: Name of the action.
        extra: Shapes of further observations, without the batch.
        shortest: Length of the shortest episode [steps].
        native_autoreset: Start the next episode in the step that ends one.
        dtype: Of actions, observations and reward.
        device: Of all tensors.

    Example:
        >>> env = ToyEnv(num_envs=2)
        >>> env.rollout(8, break_when_any_done=False)["next", "done"].sum(1).squeeze(-1).tolist()
        [1, 2]
    """

    supports_partial_step = True

    def __init__(
        self,
        num_envs: int | None = 3,
        *,
        first_row: int = 0,
        joints: int = 3,
        groups: Sequence[str] = (),
        done_in_groups: bool = False,
        action: str = "action",
        extra: Mapping[str, Sequence[int]] | None = None,
        shortest: int = 2,
        native_autoreset: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        batch = [] if num_envs is None else [num_envs]
        super().__init__(device=torch.device(device), batch_size=batch)
        self.joints, self.groups, self.action, self.shortest = joints, tuple(groups), action, shortest
        self.done_in_groups, self.extra = done_in_groups, dict(extra or {})
        self.native_autoreset = native_autoreset
        if native_autoreset:
            self.__dict__["_torchrl_native_autoreset"] = True
        count = 1 if num_envs is None else num_envs
        self._row = (torch.arange(count, device=self.device) + first_row).reshape(batch)
        self._time, self._episode = torch.zeros_like(self._row), torch.zeros_like(self._row)
        self._gain = (1 + (self._row % 5).to(dtype) / 8).unsqueeze(-1)
        shape = (max(1, len(groups)), *batch, joints)
        self._position = torch.zeros(shape, dtype=dtype, device=self.device)
        self._velocity = torch.zeros_like(self._position)
        self._make_specs(dtype)

    @property
    def joint_groups(self) -> dict[str, tuple[int, ...]]:
        """Numbers of some joints by name, as transforms look them up: neighbours, and joints that are apart."""
        last = self.joints - 1
        return {"neighbours": tuple(range(1, self.joints)), "apart": (0, last) if last > 1 else (0,)}

    def _make_specs(self, dtype: torch.dtype) -> None:
        batch, device = self.batch_size, self.device

        def spec(*shape: int) -> Unbounded:
            return Unbounded(shape=(*batch, *shape), dtype=dtype, device=device)

        def grouped(entries: dict[str, object], groups: Sequence[str]) -> Composite:
            def composite(content: dict[str, object]) -> Composite:
                return Composite(content, shape=batch, device=device)

            return composite({group: composite(entries) for group in groups} if groups else entries)

        shown = {"joint_position": spec(self.joints), "joint_velocity": spec(self.joints)}
        shown["observation"] = spec(2 * self.joints)
        shown |= {name: spec(*shape) for name, shape in self.extra.items()}
        flags = {
            name: Binary(shape=(*batch, 1), dtype=torch.bool, device=device)
            for name in ("done", "terminated", "truncated")
        }
        self.action_spec = grouped({self.action: spec(self.joints)}, self.groups)
        self.observation_spec = grouped(shown, self.groups)
        self.reward_spec = spec(1)
        self.done_spec = grouped(flags, self.groups if self.done_in_groups else ())

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        starts = torch.ones_like(self._row, dtype=torch.bool)
        position = velocity = None
        if tensordict is not None:
            mask = tensordict.get(self.reset_keys[0], None)
            starts = starts if mask is None else mask.reshape(self.batch_size)
            position, velocity = tensordict.get("reset_qpos", None), tensordict.get("reset_qvel", None)
        self._start(starts, position, velocity)
        return self._tensordict(self._flags(torch.zeros_like(self._row, dtype=torch.bool)))

    def _start(self, starts: Tensor, position: Tensor | None = None, velocity: Tensor | None = None) -> None:
        self._episode = self._episode + starts
        self._time = torch.where(starts, 0, self._time)
        joint = torch.arange(self.joints, device=self.device)
        if position is None:
            offset = (self._row + 2 * self._episode) % 7
            position = offset.unsqueeze(-1).to(self._position.dtype) / 4 + joint.to(self._position.dtype) / 8
        if velocity is None:
            velocity = torch.zeros_like(position)
        starts = starts.unsqueeze(-1)
        self._position = torch.where(starts, position, self._position)
        self._velocity = torch.where(starts, velocity, self._velocity)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        force = torch.stack([tensordict.get(key).clamp(-8, 8) for key in self.action_keys])
        velocity = 0.875 * self._velocity + 0.25 * self._gain * force
        position = self._position + 0.125 * velocity
        time = self._time + 1
        goes = tensordict.get("_step", None)
        if goes is not None:
            goes = goes.reshape(self.batch_size)
            velocity = torch.where(goes.unsqueeze(-1), velocity, self._velocity)
            position = torch.where(goes.unsqueeze(-1), position, self._position)
            time = torch.where(goes, time, self._time)
        self._position, self._velocity, self._time = position, velocity, time
        ended = time >= self.shortest + (3 * self._row + 2 * self._episode) % 5
        flags = self._flags(ended)
        reward = position[0, ..., :1] * velocity[0, ..., :1]
        if self.native_autoreset:
            self._start(ended)
        return self._tensordict(flags).set("reward", reward)

    def _flags(self, ended: Tensor) -> dict[str, Tensor]:
        fails = (self._row + self._episode) % 2 == 0
        flags = {"done": ended, "terminated": ended & fails, "truncated": ended & ~fails}
        return {name: flag.unsqueeze(-1) for name, flag in flags.items()}

    def _tensordict(self, flags: dict[str, Tensor]) -> TensorDict:
        shown = TensorDict(batch_size=self.batch_size, device=self.device)
        for number, position in enumerate(self._position.unbind(0)):
            velocity = self._velocity[number]
            entries = {
                "joint_position": position,
                "joint_velocity": velocity,
                "observation": torch.cat((position, velocity), -1),
            }
            for name, shape in self.extra.items():
                width = torch.Size(shape).numel()
                entries[name] = (position[..., :1] + torch.arange(width, device=self.device)).unflatten(-1, shape)
            for name, value in entries.items():
                shown.set(self._key(number, name), value)
            if self.done_in_groups or number == 0:
                for name, flag in flags.items():
                    shown.set(self._key(number, name) if self.done_in_groups else name, flag.clone())
        return shown

    def _key(self, number: int, name: str) -> NestedKey:
        return (self.groups[number], name) if self.groups else name

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""
