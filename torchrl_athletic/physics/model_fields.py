"""Fields of ``mjModel`` that differ between envs, and the two ways in which a write to one goes unheard."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor


def has_constants(name: str) -> bool:
    """Whether other fields are computed from this one by ``mj_setConst``, and would be left behind by a bare write.

    A bare write to ``body_ipos``, for one, changes nothing where the compiler had found body and inertial frame equal.
    """
    return name in mujoco.MjModel._setconst_inputs or name.startswith("opt.")


def refuse_ignored_limits(model: mujoco.MjModel, name: str, value: Tensor, fields: Sequence[str]) -> None:
    """Raise if ``value`` sets limits of something that the model does not limit, which MuJoCo would not look at.

    Args:
        model: The model that all envs share.
        name: The field, such as ``jnt_range``, which ``jnt_limited`` switches on.
        value: Shape (n, rows, 2).
        fields: Fields with values per env: where the switch is among them, it is the caller's.
    """
    flag = name.removesuffix("range") + "limited"
    if not name.endswith("range") or not hasattr(model, flag) or flag in fields:
        return
    changed = (value != torch.from_numpy(getattr(model, name))).any(-1).any(0)
    for row in torch.nonzero(changed).flatten().tolist():
        if not getattr(model, flag)[row]:
            raise ValueError(
                f"{name}[{row}] would be ignored, since the model's {flag}[{row}] is 0. Give it a range in the MJCF."
            )
