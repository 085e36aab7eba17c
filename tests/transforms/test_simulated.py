"""What is found in a model is found once, and anew in another one."""

from torchrl.envs import TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.transforms import InitialState
from torchrl_athletic.transforms.simulated import once_per_model


def test_another_model_is_looked_at_again():
    robot, part, looked = z1(), InitialState(), []
    env = TransformedEnv(TorqueEnv(robot), part)

    def masses(env):
        looked.append(env.physics.model)
        return env.physics.model.body_mass.copy()

    one, other = TorqueEnv(robot).physics, TorqueEnv(robot).physics
    other.model.body_mass[1] += 1.0
    for physics in (one, one, other, other, one):
        env.base_env.physics = physics
        assert (once_per_model(part, masses) == physics.model.body_mass).all()
    assert len(looked) == 3
