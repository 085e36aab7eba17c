"""Write the tables that ``docs/robots.md`` includes and draw its pictures: ``MUJOCO_GL=egl python docs/robots.py``."""

from __future__ import annotations

import time
from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np

from torchrl_athletic.robots import Bucket, Dumbbell, Robot, Terrain, b2z1, z1

TABLES = Path(__file__).with_name("generated")
IMAGES = Path(__file__).with_name("images")
WIDTH, HEIGHT = 900, 600

ROUGH = Terrain(roughness=(0.025, 0.025), tiles=3, spacing=0.1)
PICTURES = {  # robot, what the camera looks at [m], distance [m], azimuth, elevation [degrees]
    "z1": (z1(), (0.22, 0.0, 0.17), 1.15, 145.0, -18.0),
    "z1_reinforced": (z1(reinforced=True, tool=Dumbbell(5.0)), (0.22, 0.0, 0.17), 1.15, 145.0, -18.0),
    "b2z1": (b2z1(), (0.05, 0.0, 0.5), 2.3, 140.0, -14.0),
    "b2z1_bucket": (b2z1(reinforced=True, tool=Bucket()), (0.2, 0.0, 0.6), 2.0, 145.0, -24.0),
    "b2z1_terrain": (b2z1(terrain=ROUGH, payload=8.0), (0.0, 0.0, 0.4), 2.6, 130.0, -20.0),
}


def joint_table(robot: Robot) -> str:
    """A row for each joint of the first leg and for each of the arm."""
    model = robot.model()
    head = (
        "| # | joint | range [rad] | torque [N·m] | speed [rad/s] | armature [kg·m²] | viscous [N·m·s/rad] "
        "| Coulomb [N·m] | pose [rad] | kp [N·m/rad] | kd [N·m·s/rad] |\n|" + "---|" * 11
    )
    rows = []
    for index, name in enumerate(robot.joint_names):
        if 3 <= index < 12:  # the other legs are the same
            continue
        joint = model.joint(name)
        low, high = robot.position_limit[index]
        figures = (
            robot.torque_limit[index],
            robot.velocity_limit[index],
            joint.armature.item(),
            joint.damping.item(),
            joint.frictionloss.item(),
            robot.default_pose[index],
            robot.kp[index],
            robot.kd[index],
        )
        cells = " | ".join(f"{figure:.3g}" for figure in figures)
        number = ", ".join(map(str, range(index, 12, 3))) if index < 3 else str(index)
        shown = name.replace("FR_", "*leg*`_", 1) + "`" if index < 3 else f"`{name}`"
        rows.append(f"| {number} | {shown.replace('*leg*`_', '*leg* `_')} | {low:.2f} … {high:.2f} | {cells} |")
    return "\n".join([head, *rows]) + "\n"


def standing_table(seconds: float = 30.0) -> str:
    """How it stands under its gains with each cone and impratio, and the time that takes."""
    rows = []
    for cone in ("pyramidal", "elliptic"):
        for impratio in (1, 10, 100):
            spec = b2z1(cone=cone).spec()
            spec.option.impratio = impratio
            model = spec.compile()
            early, late = (stand(b2z1(), model, t, noise=0.0) for t in (2.0, seconds))
            busy = stand(b2z1(), model, 10.0, noise=0.05)
            heights = f"{early[0]:.3f} | {late[0]:.3f} | {late[1]:.4f}"
            rows.append(f"| {cone} | {impratio} | {heights} | {late[2]:.0f} | {busy[2]:.0f} |")
    head = (
        "| cone | impratio | height at 2 s [m] | at 30 s [m] | upright [cos] | µs a step, standing | with noise |\n|"
        + "---|" * 7
    )
    return "\n".join([head, *rows]) + "\n"


def stand(robot: Robot, model: mujoco.MjModel, seconds: float, noise: float) -> tuple[float, float, float]:
    """Height [m] and cosine of the tilt at the end, and the CPU time of a physics step [µs].

    Targets are the default pose plus normal noise [rad], drawn anew every four steps.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(robot.keyframe).id)
    rng = np.random.default_rng(0)
    pose, kp, kd = map(np.array, (robot.default_pose, robot.kp, robot.kd))
    steps = round(seconds / model.opt.timestep)
    start = time.process_time()
    for step in range(steps):
        if step % 4 == 0:
            target = pose + noise * rng.normal(size=len(pose))
        data.ctrl[:] = kp * (target - data.qpos[7 : 7 + len(pose)]) - kd * data.qvel[6 : 6 + len(pose)]
        mujoco.mj_step(model, data)
    spent = time.process_time() - start
    return float(data.qpos[2]), float(1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)), 1e6 * spent / steps


def draw(
    robot: Robot, lookat: tuple[float, float, float], distance: float, azimuth: float, elevation: float
) -> np.ndarray:
    """The robot after a second under its gains. Shape (HEIGHT, WIDTH, 3)."""
    spec = robot.spec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
    spec.visual.quality.shadowsize = 8192
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.3] * 3, [0.3] * 3
    spec.stat.extent, spec.stat.center = 2.0, [0.0, 0.0, 0.4]  # for finer shadows
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(robot.keyframe).id)
    joints = [model.joint(name) for name in robot.joint_names]
    qpos, dof = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
    for _ in range(200):
        error = np.array(robot.default_pose) - data.qpos[qpos]
        data.ctrl[:] = np.array(robot.kp) * error - np.array(robot.kd) * data.qvel[dof]
        mujoco.mj_step(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = lookat, distance, azimuth, elevation
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


if __name__ == "__main__":
    for name, table in (("joints", joint_table(b2z1())), ("standing", standing_table())):
        (TABLES / f"robots_{name}.md").write_text(table, encoding="utf-8")
    for name, view in PICTURES.items():
        matplotlib.image.imsave(IMAGES / f"robots_{name}.png", draw(*view))
