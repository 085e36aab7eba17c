"""Rows of a batch: which envs are meant, and values with a row for each."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_athletic.physics.protocol import Envs, Values


def env_ids(envs: Envs, num_envs: int) -> NDArray[np.int64]:
    """Sorted ids of the envs meant by a mask or by ids.

    Raises:
        ValueError: If the mask is not one bool per env, or an id is not an env's.
    """
    if envs is None:
        return np.arange(num_envs)
    chosen = np.asarray(envs)
    if chosen.dtype != bool:
        ids = np.unique(chosen).astype(np.int64)
        if ids.size and (ids[0] < 0 or ids[-1] >= num_envs):
            raise ValueError(f"envs {ids.tolist()} must be among 0 to {num_envs - 1}.")
        return ids
    check_mask(chosen.shape, num_envs)
    return np.flatnonzero(chosen)


def check_mask(shape: tuple[int, ...], num_envs: int) -> None:
    """Raise unless the mask has one bool per env."""
    if tuple(shape) != (num_envs,):
        raise ValueError(f"the mask of envs has shape {tuple(shape)}, needed is one bool per env, ({num_envs},).")


def expand_to(target: Tensor, value: Values, name: str) -> Tensor:
    """``value`` with a row for each env, in a type that loses nothing.

    Raises:
        ValueError: If its shape does not broadcast to the target's.
    """
    given = value.detach() if isinstance(value, Tensor) else torch.tensor(np.asarray(value))
    try:
        return given.expand(target.shape)
    except RuntimeError as error:
        needed = f"{tuple(target.shape)}, a row for every env, concerned or not, or one value for all"
        raise ValueError(f"{name} has shape {tuple(given.shape)}, needed is {needed}.") from error


def check_shape(name: str, value: Tensor, shape: tuple[int, ...], joint_names: tuple[str, ...]) -> None:
    """Raise unless an input has exactly this shape."""
    if value.shape != shape:
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}, needed is {shape}: {shape[0]} envs and, for torques, the joints "
            f"{joint_names}."
        )
