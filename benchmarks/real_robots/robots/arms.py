"""Arms: SO-101, AIRBOT Play, UR10(e), Kinova Gen3, KUKA LWR4+ and KR300, Franka Panda, Stäubli TX40, Rokae, Krang."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from benchmarks.real_robots.robots.robot import (
    LOOKED,
    UNSEEN,
    Robot,
    add_motors,
    arm_of,
    cells,
    delete_shapes,
    without_shapes,
)
from torchrl_athletic.recordings import Column, ColumnMap, Recording, read_recordings


def so101(data: Path) -> Robot:
    """SO-101 arm of hobby servos, position targets at 50 Hz: 48 motions, and two kept aside.

    Gains and limits are those of the arm's own MJCF, which says that they are no 1-to-1 mapping of the servos'.
    The jaw is logged from 0 to 1 of its range.
    """
    path = data / "SO-ARM100/Simulation/SO101/so101_new_calib.xml"
    xml = without_shapes(path)
    model = mujoco.MjModel.from_xml_string(xml)
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    kp, kd = (-model.actuator_biasprm[[model.actuator(n).id for n in names], k] for k in (1, 2))
    low, high = model.joint("gripper").range
    scale, shift = np.array([1.0] * 5 + [high - low]), np.array([0.0] * 5 + [low])
    folder = data / "sage/output/real/so101/custom"
    takes = {
        motion.name: Recording(
            1e-6 * cells(motion / "state_motor.csv", "timestamp")[:, 0],
            names,
            cells(motion / "state_motor.csv", "positions") * scale + shift,
            position_target=cells(motion / "control.csv", "positions") * scale + shift,
            kp=kp,
            kd=kd,
            source=motion.name,
        )
        for motion in sorted(folder.iterdir())
    }
    aside = ("backlash_detection", "friction_gravity")
    fitted = [r for name, r in takes.items() if name not in aside]
    return Robot(xml, fitted, [takes[name] for name in aside], LOOKED)


def airbot(data: Path, second: bool = False) -> Robot:
    """AIRBOT Play, six joints at 195 Hz: three takes of 25 s, and two kept aside. Torques are from motor currents.

    Args:
        data: Folder of clones.
        second: The later session: five takes and three kept aside.
    """
    home = data / "dynamics_calibration_airbot"
    xml = without_shapes(home / "models/mjcf/manipulator/airbot_play_force/_play_force.xml")
    names = tuple(f"joint{k}" for k in range(1, 7))
    first = ("ga_N12T25", "opt", "ptrnSrch_N7T25QR-7"), ("ptrnSrch_N7T25QR-5", "ptrnSrch_N7T25QR-6")
    later = (
        ("ga_N12T25(1)", "opt(1)", "ptrnSrch_N7T25QR-7(1)", "ptrnSrch_N8T25QR", "ptrnSrch_N8T25QR_maxq1"),
        ("ptrnSrch_N7T25QR-5(1)", "ptrnSrch_N7T25QR-6(1)", "ptrnSrch_N8T25QR-8"),
    )

    def take(name: str) -> Recording:
        rows = np.loadtxt(home / f"state_machine_demo/real_data/vali_{name}.csv", delimiter=",")[1:]
        time, position, velocity, torque = rows[:, 0], rows[:, 1:7], rows[:, 7:13], rows[:, 13:19]
        return Recording(time, names, position, velocity, torque_command=torque, source=name)

    fitted, aside = ([take(n) for n in group] for group in (later if second else first))
    return Robot(xml, fitted, aside, LOOKED if second else "yes")


def ur10(data: Path) -> Robot:
    """UR10, six joints at 125 Hz in closed loop: two thirds of a motion of 27.5 s, and the last third kept aside.

    A ROS 2 bag of joint states and nothing else; efforts are the motors' currents times their gains. The model is a
    URDF of the maker's numbers, without friction and rotors.
    """
    spec = arm_of((data / "openrr-apps-config-sample/urdf/ur10_robot.urdf").read_text())
    spec.compile()
    home = data / "inverse-dynamics-solver/ur10_inverse_dynamics_solver"
    (whole,) = read_recordings(home / "bagfiles/ur10_exciting_trajectory.db3", ColumnMap(measured_drives=True))
    split = 2 * whole.num_samples // 3
    return Robot(spec.to_xml(), [whole.slice(0, split)], [whole.slice(split, whole.num_samples)], UNSEEN)


def ur10e(data: Path) -> Robot:
    """UR10e, six joints at 95 Hz in closed loop: three takes of 27 to 39 s, kept aside one of 58 s and one to points.

    Torques are the motors' currents times the gains that the logs' authors publish. The model is the maker's URDF.
    """
    fitted = ("20_02_05-20sec_8harm", "20_02_06-20sec_10harm", "20_02_10-30sec_12harm")
    aside = ("identification_data/ur-20_02_12-50sec_12harm", "validation_data/ur-20_01_17-ptp_10_points")
    return _ur10e(data, [f"identification_data/ur-{name}" for name in fitted], aside, "no")


def ur10e_empty(data: Path) -> Robot:
    """The UR10e on the day on which it was loaded, but empty: a take of 56 s, and another one kept aside."""
    takes = [f"identification_data/ur-20_02_19_{harmonics}harm50sec" for harmonics in (14, 15)]
    return _ur10e(data, takes[:1], takes[1:], LOOKED)


def ur10e_loaded(data: Path, harmonics: int) -> Robot:
    """The UR10e with 2.805 kg at its flange, of which the log says nothing: the last third of the take is kept aside.

    Between the takes of 14 and of 15 harmonics the weight was turned by half a turn about the flange.
    """
    robot = _ur10e(data, [f"identification_data/ur-20_02_19_{harmonics}harm50secLoad"], (), LOOKED)
    (take,) = robot.recordings
    split = 2 * take.num_samples // 3
    parts = take.slice(0, split), take.slice(split, take.num_samples)
    return replace(robot, recordings=parts[:1], heldout=parts[1:])


def _ur10e(data: Path, fitted: Sequence[str], aside: Sequence[str], looked_at: str) -> Robot:
    home = data / "dynamic_calibration"
    spec = mujoco.MjSpec.from_file(str(home / "URe/urdf/ur10e.urdf"))
    delete_shapes(spec)
    names = tuple(joint.name for joint in spec.joints)
    add_motors(spec)
    gains = np.array([10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232])  # UR10E_parameters.txt [N·m/A]

    def take(name: str) -> Recording:
        lines = (home / f"dataset_ur10e/{name}.csv").read_text().splitlines()
        rows = np.array([line.split(",") for line in lines if line.count(",") == 30], dtype=np.float64)
        rows = rows[np.abs(rows).max(1) < 1e4]  # two files have lines of chance bytes
        rows = rows[np.diff(np.maximum.accumulate(rows[:, 0]), prepend=-np.inf) > 0]
        time, position, velocity, current = rows[:, 0], rows[:, 1:7], rows[:, 7:13], rows[:, 13:19]
        return Recording(time - time[0], names, position, velocity, torque_command=gains * current, source=name)

    spec.compile()
    return Robot(spec.to_xml(), [take(n) for n in fitted], [take(n) for n in aside], looked_at)


def gen3(data: Path) -> Robot:
    """Kinova Gen3, seven joints at 1 kHz in closed loop: a take of all for 5 s, and one of each joint alone.

    Those last 3 to 7 s. Kept aside are two other takes of all joints, for 2 s each. Torques are those that the drives
    make of their currents. The model is the maker's URDF, whose limits cut off up to 2 % of the samples of joint 2.
    """
    home = data / "dynamic-identification/pyDynaMapp"
    spec = mujoco.MjSpec.from_file(str(home / "robot/kinova/gen3.urdf"))
    spec.compiler.balanceinertia = True  # two links of the file have moments that no body has
    names = tuple(joint.name for joint in spec.joints)
    add_motors(spec)
    columns = ColumnMap(
        joint_names=names,
        file_joint_names=tuple(str(k) for k in range(1, 8)),
        time=Column("Time", unit="ms"),
        position=Column("Position{joint}"),
        torque_command=Column("TorqueCur{joint}"),
    )

    def takes(*files: str) -> list[Recording]:
        return [take for name in files for take in read_recordings(home / f"data/kinova/{name}.csv", columns)]

    spec.compile()
    alone = [f"jointwise_motion/joint_{k}_trapez" for k in range(1, 8)]
    fitted = takes("validation_data/opti_traj_testing1", *alone)
    aside = takes("validation_data/opti_traj_testing2", "identification_data/RunTrajectory1")
    return Robot(spec.to_xml(), fitted, aside, UNSEEN)


def lwr4(data: Path) -> Robot:
    """KUKA LWR4+, seven joints at 200 Hz in closed loop: one motion for 25 s, twice; another one is kept aside.

    Torques are those of the sensors in the joints, behind rotors and most of the friction, which the URDF beside the
    logs has.
    """
    home = data / "FloBaRoID"
    text = (home / "model/kuka_lwr4.urdf").read_text()
    spec = mujoco.MjSpec.from_string(re.sub(r"<origin[^>]*/>\s*(?=<origin)", "", text))  # a joint has two
    delete_shapes(spec)
    add_motors(spec)
    columns = ColumnMap(
        joint_names=tuple(joint.name for joint in spec.joints),
        time="times",
        position="positions",
        velocity="velocities",
        torque_command="torques",
    )
    files = [home / f"data/KUKA/HW/measurements_{k}.npz" for k in (1, 2, 3)]
    first, second, other = (take for file in files for take in read_recordings(file, columns))
    spec.compile()
    return Robot(spec.to_xml(), [first, second], [other], UNSEEN)


def panda(data: Path) -> Robot:
    """Franka Panda, seven joints at 1 kHz in closed loop: two thirds of a motion of 13.3 s, and the last kept aside.

    Torques are those of the sensors in the joints, behind the rotors: the Menagerie's model has none here, nor its
    round numbers of damping, and motors for its servos.
    """
    spec = mujoco.MjSpec.from_file(str(data / "mujoco_menagerie/franka_emika_panda/panda_nohand.xml"))
    for thing in (*spec.keys, *spec.actuators):
        spec.delete(thing)
    delete_shapes(spec)
    for joint, limit in zip(spec.joints, 4 * [87.0] + 3 * [12.0], strict=True):
        joint.actfrcrange = [-limit, limit]
        joint.damping[0] = joint.armature = 0.0
    add_motors(spec)
    spec.compile()
    home = data / "FrankaEmikaPandaDynModel/matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    time = np.loadtxt(home / "exciting_traj_time.txt")
    position, torque = (
        np.loadtxt(home / f"exciting_traj_{name}.txt").reshape(len(time), 7) for name in ("positions", "torques")
    )
    names = tuple(joint.name for joint in spec.joints)
    whole = Recording(time, names, position, torque_command=torque, source="panda")
    aside = whole.where((time >= 8.9) & (time < 13.3))
    return Robot(spec.to_xml(), [whole.where(time < 8.9)], [aside], UNSEEN)


def tx40(data: Path) -> Robot:
    """Stäubli TX40, six joints in closed loop: two thirds of a motion of 9 s, and the last third kept aside.

    Of its 5 kHz every fifth reading is taken, with the mean torque until the next. Torques are those of the motors,
    through their gears. The sixth motor turns the fifth joint as well. The model is the URDF beside the logs, without
    friction and rotors; its last link has no moments of inertia, and gets small ones.
    """
    home = data / "figaroh-examples/examples/staubli_TX40"
    spec = mujoco.MjSpec.from_file(str(home / "urdf/tx40_mdh_modified.urdf"))
    delete_shapes(spec)
    spec.compiler.boundinertia = 1e-4
    names = tuple(joint.name for joint in spec.joints)
    add_motors(spec)
    spec.compile()
    gear = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])  # utils/staubli_tx40_tools.py
    gear[5, 4] = gear[5, 5]
    motor, torque = (
        np.loadtxt(home / f"data/{name}.csv", delimiter=",", skiprows=1) for name in ("pos_read_data", "curr_data")
    )
    position = motor @ np.linalg.inv(gear).T + np.pi / 2 * np.array([0.0, -1.0, 1.0, 0.0, 0.0, 0.0])
    torque = torque.reshape(-1, 5, 6).mean(1) @ gear
    time = np.arange(len(torque)) / 1000
    whole = Recording(time, names, position[::5], torque_command=torque, source="tx40")
    parts = whole.where(time < 6.0), whole.where(time >= 6.0)
    return Robot(spec.to_xml(), parts[:1], parts[1:], LOOKED)


def kr300(data: Path) -> Robot:
    """KUKA KR300, six joints of an industrial robot with a payload: its authors' motion to fit, two to validate.

    Ten seconds each at 250 Hz. Torques are those of the motors, through their gears; positions are those of the motors,
    too. The model has the links and the payload of the file beside the logs, without friction, rotors, and the
    hydraulic counterbalance of its second joint. The last link has no moments of inertia there, and gets made up ones.
    """
    home = data / "Robot_Identification"
    # Denavit-Hartenberg numbers d, a [m] and alpha [rad], zero of the joint, with that of robot_dynamics.m [rad], mass
    # [kg], centre of mass [mm] and inertia about it (xx, yy, zz, xy, yz, xz) [kg·m²] in the frame behind the link
    load, flange = 200.0, 17.78
    quarter = np.pi / 2
    links = (
        (-0.675, 0.35, quarter, 0.0, 395.4, (-353, 174, -4), (16.73, 29.80, 32.81, -1.704, 0.129, 4.404)),
        (-0.189, 1.15, 0.0, -quarter, 339.12, (-709, -1, 23), (7.508, 88.887, 88.674, 0.430, 0.173, -4.397)),
        (0.189, 0.041, -quarter, 2 * quarter, 105.21, (-18, -18, -76), (10.784, 10.186, 1.943, 0.118, -0.606, -0.102)),
        (-1.0, 0.0, quarter, 0.0, 35.8, (0, 236, 1), (0.425, 0.218, 0.428, 0, -0.0114, 0)),
        (0.0, 0.0, -quarter, 0.0, 31.46, (0, -80, -9), (0.284, 0.230, 0.258, 0, -0.0195, -0.0001)),
        (
            -0.24,
            0.0,
            2 * quarter,
            0.0,
            load + flange,
            (0, 0, (load * 100 - flange * 50) / (load + flange)),
            (3, 3, 5, 0, 0, 0),
        ),
    )
    names = tuple(f"axis_{k}" for k in range(1, 7))
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.001, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    parent, at, turn = spec.worldbody, np.zeros(3), Rotation.from_rotvec([2 * quarter, 0, 0])
    for name, (d, a, alpha, zero, mass, com, inertia) in zip(names, links, strict=True):
        turned = turn * Rotation.from_rotvec([0, 0, zero])
        body = parent.add_body(name=name, pos=at, quat=turned.as_quat(scalar_first=True))
        body.add_joint(name=name, axis=[0, 0, 1])
        at, turn = np.array([a, 0.0, d]), Rotation.from_rotvec([alpha, 0, 0])
        xx, yy, zz, xy, yz, xz = inertia
        tensor = turn.as_matrix() @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.as_matrix().T
        body.explicitinertial, body.mass, body.ipos = True, mass, at + turn.apply(1e-3 * np.array(com))
        body.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        parent = body
    spec.compile()
    gear = np.array([1798 / 7, 1872 / 7, 757 / 3, 221, 5032 / 21, 206793 / 1340])

    def take(letter: str) -> Recording:
        path = home / f"data/recorded_trajectories/2020-10-21 10s FF {letter} 08ms/data.mat"
        log = loadmat(path, squeeze_me=True)["rec"]
        time, position, torque = (log[name].item().T for name in ("time_cont", "act_pos_mot_deg", "act_torque_abs_nm"))
        return Recording(time, names, np.radians(position), torque_command=gear * torque, source=f"kr300_{letter}")

    return Robot(spec.to_xml(), [take("A")], [take("B"), take("C")], UNSEEN)


def xmate3(data: Path) -> Robot:
    """Rokae xMate3 Pro, seven joints at 1 kHz in closed loop: two thirds of a motion of 20 s, and the last kept aside.

    Torques are those of the sensors in the joints. The model is the maker's, which says of itself that its inertia is
    not correct.
    """
    text = (data / "rokae_ros2/rokae_description/urdf/xMatePro3.urdf.xacro").read_text()
    spec = arm_of(text.replace("${nameofManipulator}", "xMatePro3"))
    names = tuple(joint.name for joint in spec.joints)
    home = data / "Dynamic_Parameter_Identification_for_Rokae_xMate/filtering/data/excit"
    position, velocity, torque = (np.loadtxt(home / f"excit_{name}_record.txt") for name in ("ang", "vel", "torque"))
    time = np.arange(len(position)) / 1000
    whole = Recording(time, names, position, velocity, torque_command=torque, source="xmate3")
    split = 2 * whole.num_samples // 3
    aside = whole.slice(split, whole.num_samples)
    return Robot(spec.to_xml(), [whole.slice(0, split)], [aside], UNSEEN)


def ar5(data: Path) -> Robot:
    """Rokae AR5-5, seven joints at 50 Hz in closed loop: two thirds of a motion of 60 s, and the last kept aside.

    The arm hangs at a wall. The model is the maker's URDF, as it lies beside the logs.
    """
    home = data / "Dynamics_identification_Frank"
    spec = arm_of((home / "urdf/AR5-5_07R-W4C4A2.urdf").read_text())
    spec.option.gravity = [9.81, 0.0, 0.0]
    columns = ColumnMap(
        joint_names=tuple(joint.name for joint in spec.joints),
        file_joint_names=tuple(str(k) for k in range(7)),
        time="time",
        position=Column("q{joint}"),
        velocity=Column("dq{joint}"),
        torque_command=Column("tau{joint}"),
    )
    (whole,) = read_recordings(home / "src/config/dynamics_identification_data_real.csv", columns)
    spec.compile()
    split = 2 * whole.num_samples // 3
    aside = whole.slice(split, whole.num_samples)
    return Robot(spec.to_xml(), [whole.slice(0, split)], [aside], UNSEEN)


def krang(data: Path) -> Robot:
    """An arm of seven Schunk modules (Krang), at 100 Hz in closed loop: its authors' log to train, and theirs to test.

    Torques are those of the motors' currents, by the constants and gears in their code. The arm lies on its side.
    """
    home = data / "manipulator_parameter_identification"
    spec = arm_of((home / "09-URDF/7DOFArm/singlearm.urdf").read_text())
    spec.option.gravity = [0.0, -9.81, 0.0]
    names = tuple(joint.name for joint in spec.joints)
    constant = 1e-3 * np.array([31.4, 31.4, 38.0, 38.0, 16.0, 16.0, 16.0])  # Get_phi_ArmDynamics.cpp [N·m/A]
    gear = np.array([596.0, 596.0, 625.0, 625.0, 552.0, 552.0, 552.0])

    def take(part: str) -> Recording:
        time, position, velocity, current = (
            np.loadtxt(home / f"29-ArmDataCollection/{part}Data/data{name}.txt")
            for name in ("TimeStamp", "Q", "DotQ_NF", "Cur")
        )
        torque = constant * gear * current
        return Recording(time, names, position, velocity, torque_command=torque, source=f"krang_{part}")

    spec.compile()
    return Robot(spec.to_xml(), [take("train")], [take("test")], UNSEEN)
