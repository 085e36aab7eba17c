"""Numbers that differ between robots, against MuJoCo and by statistics."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_athletic.functional import randomization, rotations

BALL = """
<mujoco><option timestep="{step}" gravity="0 0 {gravity}" integrator="implicitfast"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1" priority="1" solref="{solref}" solimp="0.99 0.99 0.001"/>
  <body pos="0 0 0.101"><freejoint/><geom size="0.1" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("restitution", [0.06, 0.2, 0.5, 0.8])
def test_a_ball_comes_back_with_this_share_of_its_speed(restitution):
    solref = randomization.restitution_solref(torch.tensor([0.02, 1.0]), torch.tensor(restitution)).tolist()
    text = BALL.format(step=0.0002, gravity=0, solref=" ".join(map(str, solref)))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qvel[2] = -1.0
    for _ in range(3000):
        mujoco.mj_step(model, data)
    assert data.qvel[2] == pytest.approx(restitution, abs=0.02)


def test_the_ground_stays_as_stiff():
    given = torch.tensor([0.02, 1.0])
    for restitution in (0.0, 0.3, 0.6):
        changed = randomization.restitution_solref(given, torch.tensor(restitution))
        assert changed.prod().item() == pytest.approx(0.02, rel=1e-5)


def test_damping_is_found_back():
    damping = torch.linspace(0.02, 1.95, 77, dtype=torch.float64)
    torch.testing.assert_close(
        randomization.restitution_damping(randomization.restitution(damping)), damping, atol=1e-3, rtol=0
    )


def test_directions_point_everywhere_alike():
    unit = 2 * torch.rand(40_000, 2, generator=torch.Generator().manual_seed(0)) - 1
    found = randomization.direction(unit)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(40_000))
    assert found.mean(0).abs().max() < 0.02
    torch.testing.assert_close(found.T @ found / 40_000, torch.eye(3) / 3, atol=0.01, rtol=0)


def test_a_turn_is_the_one_that_mujoco_makes():
    vector = np.array([0.3, -0.5, 0.2])
    expected = np.zeros(4)
    mujoco.mju_axisAngle2Quat(expected, vector / np.linalg.norm(vector), np.linalg.norm(vector))
    torch.testing.assert_close(randomization.turn(torch.tensor(vector)), torch.tensor(expected))
    turned = rotations.rotate(randomization.turn(torch.tensor([0.0, 0, torch.pi / 2])), torch.tensor([1.0, 0, 0]))
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)
    assert randomization.turn(torch.zeros(3)).tolist() == [1, 0, 0, 0]
