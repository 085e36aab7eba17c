"""What is found in a model is found once, and anew in another one."""

from types import SimpleNamespace

import pytest
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_athletic.envs import TorqueEnv
from torchrl_athletic.robots import z1
from torchrl_athletic.testing import ToyEnv
from torchrl_athletic.transforms import InitialState
from torchrl_athletic.transforms.simulated import once_per_model, refuse_undeclared, refuse_undoing, simulated_env


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


class Writer(Transform):
    """Writes some rows of some fields."""

    def __init__(self, **rows):
        super().__init__(in_keys=[], out_keys=[])
        self.rows = rows

    def written(self):
        return self.rows


class OtherWriter(Writer):
    pass


@pytest.mark.parametrize(
    ("earlier", "told"),
    [
        (Writer(body_mass={1, 2}), r"two Writer write \['body_mass'\]"),
        (OtherWriter(body_mass={2, 3}, body_ipos={1}), r"OtherWriter and Writer write \['body_mass'\]"),
        (Compose(Writer(body_mass={2})), r"two Writer write"),
        (Writer(body_mass={3}, body_ipos={2}), None),
        (Writer(dof_damping={2}), None),
        (Transform(in_keys=[], out_keys=[]), None),
    ],
)
def test_two_may_write_one_field_in_different_rows_only(earlier, told):
    earlier, later = earlier.clone(), Writer(body_mass={1, 2}, body_ipos={0})
    env = TransformedEnv(ToyEnv(1), Compose(earlier, later))
    assert later.parent.base_env is env.base_env
    if told is None:
        refuse_undoing(later, later.written())
    else:
        with pytest.raises(ValueError, match=told):
            refuse_undoing(later, later.written())


@pytest.mark.parametrize(
    ("physics", "shared"),
    [
        (SimpleNamespace(fields=("body_mass", "body_ipos")), None),
        (SimpleNamespace(fields=("body_ipos",)), r"\['body_mass'\]"),
        (None, r"\['body_mass', 'body_ipos'\]"),
    ],
)
def test_fields_that_rows_share_are_not_to_be_written(physics, shared):
    env = TransformedEnv(ToyEnv(1), Writer())
    env.base_env.physics, writer = physics, env.transform
    if shared is None:
        refuse_undeclared(writer, ("body_mass", "body_ipos"), "Mend it.")
        assert simulated_env(writer) is env.base_env
    else:
        with pytest.raises(ValueError, match=f"share {shared}. Mend it."):
            refuse_undeclared(writer, ("body_mass", "body_ipos"), "Mend it.")
    if physics is None:
        with pytest.raises(ValueError, match="which ToyEnv lacks"):
            simulated_env(writer)
