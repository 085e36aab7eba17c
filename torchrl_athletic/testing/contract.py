"""The contract of a transform, one method per clause."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from typing import Any, ClassVar, TypeAlias

import pytest
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    check_env_specs,
)

from torchrl_athletic.testing.no_host_sync import no_host_sync
from torchrl_athletic.testing.rollouts import difference, make_actions, play, rows_together
from torchrl_athletic.testing.toy_env import ToyEnv

Key: TypeAlias = Callable[[str], NestedKey]
"""From an entry's plain name to its key, which is nested for some clauses."""

_COPIERS: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda original: pickle.loads(pickle.dumps(original)),
    "deepcopy": copy.deepcopy,
}


class TransformContract:
    """Tests that a transform has to pass, whatever it does.

    Subclass it, give the subclass a name that pytest collects, and define :meth:`make_transform`. A clause that cannot
    hold is overridden and marked as skipped or expected to fail, with the reason: so the exceptions stay on record.

    The names of the first eleven clauses, and what they check, are those of TorchRL's own tests of its transforms.

    Example:
        >>> from torchrl_athletic.transforms import ObservationHistory
        >>> class TestObservationHistory(TransformContract):
        ...     def make_transform(self, key=str, first_row=0):
        ...         return ObservationHistory([key("joint_position")], length=3)
        >>> TestObservationHistory().test_partial_reset()
    """

    env_settings: ClassVar[Mapping[str, Any]] = {}
    """Arguments of :class:`ToyEnv`, such as the action's name."""

    steps: ClassVar[int] = 12
    """Length of the rollouts: of ToyEnv's episodes at least one ends in each row."""

    tolerance: ClassVar[float] = 0.0
    """How far a batch may differ from rows that are alone, for transforms with sums whose order depends on its size."""

    def make_transform(self, key: Key = str, first_row: int = 0) -> Transform:
        """The transform, or several of them in a Compose.

        Args:
            key: Turns the name of an entry into its key; every key that the transform is given, and every default that
                it has, goes through it.
            first_row: Number of the batch's first row, for transforms that draw random numbers per row.
        """
        raise NotImplementedError

    def make_env(self, num_envs: int | None = 3, **settings: Any) -> EnvBase:
        """What the transform is put on. ``settings`` are those of :class:`ToyEnv`.

        Raises:
            NotImplementedError: In subclasses with an environment of their own that cannot be had with these settings;
                the clause is skipped.
        """
        return ToyEnv(num_envs, **{**self.env_settings, **settings})

    # TorchRL's eleven

    def test_single_trans_env_check(self) -> None:
        """Specs describe the data."""
        check_env_specs(self._transformed(), break_when_any_done="both")

    def test_serial_trans_env_check(self) -> None:
        """It works within the workers of a SerialEnv."""
        check_env_specs(self._serial(inside=True))

    def test_parallel_trans_env_check(self) -> None:
        """It works within the processes of a ParallelEnv, and does there what it does in a SerialEnv."""
        with closing(self._parallel(inside=True)) as env:
            self._same_rollouts(env, self._serial(inside=True), check=True)

    def test_trans_serial_env_check(self) -> None:
        """Around a SerialEnv it does what it does within its workers."""
        check_env_specs(self._serial(inside=False))
        self._same_rollouts(self._serial(inside=False), self._serial(inside=True))

    def test_trans_parallel_env_check(self) -> None:
        """Around a ParallelEnv it does what it does around a SerialEnv."""
        with closing(self._parallel(inside=False)) as env:
            self._same_rollouts(env, self._serial(inside=False), check=True)

    def test_transform_no_env(self) -> None:
        """Without an environment it works, or says that it cannot."""
        self._works_or_refuses(transform := self.make_transform(), transform, self._data())

    def test_transform_compose(self) -> None:
        """Within a Compose it does what it does alone."""
        composed = TransformedEnv(self._env(), Compose(*_parts(self.make_transform())))
        self._same_rollouts(composed, self._transformed())

    def test_transform_env(self) -> None:
        """Every entry is there after a reset and a step, fits its spec and is finite, through ends of episodes."""
        env = self._transformed()
        self._fits_specs(env, env.reset())
        steps, _ = play(env, make_actions(env, self.steps))
        assert steps["next", "done"].any() if "done" in env.done_keys else True
        for step in steps.unbind(0):
            self._fits_specs(env, step)
            self._fits_specs(env, step["next"])

    def test_transform_model(self) -> None:
        """In front of a network it works, or says that it cannot."""
        model = nn.Sequential(transform := self.make_transform(), nn.Identity())
        self._works_or_refuses(transform, model, self._data())

    def test_transform_rb(self) -> None:
        """What it collects can be stored; on a buffer it works, or says that it cannot."""
        env = self._transformed()
        steps, _ = play(env, make_actions(env, self.steps))
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
        buffer.extend(steps.reshape(-1))
        assert set(env.transform.out_keys) <= set(buffer.sample().keys(True, True))
        transform = self.make_transform()

        def through_buffer(data: TensorDictBase) -> TensorDictBase:
            buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4, transform=transform)
            buffer.extend(data.reshape(-1))
            return buffer.sample()

        self._works_or_refuses(transform, through_buffer, self._data())

    def test_transform_inverse(self) -> None:
        """Its way in, without an environment, works or says that it cannot, and leaves its input as it was."""
        transform, data = self.make_transform(), self._data()
        given = data.clone()
        self._works_or_refuses(transform, transform.inv, given, forward=False)
        assert difference(given, data) is None

    # What these do not ask

    def test_no_batch(self) -> None:
        """On an environment without a batch dimension it does what it does on a batch of one."""
        check_env_specs(self._transformed(None), break_when_any_done="both")
        actions = make_actions(env := self._transformed(None), self.steps)
        batched, _ = play(self._transformed(1), actions.unsqueeze(1))
        found = difference(play(env, actions)[0].unsqueeze(1), batched, tolerance=self.tolerance)
        assert found is None, f"without a batch dimension something differs: {found}"

    def test_partial_reset(self) -> None:
        """A row in a batch, whose neighbours start and end at other times, does what it does alone."""
        env = self._transformed(4)
        actions = make_actions(env, self.steps)
        steps, _ = play(env, actions)
        alone = [play(self._transformed(1, first_row=row), actions[:, row : row + 1])[0] for row in range(4)]
        found = difference(steps, rows_together(alone), tolerance=self.tolerance)
        assert found is None, f"a row in a batch is not what it is alone: {found}"

    def test_manual_reset(self) -> None:
        """A reset of some rows leaves the others' memory alone, and they go on as if nothing had happened."""
        mask = torch.tensor([[True], [False], [True]])
        env = self._transformed(3, shortest=4)
        actions = make_actions(env, 8)
        steps = self._with_reset(env, actions, mask)
        alone = [
            self._with_reset(self._transformed(1, first_row=row, shortest=4), actions[:, row : row + 1], start[None])
            for row, start in enumerate(mask)
        ]
        found = difference(steps, rows_together(alone), tolerance=self.tolerance)
        assert found is None, f"after a reset of rows 0 and 2 a row is not what it is alone: {found}"

    def test_same_again(self) -> None:
        """Made anew with the same arguments, it does the same again."""
        self._same_rollouts(self._transformed(), self._transformed())

    @pytest.mark.parametrize("done_in_groups", [False, True], ids=["done at the root", "done beside"])
    def test_nested_keys(self, done_in_groups: bool) -> None:
        """With entries that are nested it does what it does with plain ones."""

        def nested() -> TransformedEnv:
            env = self._env(groups=("robot",), done_in_groups=done_in_groups)
            return TransformedEnv(env, self.make_transform(_nested("robot")))

        check_env_specs(nested())
        actions = make_actions(nested(), self.steps)
        plain, _ = play(self._transformed(), actions["robot"])
        found = difference(_without_groups(play(nested(), actions)[0]), plain)
        assert found is None, f"nested entries are not what plain ones are: {found}"

    def test_two_instances(self) -> None:
        """Two of it, with other keys, do not disturb each other, in whichever order."""

        def env(*groups: str) -> TransformedEnv:
            transforms = [part for group in groups for part in _parts(self.make_transform(_nested(group)))]
            return TransformedEnv(self._env(groups=("left", "right")), Compose(*transforms))

        actions, actions_alone = make_actions(env("left", "right"), self.steps), make_actions(env("left"), self.steps)
        actions.update(actions_alone.select(*actions.keys(True, True), strict=False))
        both, alone = play(env("left", "right"), actions)[0], play(env("left"), actions_alone)[0]
        for at in ("left", ("next", "left")):
            found = difference(both[at], alone[at])
            assert found is None, f"the left one is not what it is alone: {found}"
        found = difference(both, play(env("right", "left"), actions)[0])
        assert found is None, f"the order of the two makes a difference: {found}"

    def test_order_in_compose(self) -> None:
        """First, last or between others, it does the same."""
        actions = make_actions(env := self._transformed(), self.steps)
        steps, _ = play(env, actions)
        orders: dict[str, Callable[[list[Transform]], list[Transform]]] = {
            "last": lambda parts: [StepCounter(), RewardSum(), *parts],
            "first": lambda parts: [*parts, StepCounter(), RewardSum()],
            "between": lambda parts: [StepCounter(), *parts, RewardSum()],
        }
        for place, order in orders.items():
            among, _ = play(TransformedEnv(self._env(), Compose(*order(_parts(self.make_transform())))), actions)
            found = difference(among.select(*steps.keys(True, True)), steps)
            assert found is None, f"{place} in Compose it is not what it is alone: {found}"

    def test_native_autoreset(self) -> None:
        """On an environment that resets itself in the step it does what it does on one that TorchRL resets.

        TorchRL overwrites the last observations of an episode there, so these are not compared.
        """
        actions = make_actions(env := self._transformed(), self.steps)
        steps, native = play(env, actions)[0], play(self._transformed(native_autoreset=True), actions)[0]
        found = difference(native.exclude("next"), steps.exclude("next"))
        assert found is None, f"where the environment resets itself something differs: {found}"
        goes_on = ~steps["next", "done"].squeeze(-1)
        found = difference(native["next"][goes_on], steps["next"][goes_on])
        assert found is None, f"within an episode of an environment that resets itself something differs: {found}"
        flags = [*env.reward_keys, *env.done_keys]
        found = difference(native["next"].select(*flags), steps["next"].select(*flags))
        assert found is None, f"at the end of an episode, where the environment resets itself: {found}"

    def test_copies(self) -> None:
        """A copy of it, by pickle, deepcopy or ``clone``, does what it does."""
        copiers: dict[str, Callable[[Transform], Transform]] = {**_COPIERS, "clone": lambda original: original.clone()}
        actions = make_actions(env := self._transformed(), self.steps)
        steps, _ = play(env, actions)
        for name, copier in copiers.items():
            found = difference(play(TransformedEnv(self._env(), copier(self.make_transform())), actions)[0], steps)
            assert found is None, f"a copy by {name} is not the original: {found}"

    def test_copies_in_use(self) -> None:
        """A copy of the environment, in the midst of its episodes, goes on as the original does."""
        actions = make_actions(env := self._transformed(), self.steps)
        _, reached = play(env, actions)
        copies = {name: copier(env) for name, copier in _COPIERS.items()}
        steps, _ = play(env, actions, reached)
        for name, env in copies.items():
            found = difference(play(env, actions, reached)[0], steps)
            assert found is None, f"a copy of one in use, by {name}, is not the original: {found}"

    def test_state_dict(self) -> None:
        """A checkpoint loads into any number of environments, before and after use."""
        for trained, used in ((4, False), (4, True), (1, True)):
            source, target = self._transformed(trained), self._transformed(2)
            play(source, make_actions(source, self.steps))
            if used:
                play(target, make_actions(target, self.steps))
            target.load_state_dict(source.state_dict())
            steps, _ = play(target, make_actions(target, self.steps))
            assert steps.batch_size == (self.steps, 2)

    def test_dtype(self) -> None:
        """On an environment of double precision, specs describe the data."""
        env = self._transformed(dtype=torch.float64)
        check_env_specs(env)
        steps, _ = play(env, make_actions(env, self.steps))
        for step in steps.unbind(0):
            self._fits_specs(env, step["next"])

    def test_device(self) -> None:
        """It moves to another device with all that it holds; where there is a GPU, it runs on it."""
        transform = self.make_transform().to("meta")
        for name, tensor in _tensors_of(transform):
            assert tensor.device.type == "meta", (
                f"{name} stayed on {tensor.device} when the transform moved: make it a buffer"
            )
        if torch.cuda.is_available():
            env = self._transformed(device="cuda")
            check_env_specs(env)
            steps, _ = play(env, make_actions(env, self.steps))
            assert all(tensor.device.type == "cuda" for tensor in steps.values(True, True))

    def test_no_graph_breaks(self) -> None:
        """A step and the resets that follow it compile into one graph, which does what the step does uncompiled."""
        actions = make_actions(env := self._transformed(native_autoreset=True), 4)
        steps, _ = play(env, actions)
        torch.compiler.reset()
        compiled = self._transformed(native_autoreset=True)
        _, reached = play(compiled, actions[:2])
        compiled.compile(fullgraph=True, backend="eager")
        found = difference(play(compiled, actions[2:], reached)[0], steps[2:])
        assert found is None, f"compiled it is not what it is eagerly: {found}"

    def test_no_host_sync(self) -> None:
        """Neither a step nor a reset makes a GPU wait for the host (:func:`no_host_sync`)."""
        device = "cuda" if torch.cuda.is_available() else "cpu"
        native = self._transformed(native_autoreset=True, device=device)
        env = self._transformed(device=device)
        actions = make_actions(env, 4)
        _, tensordict = play(native, actions)  # caches of specs are filled in the first steps
        first, _ = play(env, actions)
        some = torch.tensor([[True], [False], [True]], device=device)
        tensordict = tensordict.update(actions[0])
        reset = first[-1].exclude("next").set("_reset", some)
        with no_host_sync():
            native.step_and_maybe_reset(tensordict)
            env._reset(reset)

    # What the clauses share

    def _env(self, num_envs: int | None = 3, **settings: Any) -> EnvBase:
        try:
            return self.make_env(num_envs, **settings)
        except NotImplementedError as reason:
            pytest.skip(f"no environment with {settings}: {reason}")

    def _transformed(self, num_envs: int | None = 3, first_row: int = 0, **settings: Any) -> TransformedEnv:
        env = self._env(num_envs, first_row=first_row, **settings)
        return TransformedEnv(env, self.make_transform(first_row=first_row))

    def _serial(self, *, inside: bool) -> EnvBase:
        return self._in_workers(SerialEnv, inside)

    def _parallel(self, *, inside: bool) -> EnvBase:
        forks = "fork" in multiprocessing.get_all_start_methods() and not torch.cuda.is_initialized()
        return self._in_workers(partial(ParallelEnv, mp_start_method="fork" if forks else "spawn"), inside)

    def _in_workers(self, make: Callable[..., EnvBase], inside: bool) -> EnvBase:
        """Rows 0 and 1 in one worker, rows 2 and 3 in another."""
        one = self._transformed if inside else self._env
        env = make(2, [partial(one, 2, first_row=row) for row in (0, 2)])
        return env if inside else TransformedEnv(env, self.make_transform())

    def _data(self) -> TensorDictBase:
        """What an environment without the transform collects. Batch size (N, T), time being named."""
        return self._env().rollout(self.steps, break_when_any_done=False)

    def _same_rollouts(self, first: EnvBase, second: EnvBase, *, check: bool = False) -> None:
        if check:  # of both, so that both are at the same episode afterwards
            check_env_specs(first)
            check_env_specs(second)
        actions = make_actions(first, self.steps)
        found = difference(play(first, actions)[0], play(second, actions)[0], tolerance=self.tolerance)
        assert found is None, f"the two do not do the same: {found}"

    def _with_reset(self, env: EnvBase, actions: TensorDictBase, mask: Tensor) -> TensorDictBase:
        """A rollout in the middle of which the rows of the mask are reset by hand."""
        before, reached = play(env, actions[:3])
        if mask.any():
            reached = env.reset(reached.set("_reset", mask))
        after, _ = play(env, actions[3:], reached.exclude("_reset"))
        return torch.cat((before, after), 0)

    def _works_or_refuses(
        self,
        transform: Transform,
        call: Callable[[TensorDictBase], TensorDictBase],
        data: TensorDictBase,
        *,
        forward: bool = True,
    ) -> None:
        names = {type(module).__name__ for module in transform.modules() if isinstance(module, Transform)} - {"Compose"}
        refusal = None
        try:
            out = call(data)
        except (RuntimeError, KeyError, ValueError, NotImplementedError) as error:
            refusal = f"{type(error).__name__}: {error}"
        if refusal is not None:
            named = any(name in refusal for name in names)
            assert named, f"{refusal} - a refusal has to name one of {sorted(names)}, for the user to find it"
            return
        written = transform.out_keys if forward else transform.in_keys_inv
        missing = set(written) - set(out.keys(True, True))
        assert not missing, f"it neither refused the data nor wrote {sorted(map(str, missing))}"

    @staticmethod
    def _fits_specs(env: EnvBase, tensordict: TensorDictBase) -> None:
        for key, spec in env.full_observation_spec.items(True, True):
            value = tensordict.get(key, None)
            assert value is not None, f"{key!r} stands in the specs but not in the data"
            assert spec.is_in(value), (
                f"{key!r}, {tuple(value.shape)} {value.dtype} in the data, does not fit its spec {spec}"
            )
            assert not value.is_floating_point() or value.isfinite().all(), f"{key!r} is not finite: {value}"


def _parts(transform: Transform) -> list[Transform]:
    """What a Compose holds: TorchRL does not find the parent of the first transform of a Compose within a Compose."""
    return [part.clone() for part in transform.transforms] if isinstance(transform, Compose) else [transform]


def _nested(group: str) -> Key:
    return partial(_under, group)


def _under(group: str, name: str) -> NestedKey:
    return (group, name)


def _without_groups(steps: TensorDictBase) -> TensorDictBase:
    """Entries under the last part of their key, those of the next step apart."""
    flat = steps.empty()
    for key, value in steps.items(True, True):
        parts = (key,) if isinstance(key, str) else key
        flat.set(("next", parts[-1]) if parts[0] == "next" else parts[-1], value)
    return flat


def _tensors_of(transform: Transform) -> list[tuple[str, Tensor]]:
    """All tensors that a module and its children hold, whether or not they are registered."""
    found = []
    for path, module in transform.named_modules():
        held = {**vars(module), **module._buffers, **module._parameters}
        found += [
            (f"{type(module).__name__}.{name}" if not path else f"{path}.{name}", value)
            for name, value in held.items()
            if isinstance(value, Tensor)
        ]
    return found
