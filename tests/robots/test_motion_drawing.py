"""Pictures of motions."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from matplotlib.image import imread

from torchrl_athletic.robots import KeyPose, Motion, PhaseMotion, b2z1, draw_motion, motion_frames, read_motion, z1
from torchrl_athletic.robots.motion_drawing import _feet, _plant
from torchrl_athletic.robots.motion_tables import PosedRobot


def test_a_motion_is_drawn_even_if_the_robot_cannot_make_it(tmp_path):
    sound = draw_motion(read_motion("throw"), b2z1(), tmp_path / "new" / "throw.png")
    wild = Motion("wild", (PhaseMotion("up", (KeyPose(0.0), KeyPose(0.1, {"joint2": 5.0}))),))
    for path in (sound, draw_motion(wild, z1(), tmp_path / "wild.png")):
        assert imread(path)[..., :3].std() > 0.05


def test_joints_that_do_not_exist_cannot_be_drawn(tmp_path):
    unknown = Motion("wild", (PhaseMotion("up", (KeyPose(0.0, {"joint9": 5.0}),)),))
    for draw in (lambda: draw_motion(unknown, z1(), tmp_path / "wild.png"), lambda: motion_frames(unknown, z1())):
        with pytest.raises(ValueError, match="joint9"):
            draw()


def test_legs_bend_so_that_the_feet_stay_where_they_stand():
    posed = PosedRobot(b2z1())
    feet = _feet(posed)
    posed.place(posed.rows(read_motion("snatch").phases[0])[-1])
    sites = list(feet)
    assert np.abs(posed.data.site_xpos[sites] - list(feet.values())).max() > 0.1
    _plant(posed, feet)
    np.testing.assert_allclose(posed.data.site_xpos[sites], list(feet.values()), atol=1e-4)
    knees = posed.data.qpos[posed.columns[[2, 5, 8, 11]]]
    assert ((knees > -2.82) & (knees < -0.43)).all()


def test_where_nothing_can_draw_the_mend_is_named(monkeypatch):
    def broken(*_):
        raise mujoco.FatalError("gladLoadGL error")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RuntimeError, match="MUJOCO_GL to egl or osmesa"):
        motion_frames(read_motion("sled"), b2z1(), 2)


def test_frames_stand_side_by_side_and_show_the_motion():
    code = (
        "from torchrl_athletic.robots import *\n"
        "import numpy as np\n"
        "image = motion_frames(read_motion('sled'), b2z1(), 3, (120, 160))\n"
        "first, _, last = np.split(image.astype(float), 3, 1)\n"
        "print(image.shape, image.dtype, np.abs(last - first).mean() > 1)"
    )
    run = subprocess.run(
        [sys.executable, "-P", "-c", code], env={**os.environ, "MUJOCO_GL": "egl"}, capture_output=True, text=True
    )
    if run.returncode and "MuJoCo finds no way to draw" in run.stderr:
        pytest.skip("nothing here can draw")
    assert run.stdout.strip() == "(120, 480, 3) uint8 True", run.stderr
