"""Names of entries that belong together."""

from __future__ import annotations

from tensordict import NestedKey


def beside(key: NestedKey, name: str) -> NestedKey:
    """Key of an entry that stands next to another and says so.

    Example:
        >>> beside("push", "on"), beside(("robot", "push"), "on")
        ('push_on', ('robot', 'push_on'))
    """
    return f"{key}_{name}" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_{name}")
