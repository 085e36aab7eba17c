"""Five small test benches whose recordings are public, as MJCF built from their published geometry.

Each function returns MJCF text: feed it to ``mujoco.MjModel.from_xml_string``. A joint has one ``motor`` of gear 1 with
the limit of the real drive, so that ``ctrl`` is the joint torque [N·m] or, on the slider, the force [N].
"""

from __future__ import annotations

import numpy as np

GRAVITY = 9.81
"""[m/s²]"""


def slider(
    *,
    mass: float = 95.1089,
    damping: float = 203.5034,
    frictionloss: float = 20.3935,
    offset: float = -3.1648,
    force_limit: float = 351.5065,
    timestep: float = 0.001,
) -> str:
    """Electro-mechanical positioning system: a carriage on a ball screw, joint ``carriage`` [m].

    Defaults are the least-squares estimate of the benchmark's authors, M a + Fv v + Fc sign(v) + offset = force.
    MuJoCo has no constant joint force, so the offset is drawn as what would cause it: a rail that leans by
    offset / (M g), 0.19 degrees.

    Args:
        mass: Motor, screw and carriage seen at the carriage, M [kg].
        damping: Viscous friction Fv [N·s/m].
        frictionloss: Coulomb friction Fc [N].
        offset: Constant force that opposes motion in the positive direction [N].
        force_limit: 10 V of the amplifier times 35.15 N/V [N].
        timestep: Of the simulation [s].

    Source:
        Janot, Gautier, Brunot 2019, Data set and reference models of EMPS, https://www.nonlinearbenchmark.org.

    Example:
        >>> import mujoco
        >>> mujoco.MjModel.from_xml_string(slider()).joint("carriage").damping.tolist()
        [203.5034]
    """
    return f"""
<mujoco model="emps_slider">
  {_option(timestep, gravity=f"{-offset / mass:.12g} 0 {-GRAVITY}")}
  <worldbody>
    <geom type="box" size="0.4 0.06 0.01" pos="0.125 0 -0.06" rgba="0.4 0.4 0.45 1"/>
    <body name="carriage">
      <joint name="carriage" type="slide" axis="1 0 0" damping="{damping}" frictionloss="{frictionloss}"
             {_stiff_friction(timestep)}/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/>
      <geom type="box" size="0.06 0.06 0.04" rgba="0.2 0.4 0.7 1"/>
    </body>
  </worldbody>
  {_motors({"carriage": force_limit})}
</mujoco>"""


def two_link_arm(
    *,
    mass: tuple[float, float] = (0.5593806151425046, 0.6043459469186889),
    inertia: tuple[float, float] = (0.053470810264216295, 0.02392374528789766),
    com: tuple[float, float] = (0.3, 0.18377686083653508),
    length: tuple[float, float] = (0.3, 0.2),
    rotor_inertia: float = 0.0,
    gear: float = 6.0,
    damping: tuple[float, float] = (0.0, 0.0),
    frictionloss: tuple[float, float] = (0.0, 0.0),
    torque_limit: float = 10.0,
    timestep: float = 0.001,
) -> str:
    """Vertical double pendulum on two AK80-6 drives, joints ``shoulder`` and ``elbow`` [rad], both 0 when hanging.

    Defaults are design A.0, ``model_2.1``: the links of ``model_2.0`` without rotors and without friction.

    Args:
        mass: Of the links [kg].
        inertia: Of the links about their own joint axis, not about their centre of mass [kg·m²].
        com: Distance from the joint to the centre of mass [m].
        length: Distance from a joint to the next, and to the tip [m].
        rotor_inertia: Of one motor, before the gear [kg·m²]; ``model_2.0`` has 7.659e-5. The rotor of the elbow turns
            with the shoulder too, so its inertia couples both joints: Ir (q̇1 - gear q̇2)² / 2.
        gear: Reduction [1].
        damping: Viscous friction [N·m·s/rad]; ``model_2.0`` has 0.001 on both joints.
        frictionloss: Coulomb friction [N·m]; ``model_2.0`` has 0.093 and 0.078, times atan(100 v).
        torque_limit: Of a drive [N·m].
        timestep: Of the simulation [s].

    Source:
        https://github.com/dfki-ric-underactuated-lab/double_pendulum, ``model_parameters.yml`` of design A.0;
        equations of motion in its documentation, and in Wiebe et al. 2023, doi:10.1109/MRA.2023.3310865.

    Example:
        >>> import mujoco
        >>> mujoco.MjModel.from_xml_string(two_link_arm()).nu
        2
    """
    names = ("shoulder", "elbow")
    armature = (gear**2 * rotor_inertia, 0.0)  # the tendon below has the elbow's rotor
    joint = [
        f'<joint name="{name}" axis="0 -1 0" armature="{a:.12g}" damping="{b}" frictionloss="{fc}" '
        f"{_stiff_friction(timestep)}/>"
        for name, a, b, fc in zip(names, armature, damping, frictionloss, strict=True)
    ]
    link = [_rod(m, i, c, end) for m, i, c, end in zip(mass, inertia, com, length, strict=True)]
    return f"""
<mujoco model="two_link_arm">
  {_option(timestep)}
  <worldbody>
    <body name="upper">
      {joint[0]}
      {link[0]}
      <body name="lower" pos="0 0 {-length[0]}">
        {joint[1]}
        {link[1]}
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="elbow_rotor" armature="{rotor_inertia:.12g}">
      <joint joint="shoulder" coef="1"/>
      <joint joint="elbow" coef="{-gear}"/>
    </fixed>
  </tendon>
  {_motors(dict.fromkeys(names, torque_limit))}
</mujoco>"""


def pendulum(
    *,
    mass: float = 0.546,
    rod_mass: float = 0.13,
    length: float = 0.5,
    armature: float = 0.0,
    damping: float = 0.0,
    frictionloss: float = 0.0,
    torque_limit: float = 12.0,
    timestep: float = 0.001,
) -> str:
    """Torque-limited simple pendulum on an AK80-6 drive, joint ``pendulum`` [rad], 0 when hanging.

    Defaults are the published geometry alone: a point mass at the end of a uniform rod, without rotor and friction.

    Args:
        mass: Point mass at the tip [kg].
        rod_mass: Rod and mounts, spread evenly over the length [kg].
        length: From the joint to the point mass [m].
        armature: Inertia of the rotor seen at the joint [kg·m²]; 6² · 6.07e-5 by the data sheet.
        damping: Viscous friction [N·m·s/rad].
        frictionloss: Coulomb friction [N·m].
        torque_limit: Peak of the drive [N·m].
        timestep: Of the simulation [s].

    Source:
        https://github.com/dfki-ric-underactuated-lab/torque_limited_simple_pendulum; Wiebe et al. 2022,
        doi:10.21105/joss.03884.

    Example:
        >>> import mujoco
        >>> round(float(mujoco.MjModel.from_xml_string(pendulum()).body("pendulum").mass[0]), 3)
        0.676
    """
    total = mass + rod_mass
    com = (mass + rod_mass / 2) * length / total
    return _one_hinge(
        "pendulum",
        _rod(total, (mass + rod_mass / 3) * length**2, com, length),
        armature=armature,
        damping=damping,
        frictionloss=frictionloss,
        torque_limit=torque_limit,
        timestep=timestep,
    )


def xl330_pendulum(
    *,
    mass: float = 0.49,
    length: float = 0.1,
    armature: float = 0.0018141672784458866,
    damping: float = 0.003661672282824312,
    frictionloss: float = 0.01283272036582759,
    tilt: float = 0.030871000250528358,
    torque_limit: float = 0.7123329,
    timestep: float = 0.001,
) -> str:
    """Dynamixel XL330 that swings a point mass, joint ``pendulum`` [rad], 0 when hanging but for the tilt.

    Defaults are the published Coulomb-viscous model ``m1``. The back-EMF is not in here: it acts only while the servo
    is on, so it belongs to the gain kd of the recording.

    Args:
        mass: Point mass [kg]; the arm that holds it counts as massless.
        length: From the joint to the mass [m].
        armature: Inertia of rotor and gears seen at the joint [kg·m²].
        damping: Viscous friction [N·m·s/rad].
        frictionloss: Coulomb friction [N·m].
        tilt: Where the encoder's zero stands, against the vertical [rad]; ``q_offset`` of the source.
        torque_limit: Stall torque at full duty cycle, kt / R times 7.4 V [N·m].
        timestep: Of the simulation [s].

    Source:
        https://github.com/Rhoban/bam, ``params/xl330/m1.json``; Duclusaud, Passault et al. 2024, arXiv:2410.08650.

    Example:
        >>> import mujoco
        >>> mujoco.MjModel.from_xml_string(xl330_pendulum()).nv
        1
    """
    # MuJoCo refuses a body without inertia; 1e-9 kg·m² is 2e-7 of m l².
    point = (
        f'<inertial pos="0 0 {-length}" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" size="0.006" rgba="0.2 0.4 0.7 1"/>'
    )
    return _one_hinge(
        "pendulum",
        point,
        model="xl330_pendulum",
        armature=armature,
        damping=damping,
        frictionloss=frictionloss,
        tilt=tilt,
        gravity=9.80665,  # of the source, to which its parameters belong
        torque_limit=torque_limit,
        timestep=timestep,
    )


DISK_INERTIA = 2.4421e-4
"""Inertia of the unbalanced disk about its axis [kg·m²]."""
DISK_TORQUE_PER_VOLT = 28.136158 * DISK_INERTIA
"""Torque of the unbalanced disk's motor at rest [N·m/V]."""


def unbalanced_disk(
    *,
    inertia: float = DISK_INERTIA,
    gravity_torque: float = 11.339847**2 * DISK_INERTIA,
    damping: float = 1.3328339 * DISK_INERTIA,
    frictionloss: float = 6.0627295 * DISK_INERTIA,
    torque_limit: float = 10.0 * DISK_TORQUE_PER_VOLT,
    timestep: float = 0.00125,
) -> str:
    """Disk with an off-centre mass on a DC motor, joint ``disk`` [rad], 0 with the mass at the bottom.

    Defaults are the parameters of the source's own simulator, which has no delay:
    J q̈ = -m g l sin(q) - damping q̇ - frictionloss sign(q̇) + torque.

    Args:
        inertia: About the axis, J [kg·m²].
        gravity_torque: m g l, largest torque of the off-centre mass [N·m].
        damping: Viscous friction, back-EMF included [N·m·s/rad].
        frictionloss: Coulomb friction [N·m].
        torque_limit: Bound of the command [N·m]; 10 V, three times what the recordings reach: the source names none.
        timestep: Of the simulation [s].

    Source:
        https://github.com/GerbenBeintema/gym-unbalanced-disk, ``UnbalancedDisk.py``.

    Example:
        >>> import mujoco
        >>> round(float(mujoco.MjModel.from_xml_string(unbalanced_disk()).opt.timestep), 5)
        0.00125
    """
    arm = 0.04108  # m, of the source; the mass follows from m g l
    mass = gravity_torque / (GRAVITY * arm)
    disk = (
        f'<inertial pos="0 0 {-arm}" mass="{mass:.12g}" diaginertia="{inertia - mass * arm**2:.12g} '
        f'{inertia - mass * arm**2:.12g} {inertia - mass * arm**2:.12g}"/>'
        '<geom type="cylinder" fromto="0 -0.005 0 0 0.005 0" size="0.06" rgba="0.7 0.7 0.75 1"/>'
        f'<geom type="cylinder" fromto="0 -0.008 {-arm} 0 0.008 {-arm}" size="0.012" rgba="0.7 0.2 0.2 1"/>'
    )
    return _one_hinge(
        "disk",
        disk,
        model="unbalanced_disk",
        damping=damping,
        frictionloss=frictionloss,
        torque_limit=torque_limit,
        timestep=timestep,
    )


def _one_hinge(
    joint: str,
    body: str,
    *,
    timestep: float,
    torque_limit: float,
    model: str | None = None,
    armature: float = 0.0,
    damping: float = 0.0,
    frictionloss: float = 0.0,
    tilt: float = 0.0,
    gravity: float = GRAVITY,
) -> str:
    return f"""
<mujoco model="{model or joint}">
  {_option(timestep, gravity=f"0 0 {-gravity}")}
  <worldbody>
    <body name="{joint}" axisangle="0 -1 0 {np.degrees(tilt):.12g}">
      <joint name="{joint}" axis="0 -1 0" armature="{armature:.12g}" damping="{damping:.12g}"
             frictionloss="{frictionloss:.12g}" {_stiff_friction(timestep)}/>
      {body}
    </body>
  </worldbody>
  {_motors({joint: torque_limit})}
</mujoco>"""


def _option(timestep: float, gravity: str = f"0 0 {-GRAVITY}") -> str:
    # Arms of a bench pass through their own stand: nothing here is meant to touch.
    return (
        f'<option timestep="{timestep}" integrator="implicitfast" gravity="{gravity}">'
        '<flag contact="disable"/></option>'
    )


def _stiff_friction(timestep: float) -> str:
    # MuJoCo's frictionloss is a soft constraint: with the default solref it gives way 9 ms before the stop and creeps.
    # A time constant of two steps stops a joint within one step, which is Coulomb's law on this grid.
    return f'solreffriction="{2 * timestep} 1" solimpfriction="0.9999 0.9999 0.001"'


def _rod(mass: float, inertia: float, com: float, length: float) -> str:
    """A link that hangs along -z: inertia about its joint, which sits at the origin [kg·m²]."""
    i = inertia - mass * com**2  # about the centre of mass
    return (
        f'<inertial pos="0 0 {-com}" mass="{mass}" diaginertia="{i:.12g} {i:.12g} {1e-3 * i:.12g}"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" size="0.012" rgba="0.2 0.4 0.7 1"/>'
    )


def _motors(limits: dict[str, float]) -> str:
    motors = "".join(
        f'<motor name="{joint}" joint="{joint}" gear="1" ctrlrange="{-limit:.12g} {limit:.12g}" '
        f'forcerange="{-limit:.12g} {limit:.12g}"/>'
        for joint, limit in limits.items()
    )
    return f"<actuator>{motors}</actuator>"
