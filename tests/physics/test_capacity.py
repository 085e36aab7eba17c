"""Room for contacts is found from poses that a robot can be in, not from ones in which it lies in the ground."""

import mujoco
import numpy as np
import pytest
from physics.models import compiled

from torchrl_athletic.physics.capacity import _lift, estimate_capacity
from torchrl_athletic.robots import b2z1

BOX = """<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("depth", [0.05, 0.3])
def test_what_is_in_the_ground_is_lifted_onto_it_and_no_higher(depth):
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.1 - depth
    _lift(model, data)
    mujoco.mj_forward(model, data)
    assert data.qpos[2] == pytest.approx(0.1, abs=0.006)
    assert min(data.contact.dist[: data.ncon]) > -0.006


def test_what_is_on_the_ground_or_above_it_stays_where_it_is():
    model = compiled("hopper")
    data = mujoco.MjData(model)
    for height in (0.38, 2.0):
        data.qpos[2] = height
        before = data.qpos.copy()
        _lift(model, data)
        assert np.array_equal(data.qpos, before)


def test_room_is_for_a_robot_on_the_ground_not_for_one_that_starts_within_it():
    """A cube of 27 balls stands on the 9 of one face; random heights would begin with all of them in the ground."""
    line = (-0.1, 0.0, 0.1)
    balls = "".join(f"<geom size='.02' pos='{x} {y} {z}' conaffinity='0'/>" for x in line for y in line for z in line)
    contacts, _ = estimate_capacity(
        mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><geom type='plane' size='5 5 1'/>"
            f"<body pos='0 0 .12'><freejoint/>{balls}</body></worldbody></mujoco>"
        )
    )
    assert 1.5 * 9 <= contacts < 1.5 * 9 + 8  # half as many again, in eights


def test_no_fall_of_a_robot_needs_more_than_was_set_aside():
    """From poses of another seed than those of the estimate."""
    model = b2z1().model()
    contacts, rows = estimate_capacity(model)
    data, rng = mujoco.MjData(model), np.random.default_rng(5)
    for _ in range(10):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2], data.qpos[3:7] = 0.6, rng.normal(size=4)
        data.qpos[7:] = rng.uniform(*model.jnt_range[1:].T)
        for _ in range(60):
            mujoco.mj_step(model, data)
            assert data.ncon <= contacts
            assert data.nefc <= rows
