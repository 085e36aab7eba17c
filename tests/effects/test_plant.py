import numpy as np
import pytest
from effects.arm import address, arm

from torchrl_athletic.effects import JointAddress, Plant
from torchrl_athletic.effects.plant import Start


def test_a_new_plant_is_the_given_model():
    plant = Plant(arm(), address(), 4)
    assert plant.open_loop
    assert not plant.fields
    for name in ("delay", "lag", "torque_offset", "encoder_offset"):
        np.testing.assert_array_equal(getattr(plant, name), np.zeros((4, 2)))
    assert not plant.clock_offset.any()
    for name in ("torque_scale", "kp_scale", "kd_scale", "encoder_scale"):
        np.testing.assert_array_equal(getattr(plant, name), np.ones((4, 2)))


def test_a_field_is_one_array_whose_rows_are_the_models_until_written():
    model = arm()
    plant = Plant(model, address(), 3)
    plant.of("dof_damping")[1, 0] = 7.0
    assert plant.of("dof_damping") is plant.fields["dof_damping"]
    np.testing.assert_allclose(plant.of("dof_damping"), [[0.4, 0.08], [7.0, 0.08], [0.4, 0.08]])
    assert model.dof_damping[0] == 0.4
    assert plant.of("body_inertia").shape == (3, model.nbody, 3)


def test_an_unknown_field_is_refused():
    with pytest.raises(AttributeError, match="dof_dampling"):
        Plant(arm(), address(), 1).of("dof_dampling")


def test_dry_friction_is_written_where_the_joint_is_in_the_model():
    swapped = JointAddress.of(arm(), ("elbow", "shoulder"))
    plant = Plant(arm(), swapped, 2)
    plant.set_dry_friction(0, np.array([0.1, 0.2]))
    np.testing.assert_allclose(plant.fields["dof_frictionloss"], [[0, 0.1], [0, 0.2]])
    np.testing.assert_array_equal(plant.fields["dof_solref"][:, 0], np.tile(arm().dof_solref[0], (2, 1)))
    assert (plant.fields["dof_solref"][:, 1, 0] == 2 * arm().opt.timestep).all()  # the stiffest that is stable


@pytest.mark.parametrize("way", ["motor", "laws", "gears"])
def test_what_depends_on_the_state_closes_the_loop(way):
    plant = Plant(arm(), address(), 1)
    getattr(plant, way).append(lambda now: -now.position)
    assert not plant.open_loop


def test_an_option_of_the_model_is_a_field_too():
    plant = Plant(arm(), address(), 2)
    plant.of("opt.gravity")[1, 2] = -1.6
    np.testing.assert_array_equal(plant.fields["opt.gravity"], [[0, 0, -9.81], [0, 0, -1.6]])


def test_a_hidden_state_is_found_once_for_rows_of_the_same_parameters():
    samples, asked = np.arange(5.0), []
    start = Start(samples, samples[:, None], samples[:, None], samples[:, None], np.array([0, 3, 0, 4]))

    def history(piece: slice, width: float, level: float) -> np.ndarray:
        asked.append((width, level))
        return width * samples[piece] + level

    width, level = np.array([2.0, 2.0, 1.0, 1.0]), np.array([0.0, 0.0, 0.5, 0.5])
    np.testing.assert_array_equal(start.of(history, width, level), [0.0, 6.0, 0.5, 4.5])
    assert sorted(asked) == [(1.0, 0.5), (2.0, 0.0)]


def test_each_row_reaches_the_samples_of_its_own_piece_at_their_stamps_and_stays_within_it():
    """Stamps of tenths of a second, few of which binary numbers hold; the second piece begins at sample 20."""
    time = np.concatenate([0.1 * np.arange(20), 7.3 + 0.1 * np.arange(30)])
    still = np.zeros((50, 1))
    start = Start(time, still, still, still, np.array([3, 22]), begins=np.array([0, 20]))
    for k in range(20):
        assert start.at(np.array([time[k], time[20 + k]])).tolist() == [k, 20 + k]
        assert start.at(np.array([time[k], time[20 + k]]) + 0.099).tolist() == [k, 20 + k]
    assert start.at(np.array([-5.0, -5.0])).tolist() == [0, 20]
    assert start.at(np.array([99.0, 99.0])).tolist() == [19, 49]
