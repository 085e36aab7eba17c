"""Robots of public logs: what is read of a clone, from a clone made here."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.io import savemat

from benchmarks.real_robots.robots.arms import ar5, kr300, krang, panda, tx40, xmate3
from benchmarks.real_robots.robots.benches import ak80_pendulum, cart_pendulum
from benchmarks.real_robots.robots.legs import compass_leg, unitree
from benchmarks.real_robots.robots.servos import _loaded_pendulum, mx106

LEG = """
<mujoco>
  <compiler angle="radian"/>
  <asset><mesh name="shell" file="absent.obj"/></asset>
  <worldbody>
    <body name="base" pos="0 0 1">
      <inertial pos="0 0 0" mass="6" diaginertia="1 1 1"/>
      <freejoint/>
      <geom mesh="shell" type="mesh"/>
      <body name="thigh">
        <inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="hip" axis="0 1 0" damping="0.6" armature="0.01" frictionloss="0.2" range="-1 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="hip" joint="hip" ctrlrange="-20 20"/></actuator>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0 0.5"/></keyframe>
</mujoco>
"""


def clone(folder: Path, takes: int, samples: int = 90) -> None:
    home = folder / "sim2real-robot-identification"
    (home / "robot_model/leg").mkdir(parents=True)
    (home / "datasets/leg").mkdir(parents=True)
    (home / "robot_model/leg/leg.xml").write_text(LEG)
    time = 0.005 * np.arange(samples)
    for k in range(takes):
        wave = k + np.sin(time)[:, None]
        torch.save(
            {
                "time": time,
                "dof_pos": torch.from_numpy(wave),
                "dof_vel": np.cos(time)[:, None].astype(np.float32),
                "des_dof_pos": torch.from_numpy(wave + 0.5),
                "des_dof_vel": np.zeros_like(wave),
                "kp": torch.tensor([20.0]),
                "kd": np.array([1.5]),
            },
            home / f"datasets/leg/traj_{k}.pt",
        )


def test_what_the_logs_authors_fitted_is_taken_out_of_a_unitree_whose_base_is_held(tmp_path):
    clone(tmp_path, 4)
    robot = unitree(tmp_path, "leg")
    model = mujoco.MjModel.from_xml_string(robot.xml)
    assert (model.nv, model.nkey, model.ngeom) == (1, 0, 0)
    assert (model.dof_frictionloss[0], model.dof_damping.ravel()[0], model.dof_armature[0]) == (0.0, 0.0, 0.0)
    assert model.body("base").mass == pytest.approx(6.0)
    assert model.jnt_range[0] == pytest.approx([-1.0, 1.0])
    assert model.actuator_ctrlrange[0] == pytest.approx([-20.0, 20.0])
    assert [[r.source for r in group] for group in (robot.recordings, robot.heldout)] == [
        ["leg/traj_0", "leg/traj_1"],
        ["leg/traj_2", "leg/traj_3"],
    ]
    take = robot.recordings[1]
    assert take.joint_names == ("hip",)
    assert take.kp is not None
    assert take.kd is not None
    assert take.velocity is not None
    assert take.position_target is not None
    assert (take.kp.tolist(), take.kd.tolist()) == ([20.0], [1.5])
    np.testing.assert_allclose(take.position[:, 0], 1 + np.sin(take.time), atol=1e-12)
    np.testing.assert_allclose(take.velocity[:, 0], np.cos(take.time), atol=1e-6)
    np.testing.assert_allclose(take.position_target - take.position, 0.5, atol=1e-12)


def test_of_a_unitree_with_one_take_the_last_third_is_kept_aside(tmp_path):
    clone(tmp_path, 1)
    robot = unitree(tmp_path, "leg")
    first, last = (group[0].time for group in (robot.recordings, robot.heldout))
    np.testing.assert_allclose(np.concatenate([first, last]), 0.005 * np.arange(90))
    assert (len(robot.recordings), len(robot.heldout), len(last)) == (1, 1, 30)


def test_a_motors_payload_is_a_body_of_its_own_that_weighs_and_turns_as_a_point_at_the_arms_end():
    """A rod of 0.2 kg and 0.3 m, which turns about its end, with 0.5 kg there."""
    take: Any = SimpleNamespace(metadata={"payload_kg": 0.5})
    robot = _loaded_pendulum([take], 0.2, 0.3, kp=5.0, kv=0.1, limit=2.0, aside=0.5, looked_at="no")
    model = robot.model_of(take)
    data, mass = mujoco.MjData(model), np.zeros((1, 1))
    data.qpos[0] = 0.4
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    assert mass[0, 0] == pytest.approx((0.2 / 3 + 0.5) * 0.3**2, rel=1e-6)
    assert data.qfrc_bias[0] == pytest.approx((0.2 / 2 + 0.5) * 0.3 * 9.81 * np.sin(0.4), rel=1e-6)
    assert model.body_mass.tolist() == [0.0, 0.2, 0.5]
    assert mujoco.MjModel.from_xml_string(robot.xml).body_mass.tolist() == [0.0, 0.2]


def test_a_compass_leg_is_read_in_degrees_and_volts_and_parted_where_none_is_lost(tmp_path):
    home = tmp_path / "SydneyCompassGait/System Identification/SysID_Experiment 1"
    home.mkdir(parents=True)
    time = 0.5 * np.arange(120)
    savemat(
        home / "realVSmodel_fwAnd5vstepsx3AndChirp_innerSW.mat",
        {"datatimeall": time, "dataoutall": 3 * time, "datainall": -time / 10},
    )
    robot = compass_leg(tmp_path)
    fitted, aside = robot.recordings[0], robot.heldout[0]
    assert fitted.time[-1] == 27.5
    assert aside.time[0] == 28.0
    assert len(fitted.time) + len(aside.time) == 120
    assert aside.position[0, 0] == pytest.approx(np.radians(84.0))
    assert aside.torque_command[0, 0] == pytest.approx(-0.0182 * 2.8)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    about = mujoco.mju_norm3(data.xipos[1]) ** 2 * model.body_mass[1] + model.body_inertia[1, 1]
    assert about == pytest.approx(0.004324, rel=1e-3)  # as its authors measured it about the hip


def test_a_cart_pendulum_is_the_authors_and_driven_by_the_motors_current(tmp_path):
    """Their equation, of the pendulum, which is upright at zero: m l² q̈ = m l cos q ẍ + m g l sin q."""
    home = tmp_path / "masterThesisMatlab/testResults/data"
    for kind in ("swingUp", "swingUpAndCatch"):
        (home / kind).mkdir(parents=True)
        for name in ("swing1", "swing1_p005", "swing1_p006", "swing1_p007", "swNsl1", "swNsl3", "swNsl4"):
            rows = np.arange(13) + 100.0 * np.arange(60)[:, None]
            np.savetxt(home / kind / f"{name}.csv", rows, delimiter=",")
    robot = cart_pendulum(tmp_path)
    take = robot.recordings[0]
    assert take.position[0].tolist() == [204.0, 201.0]  # the cart, and the angle that is not wrapped
    assert take.torque_command[0].tolist() == pytest.approx([0.0934 / 0.028 * 211.0, 0.0])
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = (0.1, 0.4), (20.0, 0.0)
    mujoco.mj_forward(model, data)
    cart, pendulum = data.qacc
    assert pendulum * 0.31692 == pytest.approx(np.cos(0.4) * cart + 9.82 * np.sin(0.4), rel=1e-3)
    assert cart > 0


def test_a_panda_has_neither_rotors_nor_servos_since_its_torques_are_of_the_links(tmp_path):
    joints = "".join(
        f"<body><joint name='joint{k}'/><inertial pos='0 0 .1' mass='1' diaginertia='1 1 1'/>" for k in range(7)
    )
    home = tmp_path / "mujoco_menagerie/franka_emika_panda"
    home.mkdir(parents=True)
    servos = "<actuator><position joint='joint0' kp='9'/></actuator><keyframe><key qpos='0 0 0 0 0 0 0'/></keyframe>"
    default = "<default><joint damping='1' armature='0.1'/></default>"
    (home / "panda_nohand.xml").write_text(
        f"<mujoco>{default}<worldbody>{joints}{7 * '</body>'}</worldbody>{servos}</mujoco>"
    )
    home = tmp_path / "FrankaEmikaPandaDynModel/matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    home.mkdir(parents=True)
    time = 0.05 * np.arange(420)
    np.savetxt(home / "exciting_traj_time.txt", time)
    np.savetxt(home / "exciting_traj_positions.txt", np.arange(7 * 420))
    np.savetxt(home / "exciting_traj_torques.txt", -np.arange(7 * 420).reshape(420, 7))
    robot = panda(tmp_path)
    fitted, aside = robot.recordings[0], robot.heldout[0]
    assert fitted.time[-1] < 8.9 <= aside.time[0] < aside.time[-1] < 13.3
    assert fitted.position[2].tolist() == list(range(14, 21))
    assert fitted.torque_command[2].tolist() == list(range(-14, -21, -1))
    model = mujoco.MjModel.from_xml_string(robot.xml)
    assert not model.dof_damping.any()
    assert not model.dof_armature.any()
    assert model.jnt_actfrcrange[:, 1].tolist() == [87.0] * 4 + [12.0] * 3
    assert model.actuator_gainprm[:, 0].tolist() == 7 * [1.0]


def test_a_tx40s_sixth_motor_turns_its_fifth_joint_too(tmp_path):
    joints = "".join(
        f"""<link name="link{k}"><inertial><mass value="1"/><inertia ixx="{k % 2}" iyy="{k % 2}" izz="{k % 2}"
        ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="joint_{k + 1}" type="revolute"><parent link="link{k}"/>
        <child link="link{k + 1}"/><limit effort="{10 + k}" lower="-3" upper="3"/></joint>"""
        for k in range(6)
    )
    last = """<link name="link6"><inertial><mass value="1"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0"
    iyz="0"/></inertial></link>"""
    home = tmp_path / "figaroh-examples/examples/staubli_TX40"
    for folder in ("urdf", "data"):
        (home / folder).mkdir(parents=True)
    (home / "urdf/tx40_mdh_modified.urdf").write_text(f'<robot name="tx40">{joints}{last}</robot>')
    samples = 45000
    motor = np.tile([32.0, 32.0, 45.0, -48.0, 45.0, 96.0], (samples, 1))
    torque = np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 2.0], (samples, 1))
    torque[:, 0] = np.arange(samples) % 5
    for name, rows in (("pos_read_data", motor), ("curr_data", torque)):
        np.savetxt(home / f"data/{name}.csv", rows, fmt="%g", delimiter=",", header="six names")
    robot = tx40(tmp_path)
    fitted, aside = robot.recordings[0], robot.heldout[0]
    assert [fitted.num_samples, aside.num_samples] == [6000, 3000]
    assert fitted.position[0] == pytest.approx([1.0, 1.0 - np.pi / 2, 1.0 + np.pi / 2, 1.0, 1.0, 2.0])
    power = motor[0] @ torque[:5].mean(0)
    assert fitted.torque_command[0] == pytest.approx([64.0, 0.0, 0.0, -48.0, 45.0 + 64.0, 64.0])
    turned = fitted.position[0] - [0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0]
    assert turned @ fitted.torque_command[0] == pytest.approx(power)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    assert model.actuator_forcerange[:, 1].tolist() == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    assert model.body_inertia[-1].min() == pytest.approx(1e-4)


def test_an_ak80s_pendulum_hangs_at_zero_and_two_controllers_are_kept_aside(tmp_path):
    for method in ("energy_shaping", "sac", "direct_collocation", "ddp", "ilqr"):
        home = tmp_path / f"torque_limited_simple_pendulum/results/control_method_{method}"
        home.mkdir(parents=True)
        rows = "".join(f"{0.005 * k},{0.01 * k},2.0,{-0.1 * k}\n" for k in range(90))
        (home / "data_measured.csv").write_text("time,position,velocity,torque\n" + rows)
    robot = ak80_pendulum(tmp_path)
    assert [len(robot.recordings), len(robot.heldout)] == [3, 2]
    assert robot.recordings[0].torque_command[10, 0] == pytest.approx(-1.0)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.1
    mujoco.mj_forward(model, data)
    assert data.qacc[0] < 0.0


def test_a_kr300_stands_as_its_authors_say_and_its_motors_turn_through_their_gears(tmp_path):
    """All angles zero is upright with the forearm level: 1 m ahead of a shoulder of 0.35 m, and 0.041 m below it."""
    for letter in "ABC":
        home = tmp_path / f"Robot_Identification/data/recorded_trajectories/2020-10-21 10s FF {letter} 08ms"
        home.mkdir(parents=True)
        degrees = np.outer(np.arange(1.0, 7.0), np.arange(60.0))
        rec = {"time_cont": 0.004 * np.arange(60), "act_pos_mot_deg": degrees, "act_torque_abs_nm": degrees / 10}
        savemat(home / "data.mat", {"rec": rec})
    robot = kr300(tmp_path)
    assert [len(robot.recordings), len(robot.heldout)] == [1, 2]
    take = robot.recordings[0]
    assert take.position[10] == pytest.approx(np.radians(10.0 * np.arange(1, 7)))
    assert take.torque_command[10, 0] == pytest.approx(1798 / 7)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.body("axis_5").xpos == pytest.approx([1.35, 0.0, 0.675 + 1.15 - 0.041])
    assert data.body("axis_6").xipos[0] == pytest.approx(1.35 + 0.24 + (200 * 0.1 - 17.78 * 0.05) / 217.78, abs=1e-3)
    assert data.qfrc_bias[0] == pytest.approx(0.0, abs=1e-6)  # about the vertical
    ahead = sum(model.body_mass[k] * (data.xipos[k, 0] - 0.35) for k in range(2, 7))
    assert abs(data.qfrc_bias[1]) == pytest.approx(9.81 * ahead, rel=1e-6)  # of all that hangs on the shoulder
    for body in range(1, 7):  # moments that a body can have
        least, middle, most = sorted(model.body_inertia[body])
        assert 0 < most <= least + middle


ARM = """<?xml version="1.0"?>
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="absent.xacro"/>
<link name="${nameofManipulator}_base"/>"""


def seven_joints(name: str) -> str:
    """A URDF of seven links along x, with a mesh that is not there."""
    out = ARM
    for k in range(1, 8):
        parent = "${nameofManipulator}_base" if k == 1 else f"link{k - 1}"
        out += f"""<link name="link{k}"><visual><geometry><mesh filename="package://a/b.stl"/></geometry></visual>
          <inertial><origin xyz="0.1 0 0"/><mass value="{k}"/>
          <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
          <joint name="{name}{k}" type="revolute"><parent link="{parent}"/><child link="link{k}"/>
          <origin xyz="0.2 0 0"/><axis xyz="0 1 0"/><limit effort="50" lower="-3" upper="3" velocity="1"/></joint>"""
    return out + "</robot>"


def test_rokaes_arms_have_their_shapes_left_out_and_their_own_gravity(tmp_path):
    (urdf := tmp_path / "rokae_ros2/rokae_description/urdf").mkdir(parents=True)
    (urdf / "xMatePro3.urdf.xacro").write_text(seven_joints("joint"))
    (logs := tmp_path / "Dynamic_Parameter_Identification_for_Rokae_xMate/filtering/data/excit").mkdir(parents=True)
    for k, name in enumerate(("ang", "vel", "torque")):
        np.savetxt(logs / f"excit_{name}_record.txt", k + np.linspace(0, 1, 900)[:, None] * np.ones(7))
    robot = xmate3(tmp_path)
    assert [group[0].num_samples for group in (robot.recordings, robot.heldout)] == [600, 300]
    assert robot.recordings[0].rate == pytest.approx(1000)
    assert robot.recordings[0].torque_command[0, 0] == 2.0
    model = mujoco.MjModel.from_xml_string(robot.xml)
    assert (model.nv, model.nu, model.ngeom, model.nmesh) == (7, 7, 0, 0)
    assert model.actuator_forcerange[0].tolist() == [-50.0, 50.0]

    home = tmp_path / "Dynamics_identification_Frank"
    (home / "urdf").mkdir(parents=True)
    (home / "src/config").mkdir(parents=True)
    (home / "urdf/AR5-5_07R-W4C4A2.urdf").write_text(seven_joints("joint").replace("${nameofManipulator}", "arm"))
    head = ",".join(["time", *(f"{name}{k}" for name in ("q", "dq", "ddq", "tau") for k in range(7))])
    rows = np.column_stack([0.02 * np.arange(300), np.tile(np.arange(28.0), (300, 1)) + 0.01 * np.arange(300)[:, None]])
    log = home / "src/config/dynamics_identification_data_real.csv"
    np.savetxt(log, rows, delimiter=",", header=head, comments="")
    robot = ar5(tmp_path)
    take = robot.recordings[0]
    assert [group[0].num_samples for group in (robot.recordings, robot.heldout)] == [200, 100]
    assert take.velocity is not None
    assert (take.position[0, 1], take.velocity[0, 1], take.torque_command[0, 1]) == (1.0, 8.0, 22.0)
    assert mujoco.MjModel.from_xml_string(robot.xml).opt.gravity.tolist() == [9.81, 0.0, 0.0]


def test_krangs_currents_are_torques_by_their_constants_and_gears(tmp_path):
    home = tmp_path / "manipulator_parameter_identification"
    (home / "09-URDF/7DOFArm").mkdir(parents=True)
    (home / "09-URDF/7DOFArm/singlearm.urdf").write_text(seven_joints("LJ").replace("${nameofManipulator}", "arm"))
    for part, scale in (("train", 1.0), ("test", 2.0)):
        (folder := home / f"29-ArmDataCollection/{part}Data").mkdir(parents=True)
        np.savetxt(folder / "dataTimeStamp.txt", 0.01 * np.arange(50))
        for k, name in enumerate(("Q", "DotQ_NF", "Cur")):
            np.savetxt(folder / f"data{name}.txt", scale * (k + np.linspace(0, 1, 50)[:, None] * np.ones(7)))
    robot = krang(tmp_path)
    assert robot.recordings[0].torque_command[0, [0, 2, 6]] == pytest.approx(
        2e-3 * np.array([31.4 * 596, 38 * 625, 16 * 552])
    )
    assert robot.heldout[0].position[-1, 0] == 2.0
    assert mujoco.MjModel.from_xml_string(robot.xml).opt.gravity.tolist() == [0.0, -9.81, 0.0]


def test_an_mx106_keeps_its_commands_where_a_row_has_no_reading_and_its_sines_aside(tmp_path):
    for kind in ("step", "triangle", "sine"):
        for repeat in (1, 2, 3):
            folder = tmp_path / f"Jandi_real2sim/data/raw/mode5/mode5_mx106_ID_0/no_load/{kind}/repeat_{repeat}"
            folder.mkdir(parents=True)
            lines = [f"{k / 100},{k / 10},{'' if k == 7 else k / 20}" for k in range(50)]
            (folder / "telemetry.csv").write_text("\n".join(["time_s,q_cmd_rad,q_present_rad", *lines]))
    robot = mx106(tmp_path, 0)
    assert [r.source[8:] for r in robot.recordings] == ["step_1", "step_2", "triangle_1", "triangle_2"]
    assert [r.source[8:] for r in robot.heldout] == ["step_3", "triangle_3", "sine_3"]
    take = robot.recordings[0]
    assert take.num_samples == 50
    assert take.position[7, 0] == pytest.approx(0.35)
    assert take.position_target is not None
    assert take.position_target[7, 0] == 0.7
