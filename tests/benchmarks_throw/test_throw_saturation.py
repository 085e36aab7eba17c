"""Motors at their limits during a throw."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from benchmarks.throw_saturation import AtLimit, share_at_limit
from benchmarks.throw_transfer import Trained, load_recipe, stay_on_reference
from torchrl_athletic.robots import z1

recipe = load_recipe()


def test_a_motor_is_at_its_limit_where_it_gives_all_that_its_speed_leaves_whichever_way_it_pushes():
    robot = replace(z1(), torque_limit=(10.0,) * 7, velocity_limit=(4.0,) * 7)
    torque = torch.tensor([[5.0, -10.0, 4.9, -5.0, 5.0, 0.0, 10.0]])
    velocity = torch.tensor([[2.0, 2.0, 2.0, -2.0, -2.0, 0.0, 0.0]])
    noted = {"torque": torque, "joint_velocity": velocity, "steps_at_limit": torch.ones(1, 7)}
    counted = AtLimit(robot).inv(TensorDict(noted, [1]))
    assert (counted["steps_at_limit"] - 1).tolist() == [[1, 1, 0, 1, 0, 0, 1]]


@pytest.mark.parametrize(("strength", "least", "most"), [(100.0, 0.0, 0.0), (1.0, 0.2, 1.0)])
def test_the_same_throw_takes_motors_to_their_limits_and_stronger_ones_never(strength, least, most):
    simulator = recipe.load_simulator(None)
    nominal = simulator.nominal
    robot = replace(nominal, torque_limit=tuple(strength * limit for limit in nominal.torque_limit))
    robot = replace(robot, velocity_limit=tuple(max(1.0, strength) * limit for limit in nominal.velocity_limit))
    thrower = Trained("reference", stay_on_reference, "reference", "default", replace(simulator, nominal=robot))
    shares = share_at_limit(thrower, throws=2)
    assert shares.shape == (6,)
    assert least <= shares[1] <= most
