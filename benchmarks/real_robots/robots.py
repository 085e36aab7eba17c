"""Public logs of real robots, read from a folder of clones that the user names, and the models to compare them with.

The folder holds clones of these repositories under their own names; none of their files is part of this one.

==========================================  =======================================  =======================
folder                                      github                                   licence
==========================================  =======================================  =======================
``sage`` at ``4ffd262``                     isaac-sim2real/sage                      Apache-2.0
``SO-ARM100`` (the arm's MJCF)              TheRobotStudio/SO-ARM100                 Apache-2.0
``dynamics_calibration_airbot``             Zeyu1-oss/dynamics_calibration_airbot    none stated
``dynamic_calibration`` at ``11af40e``      shamilmamedov/dynamic_calibration        none stated
``bam``                                     rimim/bam                                none stated
``Dataset-Friction-Damper-with-Backlash``   ARTS-Laboratory/...                      CC BY-SA 4.0
``double_pendulum`` at ``1e8544e``          dfki-ric-underactuated-lab/...           BSD-3-Clause
``sysid`` at ``d66b22c``                    kscalelabs/sysid                         none stated
``servo-sysid`` at ``e4a4840``              mauicv/servo-sysid                       none stated
``sim2real-robot-identification``           RX-00/sim2real-robot-identification      BSD-3-Clause
at ``1a22bd0``
``dynamic-identification`` at ``3b3baef``   wissem01chiha/dynamic-identification     MIT
``FloBaRoID`` at ``9c06804``, with its      kjyv/FloBaRoID                           LGPL-3.0
files of Git LFS
``torque_limited_simple_pendulum``          dfki-ric-underactuated-lab/...           BSD-3-Clause
at ``ed17ea2``
``FrankaEmikaPandaDynModel``                marcocognetti/FrankaEmikaPandaDynModel   GPL-3.0
at ``24d85ce``
``mujoco_menagerie`` at ``b4d7d13``         google-deepmind/mujoco_menagerie         Apache-2.0
``figaroh-examples`` at ``c0b5c7f``         thanhndv212/figaroh-examples             Apache-2.0
``MultiArm-Pendulum`` at ``e99a7e1``        dynamicslab/MultiArm-Pendulum            MIT
``Robot_Identification`` at ``9e403c0``      JonasWeigand/Robot_Identification        MIT
``manipulator_parameter_identification``    zubair-irshad/...                        none stated
at ``c84fded``
``Dynamics_identification_Frank`` at        FrankJIE09/...                           none stated
``758dc8d``
``Dynamic_Parameter_Identification_for_``   YanjunLIU-ac/...                         none stated
``Rokae_xMate`` at ``d5855f4``
``rokae_ros2`` at ``d6a508c``               RokaeRobot/rokae_ros2                    Apache-2.0
``Jandi_real2sim`` at ``86cccc9``           RnD-king/Jandi_real2sim                  none stated
``SydneyCompassGait`` at ``92546f6``        imanchester/SydneyCompassGait            MIT
``masterThesisMatlab`` at ``0e2c725``       nielsSkov/masterThesisMatlab             none stated
==========================================  =======================================  =======================
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from torchrl_athletic.recordings import Column, ColumnMap, Recording, read_recordings
from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots.benches import two_link_arm

Array = NDArray[np.float64]

_EMPTY: Any = np.zeros(0)
_ARRAYS: Any = [
    *((_EMPTY.__reduce__()[0], f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")),
    *(np.ndarray, np.dtype, np.dtypes.Float32DType, np.dtypes.Float64DType),
]
"""What a file of tensors may hold beside them: arrays of NumPy 1 and 2."""
LOOKED = "yes, held-out part too"
"""Of :attr:`Robot.looked_at`, where no part was left unseen."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A model and its recordings."""

    xml: str
    recordings: Sequence[Recording]
    heldout: Sequence[Recording]
    looked_at: str
    """Whether the program was changed while looking at it."""
    unit: str = "rad"
    model_of: Callable[[Recording], mujoco.MjModel] | None = None
    """Model with what a recording carried; None where all are of :attr:`xml`."""


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
            1e-6 * _cells(motion / "state_motor.csv", "timestamp")[:, 0],
            names,
            _cells(motion / "state_motor.csv", "positions") * scale + shift,
            position_target=_cells(motion / "control.csv", "positions") * scale + shift,
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
    _delete_shapes(spec)
    names = tuple(joint.name for joint in spec.joints)
    _add_motors(spec)
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


def unitree(data: Path, robot: str) -> Robot:
    """A Go2 held in the air, an Aliengo or a Z1 with its gripper, position targets at 200 Hz, gains as logged.

    One sweep of all joints between two poses, in periods from 3 to 0.4 s. Of the Go2 eight takes are fitted and two are
    kept aside, as the logs' authors do; the others have one take, whose last third, the fastest, is kept aside. The
    models are the maker's: what the authors fitted, friction, damping and rotors, is taken out again.
    """
    home = data / "sim2real-robot-identification"
    spec = mujoco.MjSpec.from_file(str(home / f"robot_model/{robot}/{robot}.xml"))
    _delete_shapes(spec)
    for key in spec.keys:
        spec.delete(key)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
        else:
            joint.frictionloss, joint.damping, joint.armature = 0.0, np.zeros_like(joint.damping), 0.0
    names = tuple(joint.name for joint in spec.joints)

    def take(path: Path) -> Recording:
        with torch.serialization.safe_globals(_ARRAYS):
            content = torch.load(path, weights_only=True)
        logged = {name: np.asarray(column, dtype=np.float64) for name, column in content.items()}
        return Recording(
            logged["time"],
            names,
            logged["dof_pos"],
            velocity=logged["dof_vel"],
            position_target=logged["des_dof_pos"],
            kp=logged["kp"],
            kd=logged["kd"],
            source=f"{robot}/{path.stem}",
        )

    takes = [take(path) for path in sorted((home / f"datasets/{robot}").glob("traj_*.pt"))]
    if len(takes) > 1:
        return Robot(spec.to_xml(), takes[:-2], takes[-2:], "no")
    [whole] = takes
    third = 2 * whole.num_samples // 3
    looked = "not before its first fit" if robot == "z1" else "no"
    return Robot(spec.to_xml(), [whole.slice(0, third)], [whole.slice(third, whole.num_samples)], looked)


def gen3(data: Path) -> Robot:
    """Kinova Gen3, seven joints at 1 kHz in closed loop: a take of all for 5 s, and one of each joint alone.

    Those last 3 to 7 s. Kept aside are two other takes of all joints, for 2 s each. Torques are those that the drives
    make of their currents. The model is the maker's URDF, whose limits cut off up to 2 % of the samples of joint 2.
    """
    home = data / "dynamic-identification/pyDynaMapp"
    spec = mujoco.MjSpec.from_file(str(home / "robot/kinova/gen3.urdf"))
    spec.compiler.balanceinertia = True  # two links of the file have moments that no body has
    names = tuple(joint.name for joint in spec.joints)
    _add_motors(spec)
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
    return Robot(spec.to_xml(), fitted, aside, "not before its first fit")


def lwr4(data: Path) -> Robot:
    """KUKA LWR4+, seven joints at 200 Hz in closed loop: one motion for 25 s, twice; another one is kept aside.

    Torques are those of the sensors in the joints, behind rotors and most of the friction, which the URDF beside the
    logs has.
    """
    home = data / "FloBaRoID"
    text = (home / "model/kuka_lwr4.urdf").read_text()
    spec = mujoco.MjSpec.from_string(re.sub(r"<origin[^>]*/>\s*(?=<origin)", "", text))  # a joint has two
    _delete_shapes(spec)
    _add_motors(spec)
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
    return Robot(spec.to_xml(), [first, second], [other], "not before its first fit")


def go1(data: Path) -> Robot:
    """Motor of a Go1 with an arm of 0.15 m and 0, 1, 2 or 3 kg at its end; 2 kg kept aside. 62 Hz.

    The logged speed is a seventh of the position's slope, and is left out.
    """
    paths = sorted((data / "bam/example_data/data_raw_go1").glob("*.json"))
    takes = [take for path in paths for take in _servo_takes(path)]
    return _loaded_pendulum(
        takes, arm_mass=0.078, length=0.15, kp=10.0, kv=0.3, limit=23.7, aside=2.0, looked_at=LOOKED
    )


def sts(data: Path, motor: str) -> Robot:
    """A hobby servo, STS3215 or the stronger STS3250, that swings 0.5 to 1.2 kg on 150 mm: 100 Hz, 120 logs of 6 s.

    Six firmware gains and five motions, the first of four repetitions each; 0.97 kg kept aside. A unit of the gain is
    turned into N m/rad by the duty per error, the resistance and the torque constant of the authors' configurations,
    at 12 V; the damping by the same constants is left out. Torques at a standstill are those on the servos' data
    sheets, 30 and 50 kg cm. Lost readings of -180 degrees, in one log of six, are bridged for all who fit alike.
    """
    folder, duty, resistance, stall = {
        "STS3215": ("STS_3215_12V_20250317", 0.16489, 1.0, 2.94),
        "STS3250": ("STS_3250", 0.16383, 1.2, 4.90),
    }[motor]
    stiffness = duty * 12.0 * 1.0787 / resistance
    first: dict[tuple[Any, ...], Path] = {}
    for path in sorted((data / "sysid/data/feetech" / folder / "raw").glob("*.json")):
        log = json.loads(path.read_text())
        if log["length"] == 0.15:
            first.setdefault((log["mass"], log["kp"], log["trajectory"]), path)
    takes = [take for path in first.values() for take in _servo_takes(path, stiffness)]
    return _loaded_pendulum(takes, 0.05, 0.15, 16 * stiffness, 0.0, stall, aside=0.969, looked_at="no")


def compass_leg(data: Path) -> Robot:
    """The inner leg of a compass gait walker that swings about its hip, at 200 Hz: 28 s fitted, the last 50 s aside.

    First a free swing and steps of the motor's voltage, last steps and a chirp. The torque is that of the voltage by
    the data sheet, the link that of its authors, without friction.
    """
    xml = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
      <joint name="hip" axis="0 1 0"/>
      <inertial pos="0 0 -0.0448" mass="0.7" diaginertia="0.002919 0.002919 0.002919"/></body></worldbody>
      <actuator><motor joint="hip" ctrlrange="-0.2 0.2"/></actuator></mujoco>"""
    home = data / "SydneyCompassGait/System Identification/SysID_Experiment 1"
    log = loadmat(home / "realVSmodel_fwAnd5vstepsx3AndChirp_innerSW.mat")
    time, angle, volt = (np.asarray(log[f"data{name}all"], dtype=np.float64).ravel() for name in ("time", "out", "in"))
    torque = 0.0182 * volt  # N m per volt
    whole = Recording(time, ("hip",), np.radians(angle)[:, None], torque_command=torque[:, None], source="compass leg")
    return Robot(xml, [whole.where(time < 28.0)], [whole.where(time >= 28.0)], "not before its first fit")


def miuzei(data: Path) -> Robot:
    """A Miuzei hobby servo with a weight on an arm, position targets at 50 Hz: 1 to 3 s each, shorter takes left out.

    Of the distinct motions every fourth is kept aside with all its repetitions. Gains and limit are those of the
    authors' MJCF, without its filter of 0.1 s. Angles are logged in half turns.
    """
    home = data / "servo-sysid/src/sysid"
    spec = mujoco.MjSpec.from_string(without_shapes(home / "desc/robot.xml"))
    spec.delete(spec.actuators[0])
    servo = spec.add_actuator(name="servo", target="servo", trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=(-2.7, 2.7))
    servo.set_to_position(kp=25.0, kv=5.0)
    spec.compile()
    motions: dict[tuple[float, ...], list[Recording]] = {}
    for k, row in enumerate(json.loads((home / "dataset/response.json").read_text())["data"]):
        if len(row["actions"]) >= 50:
            target, angle = (
                np.pi * np.array(row[name], dtype=np.float64)[:, None] for name in ("actions", "sensor_data")
            )
            take = Recording(
                0.02 * np.arange(len(angle), dtype=np.float64), ("servo",), angle, position_target=target,
                kp=np.array([25.0]), kd=np.array([5.0]), source=f"{k}_{row['type']}",
            )  # fmt: skip
            motions.setdefault(tuple(row["actions"]), []).append(take)
    groups: tuple[list[Recording], list[Recording]] = ([], [])
    for k, takes in enumerate(motions.values()):
        groups[k % 4 == 3].extend(takes)
    return Robot(spec.to_xml(), *groups, LOOKED)


def _servo_takes(path: Path, stiffness: float = 1.0) -> list[Recording]:
    """A log of bam's format, parted where the motor is let go.

    Args:
        path: Of a log.
        stiffness: Of one unit of its gain [N m/rad].
    """
    log = json.loads(path.read_text())
    rows: list[Mapping[str, Any]] = log["entries"]
    on = np.array([row["torque_enable"] for row in rows])
    takes = []
    for driven in (True, False):
        part = [row for row, o in zip(rows, on, strict=True) if o == driven]
        if len(part) < 100:
            continue
        time, position, target = (
            np.array([float(row[k]) for row in part]) for k in ("timestamp", "position", "goal_position")
        )
        lost = np.abs(np.abs(position) - np.pi) < 0.002  # a reading of nothing, where the arm cannot be
        recording = Recording(
            time, ("motor",), np.interp(time, time[~lost], position[~lost])[:, None], position_target=target[:, None],
            kp=np.array([log["kp"] * stiffness * driven]), kd=np.array([log.get("damping", 0.0) * driven]),
            metadata={"payload_kg": log["mass"]}, source=f"{path.stem}_{'driven' if driven else 'released'}",
        )  # fmt: skip
        takes.append(recording)
    return takes


def _loaded_pendulum(
    takes: Sequence[Recording],
    arm_mass: float,
    length: float,
    kp: float,
    kv: float,
    limit: float,
    *,
    aside: float,
    looked_at: str,
) -> Robot:
    """A motor that swings an arm with a payload at its end, of which one is kept aside.

    Args:
        takes: What was recorded.
        arm_mass: Of the arm alone [kg].
        length: Of the arm [m].
        kp: Of recordings that have no gain [N m/rad].
        kv: As well [N m s/rad].
        limit: Of the torque [N m].
        aside: Payload [kg].
        looked_at: As of :class:`Robot`.
    """

    def pendulum(payload: float) -> str:
        """The payload is a body of its own, so that what a fit says of the arm's mass is said of the arm."""
        about = arm_mass / 12 * length**2
        end = f'<body pos="0 0 {-length}"><inertial pos="0 0 0" mass="{payload}" diaginertia="1e-9 1e-9 1e-9"/></body>'
        return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
          <joint name="motor" axis="0 1 0"/><site name="end" pos="0 0 {-length}"/>
          <inertial pos="0 0 {-length / 2}" mass="{arm_mass}" diaginertia="{about} {about} {0.01 * about}"/>
          {end if payload else ""}</body></worldbody>
          <actuator><position joint="motor" kp="{kp}" kv="{kv}" forcerange="-{limit} {limit}"/></actuator></mujoco>"""

    def model_of(recording: Recording) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(pendulum(float(recording.metadata["payload_kg"])))

    fitted, held = ([t for t in takes if (t.metadata["payload_kg"] == aside) == out] for out in (False, True))
    return Robot(pendulum(0.0), fitted, held, looked_at, model_of=model_of)


def damper(data: Path, tension: int) -> Robot:
    """A banded rotary friction damper, whose displacement was prescribed and force measured; 1.5 inches kept aside.

    A force that is all friction says nothing of where the damper goes. So the log is put on a bench that is known: a
    spring and a viscous damper beside the joint, whose forces for the measured motion are added to the measured one.

    Args:
        data: Folder of clones.
        tension: Of the band [lb]: 0, 30 or 36.
    """
    inch, kip = 0.0254, 4448.22
    spring, viscous, mass = 2e6, 2e4, 100.0
    xml = f"""<mujoco><option timestep="0.001" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
      <joint name="damper" type="slide" axis="1 0 0" stiffness="{spring}" damping="{viscous}"/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/></body></worldbody>
      <actuator><motor joint="damper" ctrlrange="-1e6 1e6"/></actuator></mujoco>"""
    folder = data / "Dataset-Friction-Damper-with-Backlash/data/dataset-2/characterization datasets"

    def take(frequency: str, amplitude: str) -> Recording:
        path = folder / f"{frequency}Hz{tension}lbtension{amplitude}amplitude.json"
        rows = np.array(json.loads(path.read_text())["data"])
        position = inch * rows[:, 1]
        step = float(np.median(np.diff(rows[:, 0])))
        v, a = (np.asarray(savgol_filter(position, 21, 3, deriv=k, delta=step)) for k in (1, 2))
        force = np.asarray(kip * rows[:, 2] + spring * position + viscous * v + mass * a, dtype=np.float64)
        time = np.arange(len(rows), dtype=np.float64) * step
        return Recording(time, ("damper",), position[:, None], torque_command=force[:, None], source=path.stem)

    slow = () if tension == 0 else ("0.25",)  # by its authors the band of that take was not as it says
    return Robot(
        xml,
        [take(f, "1") for f in (*slow, "0.5", "1")],
        [take(f, "1.5") for f in ("0.25", "0.5", "1")],
        "no",
        unit="m",
    )


def bench(name: str) -> Callable[[Path], Robot]:
    """One of the five benches of :func:`load_dataset`."""

    def load(data: Path) -> Robot:
        dataset, _, drive = name.partition(":")
        d = load_dataset(dataset)
        fitted, aside = (
            [r.driven_by_measured_torque() if drive else r for r in group] for group in (d.recordings, d.heldout)
        )
        return Robot(d.model, fitted, aside, LOOKED, "m" if dataset == "emps" else "rad")

    return load


def double_pendulum(data: Path, design: str) -> Robot:
    """A double pendulum of the two-link arm's laboratory, with other links, on other days: design C.0 or C.1.

    The published links alone are given. The first six takes with a sine on the motors are fitted; kept aside are the
    others and the two in which a controller swings the arm up. Takes 7 to 11 of C.0, and five more of C.1, were missing
    in the copy that we had.
    """
    home = data / "double_pendulum/data/experiment_records"
    if design == "C.0":  # links of model_h1.0: those of model_3.1 have less inertia than their centre of mass asks for
        mass, inertia = (0.5476215952387185, 0.5978621372377623), (0.024210710672023246, 0.053450262258304355)
        com = (0.2, 0.275)
        paths = [home / f"design_C.0/20220914/sys_id/trajectory_{k:02d}.csv" for k in (0, 1, 2, 3, 4, 5, 6, 12, 13)]
    else:  # links of model_1.1
        mass, inertia = (0.5234602302310271, 0.6255677234174437), (0.031887199591513114, 0.05086984812807257)
        com = (0.2, 0.25569305436052964)
        hours = ("143339", "143524", "143601", "143704", "143747", "143906", "144003", "144115", "154220", "154548")
        paths = [home / f"design_C.1/sys_id/20230629/20230629-{k}/trajectory.csv" for k in hours]
    xml = two_link_arm(mass=mass, inertia=inertia, com=com, length=(0.2, 0.3))

    def take(path: Path) -> Recording:
        column = np.genfromtxt(path, delimiter=",", names=True)
        position, velocity, torque = (
            np.stack([column[f"{name}{k}"] for k in (1, 2)], -1) for name in ("pos_meas", "vel_meas", "tau_con")
        )
        source = f"{path.parent.name}_{path.name}"
        return Recording(
            column["time"], ("shoulder", "elbow"), position, velocity, torque_command=torque, source=source
        )

    takes = [take(path) for path in paths]
    return Robot(xml, takes[:6], takes[6:], LOOKED)


def panda(data: Path) -> Robot:
    """Franka Panda, seven joints at 1 kHz in closed loop: two thirds of a motion of 13.3 s, and the last kept aside.

    Torques are those of the sensors in the joints, behind the rotors: the Menagerie's model has none here, nor its
    round numbers of damping, and motors for its servos.
    """
    spec = mujoco.MjSpec.from_file(str(data / "mujoco_menagerie/franka_emika_panda/panda_nohand.xml"))
    for thing in (*spec.keys, *spec.actuators):
        spec.delete(thing)
    _delete_shapes(spec)
    for joint, limit in zip(spec.joints, 4 * [87.0] + 3 * [12.0], strict=True):
        joint.actfrcrange = [-limit, limit]
        joint.damping[0] = joint.armature = 0.0
    _add_motors(spec)
    spec.compile()
    home = data / "FrankaEmikaPandaDynModel/matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    time = np.loadtxt(home / "exciting_traj_time.txt")
    position, torque = (
        np.loadtxt(home / f"exciting_traj_{name}.txt").reshape(len(time), 7) for name in ("positions", "torques")
    )
    names = tuple(joint.name for joint in spec.joints)
    whole = Recording(time, names, position, torque_command=torque, source="panda")
    aside = whole.where((time >= 8.9) & (time < 13.3))
    return Robot(spec.to_xml(), [whole.where(time < 8.9)], [aside], "not before its first fit")


def tx40(data: Path) -> Robot:
    """Stäubli TX40, six joints in closed loop: two thirds of a motion of 9 s, and the last third kept aside.

    Of its 5 kHz every fifth reading is taken, with the mean torque until the next. Torques are those of the motors,
    through their gears. The sixth motor turns the fifth joint as well. The model is the URDF beside the logs, without
    friction and rotors; its last link has no moments of inertia, and gets small ones.
    """
    home = data / "figaroh-examples/examples/staubli_TX40"
    spec = mujoco.MjSpec.from_file(str(home / "urdf/tx40_mdh_modified.urdf"))
    _delete_shapes(spec)
    spec.compiler.boundinertia = 1e-4
    names = tuple(joint.name for joint in spec.joints)
    _add_motors(spec)
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


def ak80_pendulum(data: Path) -> Robot:
    """A pendulum on an AK80-6 drive, swung up by five controllers: three of them fitted for 64 s, two kept aside.

    Torques are those that the drive makes of its currents. Of the two long logs that are fitted they explain little
    after the swing-up, where a hand may have pushed. The link is that of the URDF beside the logs, but for 20 mm by
    which its centre of mass is off its axis. Left out are two logs whose torques are noise of up to 18 N·m, one that a
    hand moved and one with another weight.
    """
    home = data / "torque_limited_simple_pendulum"
    xml = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
      <joint name="pendulum" axis="0 1 0"/>
      <inertial pos="0 0 -0.4338" mass="0.67531" diaginertia="0.0033 0.0033 0.0007"/></body></worldbody>
      <actuator><motor joint="pendulum" ctrlrange="-12 12"/></actuator></mujoco>"""
    columns = ColumnMap(
        joint_names=("pendulum",), time="time", position="position", velocity="velocity", torque_command="torque"
    )

    def takes(*methods: str) -> list[Recording]:
        paths = [home / f"results/control_method_{method}/data_measured.csv" for method in methods]
        return [take for path in paths for take in read_recordings(path, columns)]

    fitted = takes("energy_shaping", "sac", "direct_collocation")
    aside = takes("ddp", "ilqr")
    return Robot(xml, fitted, aside, "not before its first fit")


def cart_pendulum(data: Path) -> Robot:
    """A cart on a belt that swings up a pendulum without a motor, at 150 Hz: four takes of 28 to 47 s; three aside.

    Masses and lengths are those of its thesis, without friction; the force is that of the motor's current.
    """
    xml = """<mujoco><option timestep="0.001" gravity="0 0 -9.82" integrator="implicitfast"/><worldbody><body>
      <joint name="cart" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="6.28" diaginertia="1 1 1"/>
      <body><joint name="pendulum" axis="0 -1 0"/>
      <inertial pos="0 0 0.31692" mass="0.2235" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
      <actuator><motor joint="cart" ctrlrange="-45 45"/><motor joint="pendulum" ctrlrange="-1 1"/></actuator>
      </mujoco>"""
    force_per_current = 0.0934 / 0.028  # torque constant over the pulley's radius

    def take(name: str) -> Recording:
        column = np.loadtxt(data / f"masterThesisMatlab/testResults/data/{name}.csv", delimiter=",", skiprows=2).T
        force = force_per_current * column[11]
        torque = np.stack([force, np.zeros_like(force)], -1)
        position = np.stack([column[4], column[1]], -1)
        return Recording(column[0], ("cart", "pendulum"), position, torque_command=torque, source=name)

    fitted = [take(f"swingUp/{name}") for name in ("swing1", "swing1_p005")]
    fitted += [take(f"swingUpAndCatch/{name}") for name in ("swNsl1", "swNsl3")]
    aside = [take(f"swingUp/{name}") for name in ("swing1_p006", "swing1_p007")]
    return Robot(xml, fitted, [*aside, take("swingUpAndCatch/swNsl4")], "not before its first fit")


def free_pendulum(data: Path, links: Literal["double", "triple"]) -> Robot:
    """Two or three links that swing without a motor, at 1 kHz: their authors' own pieces to fit, and to validate.

    The links are those that the authors began from, without friction: masses are off by up to two times, inertias by
    twelve. What is kept aside follows what is fitted, and swings less.
    """
    mass, com, length, inertia = {
        "double": ((0.135, 0.135), (0.0939, 0.1270), (0.1727, 0.0), (0.0017, 0.0026)),
        "triple": ((0.135, 0.135, 0.1), (0.0939, 0.1270, 0.12), (0.1727, 0.2286, 0.0), (0.0017, 0.0026, 0.002)),
    }[links]
    names = ("first", "second", "third")[: len(mass)]
    body = ""
    for name, m, a, i, reach in reversed([*zip(names, mass, com, inertia, (0.0, *length), strict=False)]):
        body = f"""<body pos="0 0 -{reach}"><joint name="{name}" axis="0 1 0"/>
          <inertial pos="0 0 -{a}" mass="{m}" diaginertia="{i} {i} {i}"/>{body}</body>"""
    motors = "".join(f'<motor joint="{name}" ctrlrange="-1 1"/>' for name in names)
    xml = f"""<mujoco><option timestep="0.001" gravity="0 0 -9.808" integrator="implicitfast"/>
      <worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"""
    home = data / f"MultiArm-Pendulum/ParameterEstimation/{links.title()}Pendulum"
    log = loadmat(home / f"{links.title()}PendulumDataForParameterEstimation.mat")

    def take(part: str) -> Recording:
        time = np.concatenate([piece.ravel() for piece in log[f"Time_{part}"].ravel()])
        absolute = np.hstack([piece[: len(names)] for piece in log[f"Y_{part}"].ravel()]).T - np.pi
        relative = np.diff(absolute, axis=1, prepend=0.0)
        return Recording(time, names, relative, torque_command=np.zeros_like(relative), source=f"{links}_{part}")

    return Robot(xml, [take("id")], [take("vad")], "not before its first fit")


def kr300(data: Path) -> Robot:
    """KUKA KR300, six joints of an industrial robot with a payload: its authors' motion to fit, two to validate.

    Ten seconds each at 250 Hz. Torques are those of the motors, through their gears; positions are those of the motors,
    too. The model has the links and the payload of the file beside the logs, without friction, rotors, and the
    hydraulic counterbalance of its second joint. The last link has no moments of inertia there, and gets some.
    """
    home = data / "Robot_Identification"
    # Denavit-Hartenberg numbers d, a [m] and alpha [rad], the joint's zero [rad], mass [kg], centre of mass [mm] and
    # inertia about it (xx, yy, zz, xy, yz, xz) [kg·cm²] in the frame behind the link
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

    return Robot(spec.to_xml(), [take("A")], [take("B"), take("C")], "not before its first fit")


def xmate3(data: Path) -> Robot:
    """Rokae xMate3 Pro, seven joints at 1 kHz in closed loop: two thirds of a motion of 20 s, and the last kept aside.

    Torques are those of the sensors in the joints. The model is the maker's, which says of itself that its inertia is
    not correct.
    """
    text = (data / "rokae_ros2/rokae_description/urdf/xMatePro3.urdf.xacro").read_text()
    spec = _arm_of(text.replace("${nameofManipulator}", "xMatePro3"))
    names = tuple(joint.name for joint in spec.joints)
    home = data / "Dynamic_Parameter_Identification_for_Rokae_xMate/filtering/data/excit"
    position, velocity, torque = (np.loadtxt(home / f"excit_{name}_record.txt") for name in ("ang", "vel", "torque"))
    time = np.arange(len(position)) / 1000
    whole = Recording(time, names, position, velocity, torque_command=torque, source="xmate3")
    split = 2 * whole.num_samples // 3
    aside = whole.slice(split, whole.num_samples)
    return Robot(spec.to_xml(), [whole.slice(0, split)], [aside], "not before its first fit")


def ar5(data: Path) -> Robot:
    """Rokae AR5-5, seven joints at 50 Hz in closed loop: two thirds of a motion of 60 s, and the last kept aside.

    The arm hangs at a wall. The model is the maker's URDF, as it lies beside the logs.
    """
    home = data / "Dynamics_identification_Frank"
    spec = _arm_of((home / "urdf/AR5-5_07R-W4C4A2.urdf").read_text())
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
    return Robot(spec.to_xml(), [whole.slice(0, split)], [aside], "not before its first fit")


def krang(data: Path) -> Robot:
    """An arm of seven Schunk modules (Krang), at 100 Hz in closed loop: its authors' log to train, and theirs to test.

    Torques are those of the motors' currents, by the constants and gears in their code. The arm lies on its side.
    """
    home = data / "manipulator_parameter_identification"
    spec = _arm_of((home / "09-URDF/7DOFArm/singlearm.urdf").read_text())
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
    return Robot(spec.to_xml(), [take("train")], [take("test")], "not before its first fit")


def mx106(data: Path, motor: int) -> Robot:
    """Dynamixel MX-106 with a bare horn, steps and triangles at 100 Hz; sines and the third repeat are kept aside.

    Gains and limit are those that its owners fitted for their humanoid, without their friction, delay and backlash. The
    model has no rotor: a horn of 15 g is all that moves.
    """
    xml = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
      <joint name="horn" axis="0 0 1"/><inertial pos="0 0 0" mass="0.015" diaginertia="2e-6 2e-6 2e-6"/>
      </body></worldbody><actuator><motor joint="horn" ctrlrange="-5.5 5.5"/></actuator></mujoco>"""
    home = data / f"Jandi_real2sim/data/raw/mode5/mode5_mx106_ID_{motor}/no_load"

    def take(kind: str, repeat: int) -> Recording:
        rows = np.genfromtxt(home / f"{kind}/repeat_{repeat}/telemetry.csv", delimiter=",", names=True)
        rows = rows[np.isfinite(rows["q_present_rad"])]
        position, target = (rows[name][:, None] for name in ("q_present_rad", "q_cmd_rad"))
        source = f"mx106_{motor}_{kind}_{repeat}"
        return Recording(
            rows["time_s"],
            ("horn",),
            position,
            position_target=target,
            kp=np.array([6.0]),
            kd=np.array([0.6]),
            source=source,
        )

    fitted = [take(kind, repeat) for kind in ("step", "triangle") for repeat in (1, 2)]
    return Robot(xml, fitted, [take(kind, 3) for kind in ("step", "triangle", "sine")], "not before its first fit")


ROBOTS: Mapping[str, Callable[[Path], Robot]] = {
    **{n: bench(n) for n in ("pendulum", "xl330", "unbalanced_disk", "emps", "two_link_arm", "two_link_arm:measured")},
    "so101": so101,
    "airbot": airbot,
    "airbot, second session": partial(airbot, second=True),
    "ur10e": ur10e,
    **{robot: partial(unitree, robot=robot) for robot in ("go2", "aliengo", "z1")},
    "gen3": gen3,
    "lwr4": lwr4,
    "go1": go1,
    **{motor.lower(): partial(sts, motor=motor) for motor in ("STS3215", "STS3250")},
    "miuzei": miuzei,
    **{f"damper, {tension} lb": partial(damper, tension=tension) for tension in (0, 30, 36)},
    "panda": panda,
    "tx40": tx40,
    "compass leg": compass_leg,
    "ak80": ak80_pendulum,
    "cart pendulum": cart_pendulum,
    "kr300": kr300,
    "xmate3": xmate3,
    "ar5": ar5,
    "krang": krang,
    **{f"mx106, motor {motor}": partial(mx106, motor=motor) for motor in (0, 2, 99)},
    **{f"free {links} pendulum": partial(free_pendulum, links=links) for links in ("double", "triple")},
    **{f"double pendulum {design}": partial(double_pendulum, design=design) for design in ("C.0", "C.1")},
}


def without_shapes(path: Path) -> str:
    """MJCF of a model with the masses that its shapes gave it, and without the shapes."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    for body in spec.bodies[1:]:
        k = model.body(body.name).id
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = model.body_mass[k], model.body_ipos[k], model.body_iquat[k]
        body.inertia, body.fullinertia = model.body_inertia[k], np.full(6, np.nan)
    _delete_shapes(spec)
    spec.compile()
    return str(spec.to_xml())


def _arm_of(urdf: str) -> mujoco.MjSpec:
    """A URDF's links with a motor at each joint, without its shapes."""
    plain = re.sub(
        r"<(visual|collision)>.*?</\1>|<xacro:[^>]*/>|<transmission .*?</transmission>", "", urdf, flags=re.S
    )
    spec = mujoco.MjSpec.from_string(plain.strip())
    _add_motors(spec)
    spec.compile()
    return spec


def _add_motors(spec: mujoco.MjSpec) -> None:
    """A motor for each joint of a URDF, which gives what the joint allows."""
    for joint in spec.joints:
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.forcelimited, motor.forcerange = True, joint.actfrcrange


def _delete_shapes(spec: mujoco.MjSpec) -> None:
    for shape in (*spec.geoms, *spec.meshes, *spec.materials, *spec.textures):
        spec.delete(shape)


def _cells(path: Path, column: str) -> Array:
    """A column whose cells are numbers or lists of numbers. Shape (T, ...)."""
    with path.open() as file:
        return np.array([np.atleast_1d(json.loads(row[column])) for row in csv.DictReader(file)], dtype=np.float64)
