import mujoco
import numpy as np
import pytest
from effects.arm import ARM, JOINTS, address, arm, record

from torchrl_athletic.effects import JointAddress, Plant, project_recording
from torchrl_athletic.effects.gravity import GravityTilt, tilted


def tilted_base(roll: float, pitch: float) -> mujoco.MjModel:
    """The arm on a base that is turned in the world, about the base's y axis first, then about its x axis."""
    spec = mujoco.MjSpec.from_string(ARM)
    upper = spec.body("upper")
    q = [np.zeros(4) for _ in range(3)]
    mujoco.mju_axisAngle2Quat(q[0], np.array([0.0, 1, 0]), pitch)
    mujoco.mju_axisAngle2Quat(q[1], np.array([1.0, 0, 0]), roll)
    mujoco.mju_mulQuat(q[2], q[0], q[1])
    upper.quat = q[2]
    return spec.compile()


def test_tilted_gravity_is_what_a_turned_base_feels():
    roll, pitch = 0.2, -0.15
    model, turned = arm(), tilted_base(roll, pitch)
    model.opt.gravity[:] = tilted(model.opt.gravity[None], np.array([[roll, pitch]]))[0]
    for pose in ([0.3, -0.8], [1.5, 0.4]):
        bias = []
        for m in (model, turned):
            data = mujoco.MjData(m)
            data.qpos[:] = pose
            mujoco.mj_forward(m, data)
            bias.append(data.qfrc_bias.copy())
        np.testing.assert_allclose(bias[0], bias[1], atol=1e-9)


def test_no_tilt_is_the_given_gravity_and_its_strength_never_changes():
    plant = Plant(arm(), address(), 3)
    GravityTilt().apply(plant, 0, np.array([[0.0, 0.0], [0.3, 0.0], [0.1, -0.3]]))
    gravity = plant.fields["opt.gravity"]
    np.testing.assert_array_equal(gravity[0], arm().opt.gravity)
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81)
    assert gravity[1, 1] == pytest.approx(-9.81 * np.sin(0.3))
    assert gravity[2, 0] < 0


@pytest.mark.parametrize("pitch", [0.05, -0.2])
def test_the_missing_torque_is_the_columns_times_the_angles_on_every_joint(pitch):
    recording = record(GravityTilt(), 0, [0.0, pitch], seconds=5.0)
    s = project_recording(recording, arm(), np.zeros(2), kernel=0.01)
    columns = GravityTilt().fingerprint(s, 0, {}).columns
    assert np.abs(columns[:, :, 0]).max() < 0.2 * np.abs(columns[:, :, 1]).max()  # both axes are horizontal: no roll
    predicted = columns @ [0.0, pitch]
    for j in range(len(JOINTS)):
        left = ((s.missing - predicted)[:, j] ** 2).sum()
        assert left < 0.02 * (s.missing[:, j] ** 2).sum()


def test_a_robot_without_gravity_cannot_stand_askew():
    weightless = arm()
    weightless.opt.gravity[:] = 0
    assert not GravityTilt().parameters(weightless, address(), 0)
    switched_off = arm()
    switched_off.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    assert not GravityTilt().parameters(switched_off, address(), 0)
    s = project_recording(record(seconds=2.0, model=weightless), weightless, np.zeros(2))
    assert not GravityTilt().applies(s)
    assert not GravityTilt().grid(s, 0)
    assert GravityTilt().applies(project_recording(record(seconds=2.0), arm(), np.zeros(2)))


def test_no_tilt_of_forty_degrees():
    for angle in GravityTilt().parameters(arm(), address(), 0):
        assert np.degrees(max(angle.upper, -angle.lower)) < 25
    assert GravityTilt.whole_robot


def test_the_sentence_says_both_angles():
    names = JointAddress.of(arm(), JOINTS)
    text = GravityTilt().sentence(
        "the robot", {"roll": 0.03, "pitch": -0.04}, GravityTilt().parameters(arm(), names, 0)
    )
    assert "+30 mrad" in text
    assert "-40 mrad" in text
    assert "2.9 degrees" in text
