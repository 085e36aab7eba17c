"""A reward as a sum of named terms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from torchrl_athletic.transforms.stateful import StatefulTransform, full_reward_spec, unbounded_like

RewardTerm: TypeAlias = Callable[[TensorDictBase, TensorDictBase], Tensor]
"""A function of what a step started from and what it led to, one value per row: shape (*B, 1) or (*B,)."""


class Term(nn.Module):
    """A function of tensors, such as those of :mod:`torchrl_athletic.functional.rewards`, given entries of a step.

    Args:
        function: Takes the entries in order, then the constants by name.
        keys: Entries of what the step led to.
        constants: Tensors among them move with the environment to its device.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_athletic.functional import rewards
        >>> term = Term(rewards.absolute_error, "joint_position", target=torch.tensor([1.0, 0.0]))
        >>> step = TensorDict(joint_position=[[0.5, 0.0]], batch_size=[1])
        >>> term(step, step)
        tensor([[0.5000]])
    """

    def __init__(self, function: Callable[..., Tensor], *keys: NestedKey, **constants: Any) -> None:
        super().__init__()
        self.function, self.keys = function, keys
        self.constants = {name: value for name, value in constants.items() if not isinstance(value, Tensor)}
        self.tensors = tuple(name for name, value in constants.items() if isinstance(value, Tensor))
        for name in self.tensors:
            self.register_buffer(f"constant_{name}", constants[name].clone())

    def forward(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        held = {name: getattr(self, f"constant_{name}") for name in self.tensors}
        return self.function(*(next_tensordict[key] for key in self.keys), **self.constants, **held)


class InPhase(nn.Module):
    """A term that counts only for actions taken in some phases of a task, and is 0 in the others.

    Args:
        phases: Their numbers.
        term: As of :class:`RewardTerms`.
        phase_key: Of the number of the phase, as :class:`~.TaskPhase` shows it.

    Source:
        Fey et al. 2025, appendix B: the indicators of its task rewards.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(task_phase_index=[[0], [1]], batch_size=[2])
        >>> InPhase([1], lambda before, after: torch.full((2, 1), 7.0))(step, step).flatten()
        tensor([0., 7.])
    """

    def __init__(self, phases: Iterable[int], term: RewardTerm, phase_key: NestedKey = "task_phase_index") -> None:
        super().__init__()
        self.phases, self.term, self.phase_key = tuple(phases), term, phase_key

    def forward(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        index = tensordict.get(self.phase_key)
        counts = torch.zeros_like(index, dtype=torch.bool)
        for phase in self.phases:
            counts = counts | (index == phase)
        value = self.term(tensordict, next_tensordict)
        return torch.where(counts, value.reshape(counts.shape), 0.0)


class RewardTerms(StatefulTransform):
    """Add a sum of scaled, named terms to the reward, and show each of them.

    Outside :class:`~.Decimation` (after it in Compose) a term is taken once for each action, inside it at each physics
    step: the reward is then their sum, while what is shown is the last step's, and terms can see only what the
    environment shows at every physics step, joints say. Terms see what transforms before this one wrote, such as
    :class:`~.ActionHistory`.

    Args:
        terms: By name; see :data:`RewardTerm` and :class:`Term`.
        scales: By name, one for each term.
        dt: Time that a step takes [s], to multiply all scales with; None takes the scales as they are.
        show: Whether to show the scaled terms, shape (*B, 1) each, under ``terms_key``.
        sums_key: Where to show their sums since the episode's start; None does not.
        terms_key: Each term stands under ``(terms_key, name)``.
        reward_key: What is added to. Shape (*B, 1).
        reset_key: As of :class:`StatefulTransform`.

    Raises:
        ValueError: If terms and scales have different names, since a term without a scale would be lost in silence.

    Source:
        Fey et al. 2025, appendix A, tables of WBC and of UAN rewards; :mod:`torchrl_athletic.functional.rewards`.

    Example:
        >>> from torchrl_athletic.envs import TorqueEnv
        >>> from torchrl_athletic.functional import rewards
        >>> from torchrl_athletic.robots import z1
        >>> from torchrl.envs import TransformedEnv
        >>> terms = RewardTerms(
        ...     {"power": Term(rewards.mechanical_power, "applied_torque", "joint_velocity"),
        ...      "alive": lambda before, after: (~after["terminated"]).float()},
        ...     {"power": -1e-4, "alive": 1.0})
        >>> step = TransformedEnv(TorqueEnv(z1(), num_envs=2), terms).rollout(3)
        >>> step["next", "reward_terms", "alive"].squeeze(-1)
        tensor([[1., 1., 1.],
                [1., 1., 1.]])
    """

    def __init__(
        self,
        terms: Mapping[str, RewardTerm],
        scales: Mapping[str, float],
        *,
        dt: float | None = None,
        show: bool = True,
        sums_key: NestedKey | None = None,
        terms_key: NestedKey = "reward_terms",
        reward_key: NestedKey = "reward",
        reset_key: NestedKey | None = None,
    ) -> None:
        if not terms or set(terms) != set(scales):
            raise ValueError(
                f"terms are {sorted(terms)}, scales are of {sorted(scales)}: a term without a scale, or a scale "
                "without a term, would be left out of the reward. Give both the same names, and at least one."
            )
        self.shown = _under(terms_key, terms) if show else []
        self.sums = [] if sums_key is None else _under(sums_key, terms)
        super().__init__([], [*self.shown, *self.sums], reset_key=reset_key)
        self.terms, self.reward_key = dict(terms), reward_key
        self.scales = {name: scales[name] * (1.0 if dt is None else dt) for name in terms}
        self.modules_of_terms = nn.ModuleList(term for term in terms.values() if isinstance(term, nn.Module))

    def advance(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
        reward = next_tensordict.get(self.reward_key)
        values = []
        for name, term in self.terms.items():
            values.append(self.scales[name] * self._value(name, term, tensordict, next_tensordict, reward.shape))
            reward = reward + values[-1]  # one after the other: in one sum the order would depend on the batch
        next_tensordict.set(self.reward_key, reward)
        _set_group(next_tensordict, self.shown, values)
        if self.sums:
            sums = [tensordict.get(key) + value for key, value in zip(self.sums, values, strict=True)]
            _set_group(next_tensordict, self.sums, sums)

    def _value(
        self,
        name: str,
        term: RewardTerm,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
        shape: torch.Size,
    ) -> Tensor:
        """Unscaled, in the shape of the reward."""
        try:
            value = term(tensordict, next_tensordict)
        except KeyError as error:
            raise KeyError(
                f"reward term {name!r} asks for an entry that the step does not have: {error}. Put the transform that "
                "writes it before RewardTerms in Compose."
            ) from error
        if value.shape == shape:
            return value
        if value.shape == shape[:-1]:
            return value.unsqueeze(-1)
        raise ValueError(
            f"reward term {name!r} has shape {tuple(value.shape)}, needed is one value per row, {tuple(shape)}: "
            "broadcasting would mix rows. Reduce it over its last dims."
        )

    def initial(self, tensordict_reset: TensorDictBase) -> Mapping[NestedKey, Tensor]:
        return {key: self._reward_spec().zero() for key in (*self.shown, *self.sums)}

    def state_spec(self, observation_spec: Composite) -> Mapping[NestedKey, TensorSpec]:
        reward = self._reward_spec()
        return {key: unbounded_like(reward, reward.shape) for key in (*self.shown, *self.sums)}

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """What is added leaves the environment's bounds."""
        reward = reward_spec[self.reward_key]
        reward_spec[self.reward_key] = unbounded_like(reward, reward.shape)
        return reward_spec

    def _reward_spec(self) -> TensorSpec:
        return full_reward_spec(self)[self.reward_key]


def _under(key: NestedKey, names: Iterable[str]) -> list[tuple[str, ...]]:
    return [unravel_key((key, name)) for name in names]


def _set_group(tensordict: TensorDictBase, keys: list[tuple[str, ...]], values: list[Tensor]) -> None:
    """Write values under the keys, all of which are entries of one group."""
    if keys:
        group = tensordict.get(keys[0][:-1], tensordict.empty())  # of another RewardTerms, maybe
        for key, value in zip(keys, values, strict=True):
            group.set(key[-1], value)
        tensordict.set(keys[0][:-1], group)
