"""A weight that the robot takes up in the midst of an episode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import streams
from torchrl_athletic.transforms.simulated import once_per_model, refuse_undeclared, refuse_undoing, simulated_env
from torchrl_athletic.transforms.stateful import RandomTransform, reset_mask, spread


@dataclass(frozen=True, eq=False)
class _Body:
    """What is loaded."""

    number: int
    inertia: Tensor
    """Inertia of each kilogram, on the physics' device [m²]. Shape (3,)."""


class AddedMass(RandomTransform):
    """Give a body its weight when a phase of the task begins, and take it away when the next episode starts.

    Each episode draws a mass. Until the phase begins the body weighs next to nothing, from then on the mass, with the
    inertia that its shape has of that mass: as if the model had been compiled with it. It acts from the first physics
    step of the phase on. Put it outside :class:`~.Decimation`, after :class:`TaskPhase`, and give the fields to the
    environment, ``TorqueEnv(robot, fields=load.fields)``; with those of a :class:`DomainRandomization`, before or after
    this transform, if it randomises the robot's links too.

    A GPU cannot leave out what there is nothing to do for: there the fields are written after each step. In a captured
    step the softness of a row's contacts and joint friction may follow some steps after its mass, if more than 128
    rows take up their loads at once (:class:`~torchrl_athletic.physics.WarpPhysics`).

    Args:
        body: Its name, such as that of :class:`~torchrl_athletic.robots.Dumbbell`.
        mass: Least and greatest [kg].
        phase: Number of the phase from whose beginning on it is there; an episode that starts there starts with it.
        phase_key: Of the number of the phase that is on. int64, shape (*B, 1).
        mass_key: Where to show what is carried now: 0 before the phase [kg]. Shape (*B, 1).
        load_key: Where to show what is or will be carried, for the critic [kg]. Shape (*B, 1).
        empty_mass: Of the body before, and the least that it has with a load [kg].
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If no mass lies in the range; on an environment without these fields, such a body or phases, or
            where another transform writes the masses of the same body.

    Source:
        Fey et al. 2025, section III, dumbbell snatch: 0 to 10 kg, added to the gripper.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.functional.phase import Phase, PhaseSchedule
        >>> from torchrl_athletic.robots import Dumbbell, z1
        >>> from torchrl_athletic.transforms import TaskPhase
        >>> phases, load = PhaseSchedule((Phase("reach", 0.01), Phase("lift"))), AddedMass(mass=(2.0, 2.0))
        >>> base = TorqueEnv(z1(tool=Dumbbell()), fields=load.fields)
        >>> env = TransformedEnv(base, Compose(TaskPhase(phases, dt=0.005), load))
        >>> env.rollout(3)["added_mass"].flatten().tolist(), base.physics.field("body_mass")[0, -1].item()
        ([0.0, 0.0, 2.0], 2.0)
    """

    fields = ("body_mass", "body_inertia")
    """Fields of the model, that differ between rows."""

    def __init__(
        self,
        body: str = "dumbbell",
        mass: tuple[float, float] = (0.0, 10.0),
        *,
        phase: int = 1,
        phase_key: NestedKey = "task_phase_index",
        mass_key: NestedKey = "added_mass",
        load_key: NestedKey = "load_mass",
        empty_mass: float = 1e-3,
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not 0 <= mass[0] <= mass[1] < math.inf:
            raise ValueError(f"mass is {mass} kg: no weight lies between. Give (least, greatest), neither below 0.")
        if not empty_mass > 0:
            raise ValueError(f"empty_mass is {empty_mass} kg, without which MuJoCo has no body. Give a little, 0.001.")
        super().__init__([phase_key], [mass_key, load_key], seed=seed, first_row=first_row, reset_key=reset_key)
        self.body, self.mass, self.phase, self.empty_mass = body, mass, phase, empty_mass
        self.phase_key, self.mass_key, self.load_key = phase_key, mass_key, load_key

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        load = streams.uniform(key, 1, *self.mass)
        return {self.mass_key: self._carried(load, tensordict_reset), self.load_key: load}

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        load = tensordict.get(self.load_key)
        carried = self._carried(load, next_tensordict)
        next_tensordict.set(self.load_key, load).set(self.mass_key, carried)
        differ = carried != tensordict.get(self.mass_key)
        if differ.device.type != "cpu" or torch.compiler.is_compiling() or bool(differ.any()):
            self._change_model(carried, differ.flatten())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._check_declared()
        tensordict_reset = super()._reset(tensordict, tensordict_reset)
        starts, carried = reset_mask(tensordict, self.reset_key), tensordict_reset.get(self.mass_key)
        self._change_model(carried, None if starts is None else spread(starts, carried).flatten())
        return tensordict_reset

    def _carried(self, load: Tensor, shown: TensorDictBase) -> Tensor:
        number = shown.get(self.phase_key, None)
        if number is None:
            raise self._no_phases()
        return torch.where(number >= self.phase, load, 0.0)

    def _change_model(self, carried: Tensor, rows: Tensor | None) -> None:
        """Write the body's mass and inertia in some rows. Carried masses have shape (N, 1)."""
        physics, body = simulated_env(self).physics, once_per_model(self, self._find_body)
        mass = carried.to(physics.dtype).clamp(min=self.empty_mass)
        now = {field: physics.field(field).clone() for field in self.fields}
        now["body_mass"][:, body.number] = mass[:, 0]
        now["body_inertia"][:, body.number] = mass * body.inertia
        physics.set_fields(now, envs=rows)

    def _find_body(self, env: Any) -> _Body:
        physics, model = env.physics, env.physics.model
        known = [model.body(number).name for number in range(model.nbody)]
        if self.body not in known:
            raise ValueError(
                f"AddedMass: the model has no body {self.body!r}; it has {known}. Name one of these, or give the robot "
                "something to hold: b2z1(tool=Dumbbell())."
            )
        number = known.index(self.body)
        mass = model.body_mass[number]
        if not mass > 0:
            raise ValueError(
                f"body {self.body!r} weighs {mass} kg in the model, which tells no shape to spread a mass over. "
                "Give it some mass there; how much does not matter."
            )
        inertia = torch.tensor(model.body_inertia[number] / mass, dtype=physics.dtype, device=physics.device)
        return _Body(number, inertia)

    def written(self) -> dict[str, set[int]]:
        """Rows of each field that this transform writes."""
        return {field: {once_per_model(self, self._find_body).number} for field in self.fields}

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        self._check_declared()
        refuse_undoing(self, self.written())
        if self.phase_key not in observation_spec.keys(True):
            raise self._no_phases()
        batch, device = observation_spec.shape, observation_spec.device
        return {key: Unbounded((*batch, 1), device=device) for key in (self.mass_key, self.load_key)}

    def _check_declared(self) -> None:
        """Raise unless rows can differ in their masses."""
        refuse_undeclared(self, self.fields, "Make it with TorqueEnv(..., fields=load.fields).")

    def _no_phases(self) -> ValueError:
        return ValueError(
            f"AddedMass reads {self.phase_key!r}, which nothing before it shows: it would not know when. Put "
            "TaskPhase(schedule, dt) before it, with a schedule, or name the key: phase_key=..."
        )
