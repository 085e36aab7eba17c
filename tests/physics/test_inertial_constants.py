"""Constants of thousands of envs at once against MuJoCo's own, one model at a time."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_athletic.physics.inertial_constants import INERTIAL_FIELDS, InertialConstants
from torchrl_athletic.robots import Bucket, Dumbbell, b2z1, z1

BALL = """<mujoco><worldbody><body pos="0 0 1"><joint type="ball"/><geom type="box" size=".1 .2 .3" pos=".1 0 .2"/>
  <body pos="0 .3 .1" quat=".9 .1 .3 .2"><joint type="slide" axis="1 1 0" armature=".3"/><geom size=".1" pos="0 .1 0"/>
  </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    "model",
    [b2z1().model(), b2z1(tool=Dumbbell()).model(), z1(tool=Bucket()).model(), mujoco.MjModel.from_xml_string(BALL)],
    ids=["b2z1", "dumbbell", "ball in a bucket", "ball joint"],
)
def test_randomised_masses_have_the_weights_that_mujoco_gives_them(model):
    rng = np.random.default_rng(0)
    envs, rows = [], {name: [] for name in INERTIAL_FIELDS}
    for _ in range(20):
        env = mujoco.MjModel.from_xml_string(BALL) if model.nbody == 3 else model.__copy__()
        scale = rng.uniform(0.3, 2.0, model.nbody)
        env.body_mass[:] *= scale
        env.body_inertia[:] *= scale[:, None] * rng.uniform(0.8, 1.2, (model.nbody, 1))
        moved = model.body_sameframe == 0  # others were compiled without a place for it
        env.body_ipos[moved] += rng.uniform(-0.03, 0.03, (moved.sum(), 3))
        env.dof_armature[:] *= rng.uniform(0.5, 2.0, model.nv)
        for name, values in rows.items():
            values.append(getattr(env, name).copy())
        mujoco.mj_setConst(env, mujoco.MjData(env))
        envs.append(env)
    given = {name: torch.tensor(np.array(values), dtype=torch.float32) for name, values in rows.items()}
    for name, value in InertialConstants.of(model)(given).items():
        wanted = np.array([getattr(env, name) for env in envs])
        np.testing.assert_allclose(value.numpy(), wanted, rtol=2e-3, atol=1e-6, err_msg=name)


def test_the_model_itself_is_a_fixed_point():
    model = b2z1().model()
    given = {name: torch.tensor(getattr(model, name), dtype=torch.float32)[None] for name in INERTIAL_FIELDS}
    for name, value in InertialConstants.of(model)(given).items():
        np.testing.assert_allclose(value[0].numpy(), getattr(model, name), rtol=2e-4, atol=1e-7, err_msg=name)
