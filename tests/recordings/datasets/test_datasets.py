"""What holds of every data set."""

import mujoco
import numpy as np
import pytest

from torchrl_athletic.recordings.datasets import DATASETS, load_dataset


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no data set 'emp'.*emps, two_link_arm"):
        load_dataset("emp")


@pytest.mark.parametrize("name", DATASETS)
def test_recordings_speak_of_the_joints_of_the_model_in_its_order(name, real_recordings):
    dataset = load_dataset(name)
    model = mujoco.MjModel.from_xml_string(dataset.model)
    joints = tuple(model.joint(int(j)).name for j in model.actuator_trnid[:, 0])
    takes = dataset.recordings + dataset.heldout + dataset.extra
    assert dataset.name == name
    assert dataset.recordings
    assert dataset.heldout
    assert all(take.joint_names == joints for take in takes)
    assert "Licence" in dataset.notes
    assert "Source" in dataset.notes


@pytest.mark.parametrize("name", DATASETS)
def test_measured_velocity_is_the_derivative_of_position(name, real_recordings):
    dataset = load_dataset(name)
    for take in dataset.recordings + dataset.heldout:
        if take.velocity is not None:
            slope = np.gradient(take.position, take.time, axis=0)
            for joint in range(take.num_joints):
                assert np.corrcoef(slope[:, joint], take.velocity[:, joint])[0, 1] > 0.85
                assert np.std(slope[:, joint]) == pytest.approx(np.std(take.velocity[:, joint]), rel=0.2)


@pytest.mark.parametrize("name", DATASETS)
def test_no_take_is_both_fitted_and_kept_aside(name, real_recordings):
    dataset = load_dataset(name)
    fitted = {(take.source, take.time[0]) for take in dataset.recordings}
    assert not fitted & {(take.source, take.time[0]) for take in dataset.heldout}
