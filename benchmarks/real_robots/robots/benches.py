"""Benches of laboratories: the five of the package, a damper, pendulums and a cart."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.io import loadmat
from scipy.signal import savgol_filter

from benchmarks.real_robots.robots.robot import (
    LOOKED,
    UNSEEN,
    Robot,
)
from torchrl_athletic.recordings import ColumnMap, Recording, read_recordings
from torchrl_athletic.recordings.datasets import load_dataset
from torchrl_athletic.robots.benches import two_link_arm


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
    return Robot(xml, fitted, aside, UNSEEN)


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
    return Robot(xml, fitted, [*aside, take("swingUpAndCatch/swNsl4")], UNSEEN)


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

    return Robot(xml, [take("id")], [take("vad")], UNSEEN)
