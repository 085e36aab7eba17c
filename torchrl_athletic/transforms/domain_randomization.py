"""Robots and grounds that differ from one episode to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import randomization, streams
from torchrl_athletic.transforms.simulated import once_per_model, refuse_undeclared, refuse_undoing, simulated_env
from torchrl_athletic.transforms.stateful import (
    Joints,
    RandomTransform,
    joint_index,
    reset_mask,
    unbounded_like,
)

Range: TypeAlias = tuple[float, float] | None
"""Least and greatest value; None leaves the quantity as the model has it."""


@dataclass(frozen=True)
class RandomizationRanges:
    """What differs, and by how much. Defaults are the paper's; encoders and lag have transforms of their own.

    The roughness of the terrain, 0 to 2.5 cm, is part of the model: :class:`~torchrl_athletic.robots.Terrain`, where an
    episode that starts on another tile has drawn another roughness. The policy's lag is :class:`ActionDelay`, the
    offset of encoders :class:`EncoderOffset`.

    Source:
        Fey et al. 2025, appendix A, table of domain randomisation.
    """

    friction: Range = (0.5, 4.0)
    """Sliding friction of the ground [1]."""
    restitution: Range = (0.0, 0.5)
    """Restitution of the ground, :func:`~torchrl_athletic.functional.randomization.restitution_solref` [1].

    Undamped by anything else, MuJoCo's own default ground returns 0.14.
    """
    stiffness_scale: Range = (0.9, 1.1)
    """Scale of ``kp``, joint by joint [1]."""
    damping_scale: Range = (0.5, 1.5)
    """Scale of ``kd``, joint by joint [1]."""
    torque_limit_scale: Range = (0.9, 1.1)
    """Scale of the torque at standstill, joint by joint [1]."""
    mass_scale: Range = (0.5, 1.5)
    """Scale of each link's mass and inertia [1]."""
    com_offset: Range = (-0.02, 0.02)
    """Offset of each link's centre of mass, along each of its axes [m]."""
    joint_friction_scale: Range = None
    """Scale of the Coulomb friction in the model, joint by joint [1]. This and the next two are not in the paper's
    table: its baseline for the arm randomises them and does not say by how much."""
    joint_damping_scale: Range = None
    """Scale of the viscous friction in the model, joint by joint [1]."""
    armature_scale: Range = None
    """Scale of the rotors' inertia, joint by joint [1]."""

    def __post_init__(self) -> None:
        for name, between in vars(self).items():
            if between is not None and not between[0] <= between[1]:
                raise ValueError(f"{name} is {between}: no number lies between. Give (least, greatest).")
        if self.restitution is not None and not 0 <= self.restitution[0] <= self.restitution[1] < 1:
            raise ValueError(
                f"restitution is {self.restitution}: at 1 or more a bounce would never end. Give 0 or more, below 1."
            )


_FIELDS = {
    "friction": ("geom_friction",),
    "restitution": ("geom_solref",),
    "mass_scale": ("body_mass", "body_inertia"),
    "com_offset": ("body_ipos",),
    "joint_friction_scale": ("dof_frictionloss",),
    "joint_damping_scale": ("dof_damping",),
    "armature_scale": ("dof_armature",),
}
_OF_JOINTS = ("joint_friction_scale", "joint_damping_scale", "armature_scale")


@dataclass(frozen=True, eq=False)
class _OfModel:
    """What the draws are about, on the physics' device."""

    bodies: Tensor
    ground: Tensor
    mass: Tensor
    inertia: Tensor
    com: Tensor
    friction: Tensor
    solref: Tensor
    dofs: Tensor
    """Degrees of freedom of the joints whose drives differ."""
    joints: dict[str, Tensor]
    """Values of these joints by field."""


class DomainRandomization(RandomTransform):
    """Draw another robot on other ground for each episode.

    What belongs to the model is written to the fields of the physics, row by row: give them to the environment,
    ``TorqueEnv(robot, fields=randomization.fields)``. What belongs to the drives is shown as entries of shape (*B, J),
    1 for joints outside the group, which :class:`PDControl` and :class:`TorqueSpeedClip` read. Two of these transforms,
    for two groups of joints say, multiply their scales; each needs a ``drawn_key`` and a seed of its own.

    Args:
        ranges: What differs.
        joints: Whose drives differ; those of the legs in the paper, where the arm's are corrected by a net instead.
        bodies: Names of the links that differ; None takes all of the robot that have a mass, not its ``loads``.
        ground: Names of the geoms to stand on, whose friction and softness must rule in their contacts (``priority`` in
            MJCF); None takes the robot's.
        every_episode: Whether to draw anew for each episode, or once for each row.
        kp_key: Where to show the scale of ``kp`` [1].
        kd_key: Of ``kd``.
        torque_limit_key: Of the torque limit.
        drawn_key: Where to show all that was drawn, each number within [-1, 1] of its range, in the order of the
            ranges: an observation for the critic. Shape (*B, D).
        position_key: Tells the number of joints.
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: On an environment without these fields, joints, bodies or geoms.

    Source:
        Fey et al. 2025, section II-B and appendix A.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> ranges = RandomizationRanges(friction=None, restitution=None)
        >>> randomization = DomainRandomization(ranges, joints="arm")
        >>> env = TransformedEnv(TorqueEnv(z1(), num_envs=3, fields=randomization.fields), randomization)
        >>> env.reset()["kp_scale"].shape, env.physics.field("body_mass").sum(-1).unique().numel()
        (torch.Size([3, 7]), 3)
    """

    def __init__(
        self,
        ranges: RandomizationRanges | None = None,
        joints: Joints = "leg",
        *,
        bodies: Sequence[str] | None = None,
        ground: Sequence[str] | None = None,
        every_episode: bool = True,
        kp_key: NestedKey = "kp_scale",
        kd_key: NestedKey = "kd_scale",
        torque_limit_key: NestedKey = "torque_limit_scale",
        drawn_key: NestedKey = "randomization",
        position_key: NestedKey = "joint_position",
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        ranges = RandomizationRanges() if ranges is None else ranges
        keys = {"stiffness_scale": kp_key, "damping_scale": kd_key, "torque_limit_scale": torque_limit_key}
        self.scales = {name: key for name, key in keys.items() if getattr(ranges, name) is not None}
        out_keys = [drawn_key, *self.scales.values()]
        super().__init__([], out_keys, seed=seed, first_row=first_row, reset_key=reset_key)
        self.ranges, self.joints, self.bodies, self.ground = ranges, joints, bodies, ground
        self.every_episode, self.drawn_key, self.position_key = every_episode, drawn_key, position_key
        self._shared: frozenset[NestedKey] = frozenset()

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields of the model, that differ between rows."""
        return tuple(
            field for name, fields in _FIELDS.items() if getattr(self.ranges, name) is not None for field in fields
        )

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        episode = self.episode if self.every_episode else torch.ones_like(self.episode)
        return self.draw(self._streams(episode), tensordict_reset)

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        drawn = streams.uniform(key, sum(self._widths().values()), -1.0, 1.0)
        parts = self._parts(drawn)
        first = {self.drawn_key: drawn}
        for name, entry in self.scales.items():
            scale = torch.ones_like(tensordict_reset.get(self.position_key), dtype=drawn.dtype)
            scale[..., joint_index(self, self.joints)] = randomization.in_range(
                parts[name], *getattr(self.ranges, name)
            )
            others = tensordict_reset.get(entry, None) if entry in self._shared else None
            first[entry] = scale if others is None else scale * others
        return first

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        for key in self.out_keys:
            next_tensordict.set(key, tensordict.get(key))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._check_declared()
        tensordict_reset = super()._reset(tensordict, tensordict_reset)
        if self.fields:
            starts = reset_mask(tensordict, self.reset_key)
            rows = None if starts is None else starts.reshape(*self.episode.shape, -1).any(-1)
            self._change_model(tensordict_reset.get(self.drawn_key), rows)
        return tensordict_reset

    def _change_model(self, drawn: Tensor, rows: Tensor | None) -> None:
        """Write the fields of some rows. Drawn numbers have shape (N, D)."""
        physics = simulated_env(self).physics
        now = {field: physics.field(field) for field in self.fields}
        physics.set_fields(self.values_of(drawn.to(physics.dtype), now), envs=rows)

    def values_of(self, drawn: Tensor, now: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Fields of the model for what was drawn.

        Args:
            drawn: Shape (N, D).
            now: The fields as they are, each with a row for each env: what is no link of the robot stays.
        """
        ranges, given = self.ranges, once_per_model(self, self._of_model)
        parts = self._parts(drawn)
        values: dict[str, Tensor] = {}

        def change(field: str, at: Tensor, value: Tensor) -> None:
            values[field] = now[field].clone()
            values[field][:, at] = value

        if ranges.friction is not None:
            value = given.friction.expand(len(drawn), -1, -1).clone()
            value[..., 0] = randomization.in_range(parts["friction"], *ranges.friction)
            change("geom_friction", given.ground, value)
        if ranges.restitution is not None:
            bounce = randomization.in_range(parts["restitution"], *ranges.restitution).expand(-1, len(given.ground))
            solref = given.solref.expand(len(drawn), -1, -1)
            change("geom_solref", given.ground, randomization.restitution_solref(solref, bounce))
        if ranges.mass_scale is not None:
            scale = randomization.in_range(parts["mass_scale"], *ranges.mass_scale)
            change("body_mass", given.bodies, given.mass * scale)
            change("body_inertia", given.bodies, given.inertia * scale.unsqueeze(-1))
        if ranges.com_offset is not None:
            offset = randomization.in_range(parts["com_offset"], *ranges.com_offset)
            change("body_ipos", given.bodies, given.com + offset.unflatten(-1, (-1, 3)))
        for name in _OF_JOINTS:
            between, (field,) = getattr(ranges, name), _FIELDS[name]
            if between is not None:
                scale = randomization.in_range(parts[name], *between)
                value = given.joints[field]
                change(field, given.dofs, value * (scale if value.ndim == 1 else scale.unsqueeze(-1)))
        return values

    def _parts(self, drawn: Tensor) -> dict[str, Tensor]:
        """Drawn numbers by what they are for."""
        widths = self._widths()
        return dict(zip(widths, drawn.split(list(widths.values()), -1), strict=True))

    def _widths(self, position: TensorSpec | None = None) -> dict[str, int]:
        """How many numbers each quantity takes; where specs are being made, the parent would make them all again."""
        if position is None:
            position = self.parent.full_observation_spec[self.position_key]
        joints = position.zero()[..., joint_index(self, self.joints)].shape[-1]
        width = {"friction": 1, "restitution": 1}
        width |= dict.fromkeys(("stiffness_scale", "damping_scale", "torque_limit_scale"), joints)
        of_joints = dict.fromkeys(_OF_JOINTS, joints)
        if self.fields:
            bodies = len(once_per_model(self, self._of_model).bodies)
            width |= {"mass_scale": bodies, "com_offset": 3 * bodies}
        width |= of_joints
        return {name: count for name, count in width.items() if getattr(self.ranges, name) is not None}

    def _of_model(self, env: Any) -> _OfModel:
        physics, model = env.physics, env.physics.model
        if self.bodies is None:
            loads = {int(model.body(name).id) for name in env.robot.loads}
            bodies = [body for body in range(1, model.nbody) if model.body_mass[body] > 0 and body not in loads]
        else:
            bodies = [int(model.body(name).id) for name in self.bodies]
        on_ground = self.ranges.friction is not None or self.ranges.restitution is not None
        names = (env.robot.ground if self.ground is None else self.ground) if on_ground else ()
        driven = joint_index(self, self.joints)
        chosen = range(len(env.robot.joint_names))[driven] if isinstance(driven, slice) else driven.tolist()
        dofs = [int(model.joint(env.robot.joint_names[j]).dofadr[0]) for j in chosen]
        ground = [int(model.geom(name).id) for name in names]
        if self.ground is None:
            _refuse_weak(model, ground)

        def tensor(values: Any, dtype: torch.dtype = physics.dtype) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=physics.device)

        return _OfModel(
            bodies=tensor(bodies, torch.int64),
            ground=tensor(ground, torch.int64),
            mass=tensor(model.body_mass[bodies]),
            inertia=tensor(model.body_inertia[bodies]),
            com=tensor(model.body_ipos[bodies]),
            friction=tensor(model.geom_friction[ground]),
            solref=tensor(model.geom_solref[ground]),
            dofs=tensor(dofs, torch.int64),
            joints={field: tensor(getattr(model, field)[dofs]) for name in _OF_JOINTS for field in _FIELDS[name]},
        )

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        self._check_declared()
        refuse_undoing(self, self.written())
        shown = observation_spec.keys(True)
        if self.drawn_key in shown:
            raise ValueError(
                f"another transform shows {self.drawn_key!r} already, a DomainRandomization say: what the two draw "
                "would be mixed up. Give this one a drawn_key of its own, and another seed."
            )
        self._shared = frozenset(entry for entry in self.scales.values() if entry in shown)
        position = observation_spec[self.position_key]
        drawn = (*position.shape[:-1], sum(self._widths(position).values()))
        specs: dict[NestedKey, TensorSpec] = {self.drawn_key: Unbounded(drawn, device=position.device)}
        return specs | {key: unbounded_like(position, position.shape) for key in self.scales.values()}

    def _check_declared(self) -> None:
        """Raise unless the model can differ as it shall."""
        mend = "Make it with TorqueEnv(..., fields=randomization.fields), or set the ranges that need them to None."
        refuse_undeclared(self, self.fields, mend)

    def written(self) -> dict[str, set[int]]:
        """Rows of each field that this transform writes."""
        if not self.fields:
            return {}
        given = once_per_model(self, self._of_model)
        rows = {"geom_friction": given.ground, "geom_solref": given.ground}
        rows |= dict.fromkeys(("body_mass", "body_inertia", "body_ipos"), given.bodies)
        rows |= dict.fromkeys(("dof_frictionloss", "dof_damping", "dof_armature"), given.dofs)
        return {name: set(rows[name].tolist()) for name in self.fields}


def _refuse_weak(model: Any, ground: Sequence[int]) -> None:
    """Raise where the ground's friction and softness would not rule in its contacts."""
    kind, others = model.geom_contype, model.geom_conaffinity
    standing = model.body_weldid[model.geom_bodyid] == 0  # what is fixed touches nothing that is
    for geom in ground:
        touching = ((kind & others[geom]) | (others & kind[geom])) != 0
        touching &= ~(standing & standing[geom])
        touching[list(ground)] = False
        most = int(model.geom_priority[touching].max(initial=-1))
        if model.geom_priority[geom] <= most:
            raise ValueError(
                f"the ground {model.geom(geom).name!r} has priority {model.geom_priority[geom]}, what touches it up to "
                f"{most}: MuJoCo would mix both frictions, and what is drawn would not rule. Give it "
                f'priority="{most + 1}" in the MJCF, or draw neither friction nor restitution.'
            )
