"""Checkpoints from which a killed run goes on as if it had not been killed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState, StateDictCheckpointAdapter
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_athletic.training.distributed import ALONE, Processes
from torchrl_athletic.training.logging import CSVTable
from torchrl_athletic.transforms.stateful import base_env_of

FORMAT = StateDictCheckpointAdapter(payload_format="torch")
"""One file a component, read with ``weights_only``: no code of a checkpoint is run."""


class HasState(Protocol):
    """What can be put into a checkpoint."""

    def state_dict(self) -> dict[str, Any]:
        """All that changes."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Take it over."""


class Checkpoints:
    """A folder with the newest few states of a run.

    Each is written beside its place and moved there when complete, so that a kill at any moment leaves the one before.
    With the learner go the states of Python's, NumPy's and PyTorch's generators and where the log ends.

    Of processes that train together (``learner.processes``) each writes its own, those after the first one into folders
    ``rank1``, ``rank2``... The first one writes when the others have, and all go on from its newest state: what a kill
    left incomplete is passed over.

    Args:
        folder: Is made. Processes on several hosts need not see each other's.
        keep: How many stay.
        made_of: What the run is of, by name: method, seed, a digest of the data. A run of something else is not gone on
            with.
        beside: What else shall be as it was, by name.

    Example:
        >>> import tempfile, torch
        >>> checkpoints, net = Checkpoints(tempfile.mkdtemp()), torch.nn.Linear(2, 1)
        >>> checkpoints.resume(net)
        False
        >>> net.iteration = 7
        >>> checkpoints.save(net).name
        'checkpoint-...7'
        >>> checkpoints.resume(torch.nn.Linear(2, 1))
        True
    """

    def __init__(
        self,
        folder: str | Path,
        keep: int = 3,
        *,
        made_of: Mapping[str, str | int] | None = None,
        beside: Mapping[str, HasState] | None = None,
    ) -> None:
        self.folder, self.keep = Path(folder), keep
        self.made_of, self.beside = dict(made_of or {}), dict(beside or {})

    def save(self, learner: Any, logger: Any = None) -> Path:
        """Write a new one and remove the oldest.

        Args:
            learner: With ``state_dict`` and ``iteration``, which names the checkpoint.
            logger: Whose position is kept if it is a :class:`~.CSVTable`; others start a new run when training goes on.
        """
        processes: Processes = getattr(learner, "processes", ALONE)
        rotation, checkpoint = self._rotation(processes), self._checkpoint(learner, logger, processes)
        if processes.rank:
            path = rotation.save(checkpoint, step=learner.iteration)
        processes.gather(None)  # waits for the others
        if not processes.rank:
            path = rotation.save(checkpoint, step=learner.iteration)
        return path

    def resume(self, learner: HasState, logger: Any = None) -> bool:
        """Take over the newest state; tells whether there was one.

        Without one, rows of a table are dropped: they are of a run that was killed before its first state.

        Raises:
            RuntimeError: If the networks or the optimisers are of other sizes.
            ValueError: If the run was of something else, or of another number of processes.
        """
        processes: Processes = getattr(learner, "processes", ALONE)
        rotation = self._rotation(processes)
        newest = processes.of_first(lambda: max(_steps(rotation), default=-1))
        for step, path in _steps(rotation).items():
            if step > newest:  # the first process was killed before it wrote that one
                shutil.rmtree(path)
        there = processes.gather(newest in _steps(rotation))
        if newest < 0:
            if isinstance(logger, CSVTable) and logger.rows:
                logger.load_state_dict({"rows": 0})
            return False
        if not all(there):
            raise ValueError(
                f"the run in {self.folder} stood at iteration {newest}, of which process {there.index(False)} of "
                f"{processes.count} finds no state. Go on with as many processes as then, on the same hosts, or give "
                "this run a folder of its own (--output)."
            )
        self._check_what_it_is_of(rotation, processes)
        rotation.load_latest(self._checkpoint(learner, logger, processes))
        return True

    def _rotation(self, processes: Processes) -> CheckpointRotation:
        """The others keep one more, since they write before the first one does."""
        if processes.rank == 0:
            return CheckpointRotation(self.folder, keep_last=self.keep)
        return CheckpointRotation(self.folder / f"rank{processes.rank}", keep_last=self.keep + 1)

    def _check_what_it_is_of(self, rotation: CheckpointRotation, processes: Processes) -> None:
        """Before anything is taken over."""
        found = _Facts({})
        rotation.load_latest(_of_parts({"made_of": found}), strict="ignore")
        then, now = found.facts, self._facts(processes)
        for name in sorted(then.keys() | now.keys()):
            if then.get(name) != now.get(name):
                raise ValueError(
                    f"{self.folder} holds a run whose {name} is {then.get(name)!r}; here it is "
                    f"{now.get(name)!r}. Going on would mix two trainings in one net. Give this one a folder of its "
                    f"own (--output), or the {name} of then."
                )

    def _facts(self, processes: Processes) -> dict[str, str | int]:
        return self.made_of | ({"number of processes": processes.count} if processes.count > 1 else {})

    def _checkpoint(self, learner: HasState, logger: Any, processes: Processes) -> Checkpoint:
        facts = _Facts(self._facts(processes))
        parts: dict[str, Any] = {"learner": learner, "generators": GlobalRNGState(), "made_of": facts}
        if isinstance(logger, CSVTable):  # other loggers start a new run, which refuses the state of an old one
            parts["logger"] = logger
        return _of_parts(parts | self.beside)


class _Facts:
    """What does not change, kept as a state is."""

    def __init__(self, facts: Mapping[str, str | int]) -> None:
        self.facts = dict(facts)

    def state_dict(self) -> dict[str, Any]:
        return dict(self.facts)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.facts = dict(state_dict)


def _steps(rotation: CheckpointRotation) -> dict[int, Path]:
    """Whole checkpoints by the iteration that they were written after."""
    return {int(path.name.rpartition("-")[2]): path for path in rotation.checkpoints()}


def _of_parts(parts: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, part in parts.items():
        checkpoint.register(name, part, adapter=FORMAT)
    return checkpoint


_PHYSICS = ("qpos", "qvel", "time", "qacc_warmstart", "xfrc_applied")


def env_state(env: EnvBase) -> dict[str, Any]:
    """What an environment holds beside its tensordict: the physics, and transforms' counts of episodes.

    Returns:
        Tensors by name; without ``physics`` if the environment has none of this library's.
    """
    state: dict[str, Any] = {"buffers": {name: buffer.clone() for name, buffer in _unsaved_buffers(env).items()}}
    physics = getattr(base_env_of(env), "physics", None)
    if physics is not None:
        state["physics"] = {name: physics.data(name).clone() for name in _PHYSICS}
        state["fields"] = {name: physics.field(name).clone() for name in physics.fields}
        wrenches = getattr(base_env_of(env), "wrenches", {})
        state["wrenches"] = {name: wrench.clone() for name, wrench in wrenches.items()}
    return state


def restore_env(env: EnvBase, current: TensorDict, state: dict[str, Any]) -> TensorDict:
    """Put an environment back to where :func:`env_state` was taken.

    Args:
        env: Of the same make.
        current: What the policy was to see next.
        state: Of :func:`env_state`.

    Returns:
        What the policy sees next: ``current``; or the start of new episodes, if the number of environments is another
        or the environment is not one of this library's, whose inner state nobody can set.
    """
    physics = getattr(base_env_of(env), "physics", None)
    if physics is None or "physics" not in state or current.batch_size != env.batch_size:
        return env.reset()
    physics.reset(qpos=state["physics"]["qpos"], qvel=state["physics"]["qvel"])
    if state["fields"]:
        physics.set_fields(state["fields"])
    for name in state["physics"].keys() - {"qpos", "qvel"}:
        physics.data(name).copy_(state["physics"][name])
    wrenches = getattr(base_env_of(env), "wrenches", {})
    for wrench in wrenches.values():
        wrench.zero_()
    for name, value in state.get("wrenches", {}).items():
        wrenches.setdefault(name, torch.zeros_like(value, device=env.device)).copy_(value)
    modules = dict(env.transform.named_modules()) if isinstance(env, TransformedEnv) else {}
    for name, value in state["buffers"].items():
        owner, _, leaf = name.rpartition(".")
        buffer = getattr(modules[owner], leaf)
        if buffer.shape == value.shape:
            buffer.copy_(value)  # in place: a captured step goes on with the same memory
        else:
            setattr(modules[owner], leaf, value.to(env.device))
    return current


def _unsaved_buffers(env: EnvBase) -> dict[str, Tensor]:
    """Buffers that no ``state_dict`` holds: how many episodes each row has had, which names its random numbers."""
    if not isinstance(env, TransformedEnv):
        return {}
    saved = env.transform.state_dict()
    return {name: buffer for name, buffer in env.transform.named_buffers() if name not in saved}
