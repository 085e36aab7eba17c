"""The tasks as Gymnasium knows environments: ``gymnasium.make_vec("torchrl_athletic/SledPull-v0", num_envs=8)``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from torchrl_athletic.envs.ball_throw import ball_throw_env
from torchrl_athletic.envs.dumbbell_snatch import dumbbell_snatch_env
from torchrl_athletic.envs.sled_pull import sled_pull_env
from torchrl_athletic.envs.whole_body import whole_body_env
from torchrl_athletic.transforms import RandomTransform

TASKS: Mapping[str, Callable[..., TransformedEnv]] = {
    "WholeBody": whole_body_env,
    "BallThrow": ball_throw_env,
    "DumbbellSnatch": dumbbell_snatch_env,
    "SledPull": sled_pull_env,
}
"""Makers of the tasks, by the names of :data:`~.registration.TASKS`."""

Array = NDArray[np.float32]


class GymnasiumVectorEnv(VectorEnv[Array, Array, Any]):
    """Many robots in one process, as a Gymnasium vector environment.

    The observation is the policy's, ``observation``; the action is unbounded, 0 is the default pose. A row that is done
    starts anew in the same step: its last observation is under ``final_obs`` of the infos.

    Args:
        task: Name of one of :data:`TASKS`.
        num_envs: N.
        autoreset: Whether rows that are done start anew.
        render_mode: None alone.
        told: To the task.

    Raises:
        ValueError: If there is no such task, or pictures are asked for.

    Example:
        >>> import gymnasium
        >>> import torchrl_athletic.envs
        >>> envs = gymnasium.make_vec("torchrl_athletic/SledPull-v0", num_envs=2)
        >>> envs.reset(seed=0)[0].shape
        (2, 770)
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        autoreset: bool = True,
        render_mode: None = None,
        max_episode_steps: int | None = None,
        **told: Any,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"no task is called {task!r}; there are {sorted(TASKS)}.")
        if render_mode is not None:
            raise ValueError(f"render_mode is {render_mode!r}, but only None is known: training.record_video draws.")
        told |= {} if max_episode_steps is None else {"max_steps": max_episode_steps}  # gymnasium's name for it
        self.env = TASKS[task](num_envs=num_envs, **told)
        self.num_envs, self.autoreset = num_envs, autoreset
        self.single_observation_space = _box(self.env.full_observation_spec["observation"].shape[-1])
        self.single_action_space = _box(self.env.action_spec.shape[-1])
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._seeded = "seed" in told
        self._shown: TensorDictBase | None = None

    @torch.no_grad()
    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all rows anew. A seed opens the streams of all draws again; of a list, the first one counts.

        Without a seed they go on, and where the task was told none either, the first reset takes one by chance.

        Raises:
            ValueError: If options are told: there are none.
        """
        if options:
            raise ValueError(f"reset takes no options, but was told {sorted(options)}: all rows start anew.")
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first, options=options)
        if first is None and not self._seeded:
            first = int(self.np_random.integers(2**31))
        if first is not None:
            reseed(self.env, first)
            self._seeded = True
        self._shown = self.env.reset()
        return _array(self._shown["observation"]), {}

    @torch.no_grad()
    def step(self, actions: Array) -> tuple[Array, Any, Any, Any, dict[str, Any]]:
        """Act once in every row, and start those anew that are done."""
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("step was called before reset: no episode has begun. Call reset first.")
        action = torch.as_tensor(np.asarray(actions, np.float32), device=self.env.device)
        if action.shape != (wanted := self.env.action_spec.shape):
            raise ValueError(f"actions have the shape {tuple(action.shape)}, needed is {tuple(wanted)}: a row each.")
        step = self._shown.set("action", action)
        shown = self.env._step(step)
        step.set("next", shown)
        following = step_mdp(step, exclude_action=True)
        done = (shown["terminated"] | shown["truncated"]).reshape(self.num_envs, 1)
        infos: dict[str, Any] = {}
        if done.any() and self.autoreset:
            infos = {"final_obs": _array(shown["observation"]), "_final_obs": done.flatten().cpu().numpy()}
            fresh = self.env.reset(following.set("_reset", done))
            following = fresh.exclude("_reset")
        self._shown = following
        flags = (shown[key].flatten().cpu().numpy() for key in ("terminated", "truncated"))
        return _array(following["observation"]), _array(shown["reward"].flatten()), *flags, infos


class GymnasiumEnv(gymnasium.Env[Array, Array]):
    """One robot, as a Gymnasium environment: :class:`GymnasiumVectorEnv` with one row that its user starts anew.

    Args:
        task: Name of one of :data:`TASKS`.
        told: To the task.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, task: str, **told: Any) -> None:
        self.rows = GymnasiumVectorEnv(task, 1, autoreset=False, **told)
        self.observation_space, self.action_space = self.rows.single_observation_space, self.rows.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        observation, infos = self.rows.reset(seed=seed, options=options)
        return observation[0], infos

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Act once."""
        observation, reward, terminated, truncated, infos = self.rows.step(np.asarray(action)[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), infos


def reseed(env: TransformedEnv, seed: int) -> None:
    """Open the streams of all random transforms again, as if the environment had been made with that seed."""
    for module in env.transform.modules():
        if isinstance(module, RandomTransform):
            module.seed = seed
            module.episode, module.row_stream = module.episode.new_empty(0), module.row_stream.new_empty(0)


def _box(width: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)


def _array(value: torch.Tensor) -> Array:
    return value.detach().cpu().numpy().astype(np.float32, copy=True)
