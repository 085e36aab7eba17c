"""The first example of the page on physics runs as it stands."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs/physics.md").read_text(encoding="utf-8")


def test_the_example_moves_every_env_for_its_fifty_control_steps():
    code = re.findall(r"^```python\n(.*?)^```", PAGE, re.S | re.M)[0].replace("num_envs=1024", "num_envs=3")
    scope: dict = {}
    exec(code, scope)
    physics = scope["physics"]
    assert physics.time.tolist() == pytest.approx([50 * 4 * physics.timestep] * 3)
    assert not physics.diverged.any()
