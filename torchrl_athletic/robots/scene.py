"""What every robot stands in: the time step, the solver, a floor, and the state that it starts from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import mujoco

Cone = Literal["elliptic", "pyramidal"]
TIMESTEP = 0.005
"""Time step of the physics; a policy acts every four of them [s]. Paper, table of domain randomisation."""
GROUND_SOLREF = (0.01, 1.0)
"""Time constant [s] and damping ratio of contacts with the ground: as stiff as the time step allows. At MuJoCo's 0.02 s
a foot of 3.2 cm that lands at 1 m/s sinks in whole, and a height field then squeezes it with 20 kN."""
_FLOOR_FRICTION = (0.8, 0.02, 0.01)


def empty_scene(name: str, cone: Cone) -> mujoco.MjSpec:
    """A floor under the sky.

    Args:
        name: Of the model.
        cone: Of friction. ``"elliptic"`` is the honest one; ``"pyramidal"`` is quicker, and feet under load creep more.

    Raises:
        ValueError: If the cone is another, since MuJoCo's number for it would be read as one of the two.
    """
    cones = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
    if cone not in cones:
        raise ValueError(f"cone is {cone!r}, which MuJoCo does not know. Choose one of {sorted(cones)}.")
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = cones[cone]
    spec.option.impratio = 10.0  # at 1 the soft contacts let loaded feet slide away within seconds
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.82, 0.84, 0.86],
        rgb2=[0.74, 0.76, 0.79],
        width=128,
        height=128,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.95, 0.97, 1.0],
        rgb2=[0.7, 0.78, 0.88],
        width=64,
        height=384,
    )
    material = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    world = spec.worldbody
    world.add_light(pos=[1.5, -1.5, 4], dir=[-0.3, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    # Priority: the ground's friction and softness rule in each of its contacts, so that one geom randomises them.
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        contype=0,
        conaffinity=1,
        priority=1,
        friction=_FLOOR_FRICTION,
        solref=GROUND_SOLREF,
        material="floor",
    )
    return spec


def add_keyframe(spec: mujoco.MjSpec, name: str, qpos: Sequence[float]) -> None:
    """A state at rest: the robot's positions, and the rest of the bodies where the model puts them."""
    rest = spec.compile().qpos0[len(qpos) :]
    spec.add_key(name=name, qpos=[*qpos, *rest])
