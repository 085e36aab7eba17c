"""What a TorchRL transform owes its users, as tests that any project can run on its own.

Subclass :class:`TransformContract` in a test file and say how to make the transform; pytest does the rest. The parts
it is made of serve other tests as well. It needs pytest, which the package does not install.
"""

import pytest

pytest.register_assert_rewrite("torchrl_athletic.testing.contract", "torchrl_athletic.testing.rollouts")

from torchrl_athletic.testing.contract import TransformContract  # noqa: E402
from torchrl_athletic.testing.no_host_sync import HostSyncError, no_host_sync  # noqa: E402
from torchrl_athletic.testing.rollouts import difference, make_actions, play, rows_together  # noqa: E402
from torchrl_athletic.testing.toy_env import ToyEnv  # noqa: E402

__all__ = [
    "HostSyncError",
    "ToyEnv",
    "TransformContract",
    "difference",
    "make_actions",
    "no_host_sync",
    "play",
    "rows_together",
]
