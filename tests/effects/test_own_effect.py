"""The effect that the docs add to the catalogue is named where it is concealed, and by no other name so well."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from diagnosis.plants import RATE, pendulum, smooth_torque

from torchrl_athletic.diagnosis import Diagnosis, diagnose
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.effects import CATALOGUE, Effect
from torchrl_athletic.recordings import Recording

PAGE = (Path(__file__).parents[2] / "docs/effects.md").read_text(encoding="utf-8")
OWN = PAGE[PAGE.index("## Add your own effect") :]
DRAG = 0.03


def swing(seed: int, amplitude: float) -> Recording:
    """A pendulum with a sail, integrated by a plain loop."""
    model = mujoco.MjModel.from_xml_string(pendulum())
    data, command = mujoco.MjData(model), smooth_torque(8.0, amplitude, seed)
    position = np.empty_like(command)
    for k, u in enumerate(command):
        position[k] = data.qpos
        for _ in range(round(1 / RATE / model.opt.timestep)):
            data.qfrc_applied[:] = u - DRAG * data.qvel * np.abs(data.qvel)
            mujoco.mj_step(model, data)
    read = position + 1e-5 * np.random.default_rng(seed).standard_normal(position.shape)
    time = np.arange(len(command)) / RATE
    return Recording(time, ("pendulum",), read, torque_command=command, source=f"take_{seed}")


def diagnosed(catalogue: tuple[Effect, ...]) -> Diagnosis:
    return diagnose(pendulum(), [swing(0, 1.0), swing(1, 3.0)], [swing(9, 2.0)], catalogue=catalogue)


@pytest.fixture(scope="module")
def extended() -> tuple[Effect, ...]:
    [code] = re.findall(r"^```python\n(.*?)^```", OWN, re.S | re.M)
    scope: dict[str, object] = {}
    exec(compile(code, "docs/effects.md", "exec"), scope)
    return scope["catalogue"]


@pytest.mark.slow  # tests/docs/test_effects.py finds it by the search alone
def test_it_is_named_with_its_value_and_without_it_a_stand_in_leaves_an_error(extended):
    with_own, without = diagnosed(extended), diagnosed(CATALOGUE)
    [finding] = with_own.answer.findings
    assert (finding.effect, finding.joint) == ("air_drag", "pendulum")
    assert finding.parameters["drag"].value == pytest.approx(DRAG, rel=0.03)
    assert with_own.answer.verdict == "explained"
    left, floor = with_own.answer.fit["heldout"].after, with_own.answer.fit["heldout"].floor
    assert left < 1.5 * floor
    assert without.answer.fit["heldout"].after > 5 * left
    assert without.answer.unexplained_share > 10 * with_own.answer.unexplained_share


def test_what_was_found_is_read_back_with_the_catalogue_that_has_it(extended):
    recording = swing(9, 2.0)
    own = extended[-1]
    model = mujoco.MjModel.from_xml_string(pendulum())
    content = {
        "schema": "torchrl_athletic/corrected/1",
        "joint_names": ["pendulum"],
        "effects": [{"effect": own.name, "joint": "pendulum", "parameters": {"drag": {"value": DRAG}}}],
        "trims": [],
    }
    with pytest.raises(ValueError, match=r"'air_drag' is not in the catalogue.*Pass yours"):
        Simulation.from_json(content, model)
    path = Simulation.from_json(content, model, extended).rollout(recording, window=None)
    np.testing.assert_allclose(path, recording.position, atol=0.02)
