"""A policy at work, drawn."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_athletic.training.evaluation import acting
from torchrl_athletic.training.rollout import Policy

BACKENDS = ("egl", "osmesa", "glfw")
"""Ways to draw without a screen, and at last with one."""


@dataclass(frozen=True)
class View:
    """From where MuJoCo's free camera looks at what it keeps in its middle."""

    distance: float | None = None
    """Distance [m]; None sees all bodies of the first keyframe."""
    azimuth: float | None = None
    """Direction in which it looks, counter-clockwise from x [degree]; None is the model's."""
    elevation: float | None = None
    """Elevation of its line of sight [degree]: negative where it looks down from above; None is the model's."""


FREE = View()
"""The model's own."""


def record_video(
    env: EnvBase,
    policy: Policy,
    path: str | Path,
    *,
    steps: int = 200,
    frame_rate: float = 50.0,
    size: tuple[int, int] = (480, 640),
    camera: int | str = -1,
    annotate: Callable[..., None] | None = None,
    follow: str | None = None,
    view: View = FREE,
) -> Path:
    """Draw an episode of the first environment.

    Args:
        env: On a :class:`~torchrl_athletic.envs.TorqueEnv`.
        policy: Writes the action; acts by its mean.
        path: ``.mp4``, which needs ffmpeg on the PATH, or ``.gif``. Without ffmpeg an mp4 becomes a gif.
        steps: Most steps of the policy.
        frame_rate: Steps of the policy per second: a frame is drawn for each.
        size: Height and width [pixel].
        camera: Of the model; -1 for MuJoCo's free one.
        annotate: Adds shapes to the scene, such as a goal: called with the scene and, as ``step``, what the first
            environment showed after the step.
        follow: Body that the free camera keeps in its middle; None takes the robot's floating base, if it has one.
        view: Of the free camera; a camera of the model has its own.

    Returns:
        What was written.

    Raises:
        RuntimeError: If nothing can draw here; says what to install.
        ValueError: If the environment has no MuJoCo model, or the file another ending.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path.name}: a video is an .mp4 or a .gif. Name it so.")
    base = env.base_env if isinstance(env, TransformedEnv) else env
    physics = getattr(base, "physics", None)
    if physics is None:
        raise ValueError(
            f"{type(base).__name__} has no MuJoCo physics to draw. Give a TorqueEnv, or one with transforms."
        )
    follow = getattr(getattr(base, "robot", None), "base", None) if follow is None else follow
    return write_video(draw_episode(env, policy, steps, size, camera, annotate, follow, view), path, frame_rate)


@torch.no_grad()
def draw_episode(
    env: EnvBase,
    policy: Policy,
    steps: int,
    size: tuple[int, int] = (480, 640),
    camera: int | str = -1,
    annotate: Callable[..., None] | None = None,
    follow: str | None = None,
    view: View = FREE,
) -> list[NDArray[np.uint8]]:
    """Images of an episode of the first environment, as of :func:`record_video`. Shape (height, width, 3) each."""
    physics = (env.base_env if isinstance(env, TransformedEnv) else env).physics
    data, frames = mujoco.MjData(physics.model), []
    with renderer(physics.model, size, camera, view) as draw:
        for step in acting(env, policy, steps):
            data.qpos[:] = physics.qpos[0].cpu().numpy()
            mujoco.mj_forward(physics.model, data)
            look_at = None if follow is None else data.body(follow).xpos
            frames.append(draw(data, None if annotate is None else partial(annotate, step=step["next"][0]), look_at))
    return frames


def frame_strip(frames: list[NDArray[np.uint8]], count: int, path: str | Path) -> Path:
    """Frames side by side, evenly spaced in time, as one picture.

    Args:
        frames: Shape (height, width, 3) each.
        count: How many.
        path: Of the picture.
    """
    from PIL import Image

    chosen = [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(chosen, 1)).save(path)
    return path


Draw = Callable[..., NDArray[np.uint8]]


@contextmanager
def renderer(model: mujoco.MjModel, size: tuple[int, int], camera: int | str = -1, view: View = FREE) -> Iterator[Draw]:
    """Something that draws a state: ``draw(data, annotate, look_at)`` gives an image (height, width, 3).

    Raises:
        RuntimeError: If neither EGL nor OSMesa nor a screen is there.
    """
    height, width = size
    context = _gl_context(width, height)
    context.make_current()
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    scene = mujoco.MjvScene(model, maxgeom=2000)
    target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, target)
    eye, option = mujoco.MjvCamera(), mujoco.MjvOption()
    mujoco.mjv_defaultFreeCamera(model, eye)
    eye.lookat[:], eye.distance = _centre_and_distance(model)
    for name, value in asdict(view).items():
        if value is not None:
            setattr(eye, name, value)
    if camera != -1:
        eye.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        eye.fixedcamid = model.camera(camera).id
    viewport = mujoco.MjrRect(0, 0, width, height)

    def draw(
        data: mujoco.MjData,
        annotate: Callable[[mujoco.MjvScene], None] | None = None,
        look_at: NDArray[np.float64] | None = None,
    ) -> NDArray[np.uint8]:
        if look_at is not None:
            eye.lookat[:] = look_at
        mujoco.mjv_updateScene(model, data, option, None, eye, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
        if annotate is not None:
            annotate(scene)
        image = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(viewport, scene, target)
        mujoco.mjr_readPixels(image, None, viewport, target)
        return np.flipud(image).copy()

    try:
        yield draw
    finally:
        target.free()
        context.free()


def _centre_and_distance(model: mujoco.MjModel) -> tuple[NDArray[np.float64], float]:
    """Where to look from how far [m], to see all bodies of the first keyframe with room to move about."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    low, high = data.xpos[1:].min(0), data.xpos[1:].max(0)
    size = float(np.linalg.norm(high - low))
    return (low + high) / 2 + [0, 0, 0.25 * size], 1.2 + size


def _gl_context(width: int, height: int) -> Any:
    """The first way to draw that works, whatever ``MUJOCO_GL`` said when MuJoCo was imported."""
    failures = []
    for backend in BACKENDS:
        try:
            return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        except Exception as error:  # what a missing driver raises differs between drivers
            failures.append(f"{backend}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
    raise RuntimeError(
        "no way to draw was found, so there is no video. Install EGL (libegl1) or OSMesa (libosmesa6), or train "
        f"without video. Tried: {'; '.join(failures)}."
    )


def write_video(frames: list[NDArray[np.uint8]], path: str | Path, frame_rate: float) -> Path:
    """Write images as a video.

    Args:
        frames: Shape (height, width, 3) each.
        path: ``.mp4`` or ``.gif``; without ffmpeg on the PATH an mp4 becomes a gif, of every other frame.
        frame_rate: [1/s].

    Returns:
        What was written.
    """
    from matplotlib import animation

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4" and animation.writers.is_available("ffmpeg"):
        return _write_mp4(frames, path, frame_rate)
    from PIL import Image

    path = path.with_suffix(".gif")
    images = [Image.fromarray(frame) for frame in frames[::2]]  # browsers slow a gif down that has 50 images a second
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(2000 / frame_rate), loop=0)
    return path


def _write_mp4(frames: list[NDArray[np.uint8]], path: Path, frame_rate: float) -> Path:
    import subprocess

    height, width, _ = frames[0].shape
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(frame_rate), "-i", "-", "-pix_fmt", "yuv420p", str(path)]
    subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)
    return path
