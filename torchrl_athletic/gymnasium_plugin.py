"""Tells Gymnasium of the tasks. It is loaded whenever Gymnasium is, so it imports nothing heavy."""

TASKS = ("WholeBody", "BallThrow", "DumbbellSnatch", "SledPull")


def register() -> None:
    """Make Gymnasium know ``torchrl_athletic/SledPull-v0`` and the others; an entry point of the package calls it.

    Example:
        >>> import gymnasium
        >>> "torchrl_athletic/SledPull-v0" in gymnasium.registry
        True
    """
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            id=f"torchrl_athletic/{task}-v0",
            entry_point="torchrl_athletic.envs.gymnasium_env:GymnasiumEnv",
            vector_entry_point="torchrl_athletic.envs.gymnasium_env:GymnasiumVectorEnv",
            kwargs={"task": task},
        )
