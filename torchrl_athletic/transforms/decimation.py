"""One action of the policy, several steps of the physics."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_athletic.transforms.stateful import spread, unbounded_like

_HELD = "_held_action"


class Decimation(Transform):
    """Hold the policy's action for several steps of the environment, and run what lies further in at each of them.

    The transforms before this one in :class:`~torchrl.envs.Compose` form a chain from the action to the motor. It is
    applied anew at every step, to the action as the policy gave it and to what the environment shows at that step.
    Rewards are summed. A row that is done stops there: its last observation, its flags and its reward are those of the
    step that ended it. (:class:`~torchrl.envs.FrameSkipTransform` applies the chain to its own output from the second
    step on, and steps past the end.)

    An environment may help, by three conventions. It may leave out of a step whose tensordict holds ``_substep`` what
    only the policy looks at: what it left out is shown at the last step. And one whose ``supports_partial_step`` is
    true is told by the mask ``_step`` which rows go on; the state behind the others stays as it was. One that resets
    itself in the step needs the second: otherwise its next episode would begin within the action that ended the last.
    Of the entries that it names in ``averaged_keys``, forces and powers say, the mean over the steps of an action is
    shown, of a row that is done over those before its end.

    Args:
        steps: Of the environment per action.

    Source:
        Fey et al. 2025, section II-A: the actuator net runs every 5 ms, the controller every 20 ms.

    Example:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Decimation(4))
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([3, 1])
    """

    def __init__(self, steps: int) -> None:
        if steps < 1:
            raise ValueError(f"steps is {steps}, needed is at least 1: without a step nothing would follow an action.")
        super().__init__(in_keys=[], out_keys=[])
        self.steps = steps
        self.merge = merge

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # in a buffer: nothing to hold
            return tensordict
        held = {key: tensordict.get(key) for key in self.parent.action_keys}
        tensordict.set(_HELD, tensordict.empty().update(held))
        if self.steps > 1:
            tensordict.set("_substep", _done(self.parent, tensordict))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent = self.parent
        chain, base_env = parent.transform, parent.base_env
        held = tensordict.get(_HELD)
        averaged = () if isinstance(base_env, BatchedEnvBase) else getattr(base_env, "averaged_keys", ())
        summed = [*parent.reward_keys, *averaged]
        count = torch.ones(*next_tensordict.batch_size, 1, device=next_tensordict.device)
        for remaining in range(self.steps - 2, -1, -1):
            done = _done(parent, next_tensordict)
            current = tensordict.copy().update(next_tensordict).update(held)
            if remaining == 0:
                del current["_substep"]
            anyone_stops = _may_stop(done)
            if anyone_stops and _all_stop(done) and not _supports_partial_step(base_env):
                break  # an environment need not know how to be stepped past its end
            if anyone_stops and (goes := _rows_to_step(base_env, done)) is not None:
                current.set("_step", goes)
            following = _step_once(base_env, chain, current)
            next_tensordict = self.merge(done if anyone_stops else None, next_tensordict, following, summed)
            count = count + (~done if anyone_stops else 1)
        for key in averaged:
            total = next_tensordict.get(key)
            next_tensordict.set(key, total / spread(count, total))
        return next_tensordict

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Rewards are sums over the steps, beyond the bounds of one."""
        for key in reward_spec.keys(True, True):
            reward_spec[key] = unbounded_like(reward_spec[key], reward_spec[key].shape)
        return reward_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves data as it is: collected data are at the policy's rate already."""
        return tensordict


def _step_once(base_env: EnvBase, chain: Transform, tensordict: TensorDictBase) -> TensorDictBase:
    """A step without the checks and copies of ``env.step``: they were made for the first one."""
    tensordict = chain._inv_call(tensordict)
    next_tensordict = base_env._step(tensordict)
    base_env._complete_done(base_env.full_done_spec, next_tensordict)
    return chain._step(tensordict, next_tensordict)


def _done(env: TransformedEnv, tensordict: TensorDictBase) -> torch.Tensor:
    """Rows at their end, by any of their flags; one that is not there counts as down. Shape (*B, 1)."""
    found = [tensordict.get(key, None) for key in env.done_keys]
    flags = [flag for flag in found if flag is not None]  # no walrus: torch.compile cannot trace it here
    if not flags:
        return torch.zeros(*tensordict.batch_size, 1, dtype=torch.bool, device=tensordict.device)
    done, *others = flags
    for flag in others:
        done = done | flag
    return done


def _traced(tensor: torch.Tensor) -> bool:
    """Whether values must not be looked at: while compiling, and on a device, where a look would wait for it."""
    return torch.compiler.is_compiling() or tensor.device.type != "cpu"


def _may_stop(done: torch.Tensor) -> bool:
    return _traced(done) or bool(done.any())


def _all_stop(done: torch.Tensor) -> bool:
    return not _traced(done) and bool(done.all())


def _supports_partial_step(env: EnvBase) -> bool:
    """Whether this environment itself supports it: those that hold others pass the question on to them."""
    return getattr(env, "supports_partial_step", False) is True


def _rows_to_step(env: EnvBase, done: torch.Tensor) -> torch.Tensor | None:
    """The mask ``_step``, or None for an environment that has no use for it."""
    goes = ~done.reshape(*env.batch_size, -1).any(-1)
    if _supports_partial_step(env):
        return goes
    if isinstance(env, SerialEnv | ParallelEnv):  # they can leave out whole workers
        works = goes.reshape(env.num_workers, -1).any(-1)
        return works.reshape(-1, *(1,) * (goes.ndim - 1)).expand(goes.shape)
    return None


def merge(
    done: torch.Tensor | None, last: TensorDictBase, following: TensorDictBase, summed: Sequence[NestedKey]
) -> TensorDictBase:
    """Two steps as one: some entries are summed, and rows that were done keep what they showed then.

    Args:
        done: Rows that were done after the first step, shape (*B, 1); None if none was.
        last: What the first step showed.
        following: What the second one showed; is changed.
        summed: Entries to sum, rewards say.
    """
    gained = {key: following.get(key) for key in summed}
    if done is not None:
        for key in following.keys(True, True):
            old = last.get(key, None)
            if old is not None:
                new = following.get(key)
                following.set(key, torch.where(spread(done, new), old, new))
    for key, reward in gained.items():
        gain = reward if done is None else torch.where(spread(done, reward), 0, reward)
        following.set(key, last.get(key) + gain)
    return following
