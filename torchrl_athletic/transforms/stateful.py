"""What every transform with a memory shares: the memory is in the tensordict, and an episode's start renews it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_athletic.functional import streams

Joints: TypeAlias = str | Sequence[int] | slice | None
"""Joints of a robot: the name of a group that the environment knows, their numbers, or None for all of them."""


class StatefulTransform(Transform):
    """A transform that remembers something from one step to the next.

    TorchRL resets environments in three ways: some rows of a batch after a step, whatever ``env.reset(tensordict)``
    names, or, in environments that reset themselves, in the step. Here all three come down to :meth:`initial`, whose
    rows replace those of the episodes that start. What is remembered stands in the tensordict and in the specs, so it
    survives cloning, compilation, and checkpoints with another number of environments.

    Subclasses say what an episode starts with (:meth:`initial`), what a step makes of it (:meth:`advance`) and what the
    entries look like (:meth:`state_spec`). Those on the way of the action write to the tensordict in ``_inv_call``,
    which :meth:`advance` sees.

    Args:
        in_keys: What :meth:`advance` reads of the environment.
        out_keys: What it writes, memory included.
        in_keys_inv: As of :class:`~torchrl.envs.Transform`.
        out_keys_inv: As of :class:`~torchrl.envs.Transform`.
        reset_key: Which rows start anew; None takes the environment's, if it has one.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        in_keys_inv: Sequence[NestedKey] = (),
        out_keys_inv: Sequence[NestedKey] = (),
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__(
            in_keys=list(in_keys),
            out_keys=list(out_keys),
            in_keys_inv=list(in_keys_inv),
            out_keys_inv=list(out_keys_inv),
        )
        self._given_reset_key = reset_key
        self._specs: dict[str, Any] = {}  # asked of the parent anew, they would cost the square of a chain's length

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        """What every entry of :meth:`state_spec` is when an episode starts.

        Args:
            tensordict_reset: What the environment shows after its reset; rows that go on hold values of no meaning.

        Returns:
            A value for the whole batch, of which the rows that start are taken.
        """
        raise NotImplementedError

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        """Write every entry of :meth:`state_spec` after a step.

        Args:
            tensordict: What the step started from, with what ``_inv_call`` wrote.
            next_tensordict: What the environment shows after it. To be written.
        """
        raise NotImplementedError

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        """Entries that are remembered, given what the environment shows."""
        raise NotImplementedError

    @property
    def reset_key(self) -> NestedKey:
        """Key of the mask of rows that start anew."""
        if self._given_reset_key is not None:
            return self._given_reset_key
        if self.container is not None and len(keys := self.container.reset_keys) == 1:
            return keys[0]  # no need of the parent, which would be built for the question
        keys = ["_reset"] if self.parent is None else self.parent.reset_keys
        if len(keys) > 1:
            raise ValueError(
                f"{type(self).__name__} cannot tell which of the environment's reset keys {keys} starts its episodes. "
                "Name one: reset_key=..."
            )
        return keys[0]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.advance(tensordict, next_tensordict)
        return next_tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        reset_key = self.reset_key
        starts = reset_mask(tensordict, reset_key)
        for key, first in self.initial(tensordict_reset).items():
            self._check_place(key, reset_key)
            old = tensordict.get(key, None)
            if starts is None or old is None:
                tensordict_reset.set(key, first)
            else:
                tensordict_reset.set(key, torch.where(spread(starts, first), first, old))
        return tensordict_reset

    def _check_place(self, key: NestedKey, reset_key: NestedKey) -> None:
        """A partial reset merges what stands beside its flag; elsewhere rows that start would keep their memory."""
        place = reset_key[:-1] if isinstance(reset_key, tuple) else ()
        if place and (key if isinstance(key, tuple) else (key,))[: len(place)] != place:
            raise ValueError(
                f"{type(self).__name__} remembers {key!r}, but episodes start by {reset_key!r}: TorchRL would carry "
                f"what is not under {place[-1]!r} from one episode into the next. Name the entry {(*place, key)!r}."
            )

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._specs["state"] = specs = dict(self.state_spec(observation_spec))
        for key, spec in specs.items():
            observation_spec[key] = spec
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """A manual reset hands over what the state spec names, and the rows that go on need their memory."""
        input_spec = super().transform_input_spec(input_spec)
        specs = self._specs.get("state")
        if specs is None:
            specs = self.state_spec(self.parent.full_observation_spec)
        state = input_spec["full_state_spec"]
        if state is None:
            state = Composite(shape=input_spec.shape, device=input_spec.device)
        for key, spec in specs.items():
            state[key] = spec.clone()
        input_spec["full_state_spec"] = state
        return input_spec

    def empty_cache(self) -> None:
        """Called where what lies further in has changed."""
        super().empty_cache()
        self._specs.clear()

    def reset_parent(self) -> None:
        """Called where it leaves its place in a chain."""
        super().reset_parent()
        self._specs.clear()

    def clone(self) -> StatefulTransform:
        """A copy, for another place."""
        copied = super().clone()
        copied._specs = {}
        return copied

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refused: what this transform adds depends on the steps before, which a sample or a module does not have."""
        raise RuntimeError(
            f"{type(self).__name__} remembers earlier steps, so it works on an environment only. What it wrote there "
            f"is in the collected data already: sample {list(map(unravel_key, self.out_keys))} from the buffer."
        )


class RandomTransform(StatefulTransform):
    """A :class:`StatefulTransform` that draws random numbers when an episode starts, and from then on.

    Each row draws from a stream of its own, named by the seed, the class, the row's number and how many episodes the
    row has had (:mod:`torchrl_athletic.functional.streams`): the same in a batch as alone. Two transforms of one class
    in one environment need different seeds, or they draw the same numbers.

    Args:
        in_keys: As of :class:`StatefulTransform`.
        out_keys: As of :class:`StatefulTransform`.
        seed: Of the streams.
        first_row: Number of the batch's first row, for copies that shall draw what a row of a larger batch draws.
        in_keys_inv: As of :class:`StatefulTransform`.
        out_keys_inv: As of :class:`StatefulTransform`.
        reset_key: As of :class:`StatefulTransform`.
    """

    episode: Tensor
    """Episodes that each row has had. It names random numbers only, so that no checkpoint has to hold it."""
    row_stream: Tensor
    """What the seed and the row's number open: the stream of each episode branches off."""

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        *,
        seed: int = 0,
        first_row: int = 0,
        in_keys_inv: Sequence[NestedKey] = (),
        out_keys_inv: Sequence[NestedKey] = (),
        reset_key: NestedKey | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv, reset_key)
        self.seed, self.first_row = seed, first_row
        self._salt = zlib.crc32(type(self).__name__.encode())  # or a short delay would always come with a light arm
        for name in ("episode", "row_stream"):
            self.register_buffer(name, torch.empty(0, dtype=torch.int64), persistent=False)

    def clone(self) -> RandomTransform:
        """A copy, for another place, whose episodes are its own."""
        copied = super().clone()
        assert isinstance(copied, RandomTransform)
        copied.episode, copied.row_stream = self.episode.clone(), self.row_stream.clone()
        return copied

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        """What :meth:`initial` is, given a stream for each row. Shape of ``key``: (*B,)."""
        raise NotImplementedError

    def upcoming(self, tensordict: TensorDictBase) -> Tensor:
        """The streams that :meth:`draw` will get of the reset that ``tensordict`` asks for. Shape (*B,).

        For what a transform hands to the environment before it resets, in ``_reset_env_preprocess``.
        """
        self._count_episodes_of(tensordict)
        return self._streams(self.episode + self._starts(tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._count_episodes_of(tensordict_reset)
        self.episode += self._starts(tensordict)
        return super()._reset(tensordict, tensordict_reset)

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return self.draw(self._streams(self.episode), tensordict_reset)

    def _count_episodes_of(self, tensordict: TensorDictBase) -> None:
        if self.episode.shape != tensordict.batch_size:  # on the environment's device, to which it moved this module
            self.episode = self.episode.new_zeros(tensordict.batch_size)
        if self.row_stream.shape != self.episode.shape:
            row = torch.arange(self.episode.numel(), device=self.episode.device).reshape(self.episode.shape)
            self.row_stream = streams.stream(self.seed + self._salt, row + self.first_row)

    def _starts(self, tensordict: TensorDictBase) -> Tensor | int:
        starts = reset_mask(tensordict, self.reset_key)
        return 1 if starts is None else starts.reshape(*self.episode.shape, -1).any(-1)

    def _streams(self, episode: Tensor) -> Tensor:
        return streams.branch(self.row_stream, episode)


def reset_mask(tensordict: TensorDictBase, reset_key: NestedKey) -> Tensor | None:
    """Rows that start anew, bool in the shape of the done entry; None where all do."""
    return tensordict.get(reset_key, None)


def spread(mask: Tensor, value: Tensor) -> Tensor:
    """The mask, shape (*B, 1), for a value of shape (*B, ...)."""
    while mask.ndim > value.ndim:
        mask = mask.any(-1)
    return mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))


def base_env_of(env: EnvBase | None) -> EnvBase | None:
    """What lies under all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def full_action_spec(transform: StatefulTransform) -> Composite:
    """What the transforms further in take, without asking for what they show, as ``parent.full_action_spec`` would.

    It is made once: a step that is compiled or recorded cannot make it, and a reset reads it. It is made anew where the
    chain changes (:meth:`StatefulTransform.empty_cache`), but not where somebody changes a chain within another one
    behind its back (``TransformedEnv(..., auto_unwrap=False)``). Do not change what is returned.
    """
    if (known := transform._specs.get("action")) is not None:
        return known
    parent = transform.parent
    base = parent.base_env
    spec = Composite(full_action_spec=base.full_action_spec.clone(), shape=base.batch_size, device=base.device)
    spec["full_state_spec"] = base.full_state_spec.clone()
    for part in _in_order(parent.transform):
        if isinstance(part, StatefulTransform):
            spec["full_action_spec"] = part.transform_action_spec(spec["full_action_spec"])
        else:
            spec = part.transform_input_spec(spec)
    found: Composite = spec["full_action_spec"]
    transform._specs["action"] = found
    return found


def full_reward_spec(transform: StatefulTransform) -> Composite:
    """What the transforms further in earn, without asking for what they show, as ``parent.full_reward_spec`` would.

    It is made once, as :func:`full_action_spec` is.
    """
    if (known := transform._specs.get("reward")) is not None:
        return known
    parent = transform.parent
    parts = _in_order(parent.transform)
    if any(type(part).transform_output_spec is not Transform.transform_output_spec for part in parts):
        spec: Composite = parent.full_reward_spec  # some need to see all of what is shown
    else:
        spec = parent.base_env.full_reward_spec.clone()
        for part in parts:
            spec = part.transform_reward_spec(spec)
    transform._specs["reward"] = spec
    return spec


def _in_order(transform: Transform) -> list[Transform]:
    """The parts of a chain, of chains within it too."""
    if isinstance(transform, Compose):
        return [part for inner in transform.transforms for part in _in_order(inner)]
    return [transform]


def joint_index(transform: Transform, joints: Joints) -> slice | Tensor:
    """Columns of the joints, a name being looked up in the environment's ``joint_groups``.

    A slice where they follow one another, since that is a view. Otherwise a tensor on the environment's device: a list
    would be copied there at every use, for which a GPU waits and which a CUDA graph cannot hold.

    Raises:
        ValueError: If the environment has no such group.
    """
    if joints is None:
        return slice(None)
    if isinstance(joints, slice):
        return joints
    parent, chosen = transform.parent, joints
    if isinstance(joints, str):
        env = base_env_of(parent)
        groups = {} if isinstance(env, BatchedEnvBase) else getattr(env, "joint_groups", {})  # workers answer for all
        if joints not in groups:
            known = f"it has {sorted(groups)}" if groups else "it has none: give the joints' numbers"
            raise ValueError(f"{type(transform).__name__}: the environment has no group of joints {joints!r}; {known}.")
        chosen = groups[joints]
    columns = tuple(int(joint) for joint in chosen)
    if columns and columns[0] >= 0 and columns == tuple(range(columns[0], columns[-1] + 1)):
        return slice(columns[0], columns[-1] + 1)
    return _index(columns, None if parent is None else parent.device)


@torch.compiler.assume_constant_result
def _index(columns: tuple[int, ...], device: torch.device | None) -> Tensor:
    return _made_index(columns, device)


@cache
def _made_index(columns: tuple[int, ...], device: torch.device | None) -> Tensor:
    return torch.tensor(columns, dtype=torch.int64, device=device)


def unbounded_like(spec: TensorSpec, shape: Sequence[int]) -> Unbounded:
    """An entry of that shape, of the type and on the device of another."""
    return Unbounded(shape=torch.Size(shape), dtype=spec.dtype, device=spec.device)
