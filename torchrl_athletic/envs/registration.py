"""What Gymnasium is told of the tasks."""

from importlib.util import find_spec

TASKS = ("WholeBody", "BallThrow", "DumbbellSnatch", "SledPull")
"""Names under ``torchrl_athletic/``, each with the ending ``-v0``."""


def register_with_gymnasium() -> None:
    """Make Gymnasium know the tasks, if it is installed; importing ``torchrl_athletic.envs`` does so.

    Example:
        >>> import gymnasium
        >>> import torchrl_athletic.envs
        >>> "torchrl_athletic/SledPull-v0" in gymnasium.registry
        True
    """
    if find_spec("gymnasium") is None:
        return
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            id=f"torchrl_athletic/{task}-v0",
            entry_point="torchrl_athletic.envs.gymnasium_env:GymnasiumEnv",
            vector_entry_point="torchrl_athletic.envs.gymnasium_env:GymnasiumVectorEnv",
            kwargs={"task": task},
        )
