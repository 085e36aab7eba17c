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
``inverse-dynamics-solver`` at ``41e196d``  unisa-acg/inverse-dynamics-solver        BSD-3-Clause
``openrr-apps-config-sample`` at            OTL/openrr-apps-config-sample            Apache-2.0
``d361201`` (the UR10's URDF)
==========================================  =======================================  =======================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from benchmarks.real_robots.robots.arms import (
    airbot,
    ar5,
    gen3,
    kr300,
    krang,
    lwr4,
    panda,
    so101,
    tx40,
    ur10,
    ur10e,
    xmate3,
)
from benchmarks.real_robots.robots.benches import (
    ak80_pendulum,
    bench,
    cart_pendulum,
    damper,
    double_pendulum,
    free_pendulum,
)
from benchmarks.real_robots.robots.legs import compass_leg, unitree
from benchmarks.real_robots.robots.robot import Robot
from benchmarks.real_robots.robots.servos import go1, miuzei, mx106, sts

ROBOTS: Mapping[str, Callable[[Path], Robot]] = {
    **{n: bench(n) for n in ("pendulum", "xl330", "unbalanced_disk", "emps", "two_link_arm", "two_link_arm:measured")},
    "so101": so101,
    "airbot": airbot,
    "airbot, second session": partial(airbot, second=True),
    "ur10": ur10,
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
