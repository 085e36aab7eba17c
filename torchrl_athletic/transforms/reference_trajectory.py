"""A motion to go by: shown to the policy as a hint, and as a place for episodes to start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from torchrl_athletic.functional import streams
from torchrl_athletic.functional.reference import AtEnd, pad_references, sample_reference
from torchrl_athletic.transforms.stateful import RandomTransform

References = Mapping[str, Tensor | Sequence[Tensor]]
"""Tables by name, ``joint_position`` say: (T, D) for one reference, (R, T, D) or R of shape (T_r, D) for several."""


@dataclass(frozen=True)
class ReferenceKeys:
    """Entries that a :class:`ReferenceTrajectory` writes."""

    reference: NestedKey = "reference"
    """Reference, shown. Shape (*B, K * D) if flat.

    Otherwise an entry (reference, name) for each table, of shape (*B, D), or (*B, K, D) with K > 1 times.
    """
    id: NestedKey = "reference_id"
    """Number of the reference. int64, shape (*B, 1)."""
    step: NestedKey = "reference_step"
    """Time in the reference [steps]. int64, shape (*B, 1)."""


class ReferenceTrajectory(RandomTransform):
    """Show each episode a tabulated reference at the episode's own time.

    Of several references an episode takes one at random and shows its number. It starts at the reference's beginning,
    or anywhere in it with ``random_start``. With ``reset_state`` the environment starts in the reference's state there
    (reference state initialisation): the transform hands it over as :class:`~torchrl_athletic.envs.TorqueEnv` reads it.
    An environment that resets itself in its step cannot be told, so there the reference is shown only.

    A task in phases has a reference for each: with ``phase_keys``, those of a :class:`~.TaskPhase` that stands before,
    the reference is that of the phase that is on, at the phase's own age. So a phase that lasts longer, or that an
    episode starts in, is shown what belongs to it.

    Columns are interpolated one by one. Where a table holds quaternions, let ``dt`` be a multiple of ``table_dt``, so
    that every time is a sample's, or set ``interpolate=False``.

    Args:
        references: Tables of the same references, by name. See :data:`References`.
        table_dt: Of their samples [s].
        dt: Of a step at this place in the chain [s]: the policy's, if it stands outside :class:`~.Decimation`.
        shown: Names of the tables to show; None shows all but those of ``reset_state``.
        lookahead: Which times to show, in steps from the present.
        flatten: Show one vector, the tables side by side within each time, the times one after another; otherwise an
            entry for each table.
        at_end: Hold the last sample, or start over.
        interpolate: Linearly between samples; otherwise the last sample that was passed holds.
        random_start: Start at any step of the reference, drawn anew for each episode.
        probability: Of each reference, shape (R,); None makes them equally likely.
        phase_keys: Of the number of the task's phase and its age [steps], for references of phases, in their order.
            Number and time of the reference are then those of the phase, and are not shown again.
        reset_state: From what the environment reads at its reset to the table that holds it, such as
            ``{"reset_qpos": "qpos", "reset_qvel": "qvel"}``. Around a ParallelEnv, which drops what its workers' specs
            do not name, this does nothing: there the transform belongs within the workers.
        keys: Entries that it writes.
        seed: Of the draws.
        first_row: As of :class:`RandomTransform`.
        reset_key: As of :class:`StatefulTransform`.

    Source:
        Fey et al. 2025, section II-C; Peng et al. 2018 (DeepMimic), section 6.1, for the reset.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> swing = torch.linspace(0.0, 1.0, 11).unsqueeze(-1)
        >>> reference = ReferenceTrajectory({"angle": swing}, table_dt=0.1, dt=0.05, lookahead=(0, 1))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), reference)
        >>> env.rollout(3)["reference"][2].round(decimals=2).tolist()
        [0.10000000149011612, 0.15000000596046448]
    """

    table: Tensor
    lengths: Tensor
    shares: Tensor
    start_steps: Tensor

    def __init__(
        self,
        references: References,
        table_dt: float,
        dt: float,
        *,
        shown: Sequence[str] | None = None,
        lookahead: Sequence[int] = (0,),
        flatten: bool = True,
        at_end: AtEnd = "hold",
        interpolate: bool = True,
        random_start: bool = False,
        probability: Sequence[float] | None = None,
        phase_keys: tuple[NestedKey, NestedKey] | None = None,
        reset_state: Mapping[str, str] | None = None,
        keys: ReferenceKeys = ReferenceKeys(),
        seed: int = 0,
        first_row: int = 0,
        reset_key: NestedKey | None = None,
    ) -> None:
        if not (table_dt > 0 and dt > 0):
            raise ValueError(f"table_dt is {table_dt} s and dt {dt} s, needed is more than 0: time would stand still.")
        resets = dict(reset_state or {})
        names = [name for name in references if name not in resets.values()] if shown is None else list(shown)
        unknown = [name for name in (*names, *resets.values()) if name not in references]
        if unknown or not names or not lookahead:
            raise ValueError(
                f"to show are {names} at {list(lookahead)} steps from now, and to reset from {list(resets.values())}, "
                f"but there are tables of {list(references)}. Name at least one table and one time to show."
            )
        if phase_keys is not None and (random_start or probability is not None or resets):
            raise ValueError(
                "with phase_keys the task's phase chooses the reference and its time, which leaves nothing to say for "
                "random_start, probability and reset_state. Leave them out, or the keys."
            )
        prefix = keys.reference if isinstance(keys.reference, tuple) else (keys.reference,)
        shows: list[NestedKey] = [keys.reference] if flatten else [(*prefix, name) for name in names]
        memory = [keys.id, keys.step] if phase_keys is None else []
        seen = [] if phase_keys is None else list(phase_keys)
        super().__init__(seen, [*shows, *memory], seed=seed, first_row=first_row, reset_key=reset_key)
        self.phase_keys, self.dt = phase_keys, dt
        self.names, self.keys, self.flatten, self.reset_state = names, shows, flatten, resets
        self.samples_per_step, self.lookahead = dt / table_dt, tuple(lookahead)
        self.at_end, self.interpolate, self.random_start = at_end, interpolate, random_start
        self.id_key, self.step_key = keys.id, keys.step
        lengths = self._add_tables(references)
        self._add_shares(probability, len(lengths))
        last = ((lengths.double() - 1) / self.samples_per_step + 1e-6).floor().long()
        steps = last + 1  # that begin within the reference
        self.register_buffer("start_steps", steps, persistent=False)

    def _add_tables(self, references: References) -> Tensor:
        """Keep the tables, those to show side by side: one look-up reads them all."""
        padded = {name: pad_references(table) for name, table in references.items()}
        (first, (_, lengths)), *others = padded.items()
        for name, (_, other) in others:
            if other.tolist() != lengths.tolist():
                raise ValueError(
                    f"table {name!r} holds references of {other.tolist()} samples, {first!r} of {lengths.tolist()}; "
                    "needed are the same, or they would come apart. Resample them to one grid."
                )
        self.widths = [padded[name][0].shape[-1] for name in self.names]
        table = torch.cat([padded[name][0].to(torch.float32) for name in self.names], -1)
        self.register_buffer("table", table, persistent=False)  # given anew, so that no checkpoint has to hold it
        self.register_buffer("lengths", lengths, persistent=False)
        for key, name in self.reset_state.items():
            self.register_buffer(f"_at_{key}", padded[name][0], persistent=False)
        return lengths

    def _add_shares(self, probability: Sequence[float] | None, count: int) -> None:
        given = torch.full((count,), 1 / count) if probability is None else torch.as_tensor(probability)
        if given.shape != (count,) or not (given >= 0).all() or abs(float(given.sum()) - 1) > 1e-5:
            raise ValueError(
                f"probability is {given.tolist()}, needed is one of at least 0 for each of the {count} references, "
                "with a sum of 1."
            )
        self.register_buffer("shares", given.double().cumsum(0).float(), persistent=False)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        tensordict = super()._reset_env_preprocess(tensordict)
        if not self.reset_state:
            return tensordict
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=self.parent.batch_size, device=self.parent.device)
        reference, step = self._choose(self.upcoming(tensordict))
        position = step * self.samples_per_step
        for key in self.reset_state:
            table = getattr(self, f"_at_{key}")
            state = sample_reference(table, self.lengths, reference, position, self.at_end, self.interpolate)
            tensordict.set(key, state.squeeze(-2))
        return tensordict

    def draw(self, key: Tensor, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        if self.phase_keys is not None:
            return self._values(*(tensordict_reset.get(key) for key in self.phase_keys))
        return self._entries(*self._choose(key))

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        if self.phase_keys is None:
            entries = self._entries(tensordict.get(self.id_key), tensordict.get(self.step_key) + 1)
        else:
            entries = self._values(*(next_tensordict.get(key) for key in self.phase_keys))
        for key, value in entries.items():
            next_tensordict.set(key, value)

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        batch, device = observation_spec.shape, observation_spec.device
        times = () if len(self.lookahead) == 1 else (len(self.lookahead),)
        tails = [(len(self.lookahead) * sum(self.widths),)] if self.flatten else [(*times, w) for w in self.widths]
        last = len(self.lengths) - 1
        shown = {key: Unbounded((*batch, *tail), device=device) for key, tail in zip(self.keys, tails, strict=True)}
        if self.phase_keys is not None:
            return shown
        return shown | {
            self.id_key: Bounded(0, last, shape=(*batch, 1), dtype=torch.int64, device=device),
            self.step_key: Unbounded((*batch, 1), dtype=torch.int64, device=device),
        }

    def _choose(self, key: Tensor) -> tuple[Tensor, Tensor]:
        """Which reference, and from which of its steps on. int64, shape (*B, 1) each."""
        if len(self.lengths) == 1 and not self.random_start:
            alone = torch.zeros(*key.shape, 1, dtype=torch.int64, device=key.device)
            return alone, alone.clone()
        unit = streams.uniform(key, 2)
        reference = (unit[..., :1] >= self.shares[:-1]).sum(-1, keepdim=True)
        if not self.random_start:
            return reference, torch.zeros_like(reference)
        count = self.start_steps[reference]
        return reference, torch.minimum((unit[..., 1:] * count).long(), count - 1)

    def _entries(self, reference: Tensor, step: Tensor) -> dict[NestedKey, Tensor]:
        return self._values(reference, step) | {self.id_key: reference, self.step_key: step}

    def _values(self, reference: Tensor, step: Tensor) -> dict[NestedKey, Tensor]:
        times = [step + ahead if ahead else step for ahead in self.lookahead]
        position = (times[0] if len(times) == 1 else torch.cat(times, -1)) * self.samples_per_step
        value = sample_reference(self.table, self.lengths, reference, position, self.at_end, self.interpolate)
        if self.flatten:
            return {self.keys[0]: value.flatten(-2)}
        if len(times) == 1:
            value = value.squeeze(-2)
        return dict(zip(self.keys, value.split(self.widths, -1), strict=True))
