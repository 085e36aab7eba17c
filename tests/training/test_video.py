from itertools import pairwise
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import CountingEnv
from training.tasks import SEEN, arm_env

from torchrl_athletic.networks import actor
from torchrl_athletic.training import record_video
from torchrl_athletic.training.video import (
    View,
    _centre_and_distance,
    _gl_context,
    draw_episode,
    frame_strip,
    renderer,
    write_video,
)


def policy():
    torch.manual_seed(0)
    return actor(7, 7, in_keys=SEEN, hidden=(8,))


def can_draw() -> bool:
    try:
        with renderer(arm_env(1).base_env.physics.model, (16, 16)):
            return True
    except RuntimeError:
        return False


def test_a_video_shows_the_robot_moving_and_what_is_drawn_beside_it(tmp_path, monkeypatch):
    if not can_draw():
        pytest.skip("nothing here can draw")
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: False)
    steps = []
    path = record_video(
        arm_env(1, episode=50),
        policy(),
        tmp_path / "v" / "arm.mp4",
        steps=12,
        size=(48, 64),
        annotate=lambda scene, step: steps.append(step),
    )
    assert path == tmp_path / "v" / "arm.gif"
    assert len(steps) == 12
    assert steps[0]["joint_position"].shape == (7,)
    with Image.open(path) as video:
        first = np.asarray(video.convert("RGB"), float)
        video.seek(video.n_frames - 1)
        assert np.abs(np.asarray(video.convert("RGB"), float) - first).max() > 30


def test_it_is_the_first_robot_that_is_drawn_from_above_down_and_the_camera_goes_with_it(monkeypatch):
    if not can_draw():
        pytest.skip("nothing here can draw")
    model = mujoco.MjModel.from_xml_string(BALL)
    seen = []
    env = SimpleNamespace(physics=SimpleNamespace(model=model, qpos=torch.tensor([[0.4], [-9.0]])))
    step = TensorDict(next=TensorDict(row=torch.arange(2), batch_size=[2]), batch_size=[2])
    monkeypatch.setattr("torchrl_athletic.training.video.acting", lambda *_: [step])
    note = lambda scene, step: seen.append(int(step["row"]))  # noqa: E731
    still, followed = (draw_episode(env, None, 1, (40, 60), annotate=note, follow=body)[0] for body in (None, "ball"))
    assert seen == [0, 0]
    assert still.shape == followed.shape == (40, 60, 3)
    rows = [np.average(np.arange(40), weights=1e-9 + redness(frame).sum(1)) for frame in (still, followed)]
    assert rows[0] < 18  # higher than where the camera looks by itself
    assert rows[1] == pytest.approx(19.5, abs=1.5)


def redness(frame):
    red, green, blue = frame.astype(float).transpose(2, 0, 1)
    return np.clip(red - np.maximum(green, blue), 0, None)


BALL = """
<mujoco><worldbody>
  <body name="ball"><joint type="slide" axis="0 0 1"/><geom size="0.1" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


TWO = """
<mujoco><worldbody>
  <camera name="beside" pos="0 3 0" xyaxes="-1 0 0 0 0 1"/>
  <camera name="before" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>
  <camera name="away" pos="0 -1 0" xyaxes="-1 0 0 0 0 1"/>
  <body name="ball"><joint type="slide" axis="0 0 1"/><geom size="0.1" rgba="1 0 0 1"/></body>
  <body name="post" pos="12 0 -1"><geom size="0.1"/></body>
</worldbody><keyframe><key qpos="4"/></keyframe></mujoco>"""


def test_it_is_drawn_from_the_camera_that_is_named():
    if not can_draw():
        pytest.skip("nothing here can draw")
    model = mujoco.MjModel.from_xml_string(TWO)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    red = []
    for camera in ("before", "beside", "away"):
        with renderer(model, (48, 48), camera) as draw:
            red.append(redness(draw(data)).sum())
    assert red[0] > 5 * red[1] > 0
    assert red[2] == 0


def test_the_free_camera_stands_where_it_is_told_to():
    if not can_draw():
        pytest.skip("nothing here can draw")
    model = mujoco.MjModel.from_xml_string(BESIDE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle, seen = np.arange(64) - 31.5, {}
    for name, view in {
        "near": View(distance=2.0, azimuth=0.0, elevation=0.0),
        "far": View(distance=4.0, azimuth=0.0, elevation=0.0),
        "behind": View(distance=2.0, azimuth=180.0, elevation=0.0),
        "above": View(distance=2.0, azimuth=90.0, elevation=-89.0),
    }.items():
        with renderer(model, (64, 64), view=view) as draw:
            red = redness(draw(data, look_at=np.zeros(3)))
        seen[name] = (np.average(middle, weights=red.sum(0)), np.average(middle, weights=red.sum(1)), (red > 20).sum())
    assert seen["near"][0] < -5 < 5 < seen["behind"][0]  # to the left is to the right from the other side
    assert seen["far"][0] == pytest.approx(seen["near"][0] / 2, rel=0.3)
    assert seen["near"][2] == pytest.approx(4 * seen["far"][2], rel=0.3)
    assert abs(seen["near"][1]) < 2
    assert seen["above"][1] < -5  # ahead is up


BESIDE = """
<mujoco><worldbody>
  <body pos="0 0.3 0"><geom size="0.1" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


def test_a_camera_that_is_carried_sees_all_that_stands_about(monkeypatch):
    """However much that is."""
    if not can_draw():
        pytest.skip("nothing here can draw")
    behind = '<geom size="0.1" pos="0 -9 0"/>' * 100
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody>{behind}<geom size="0.3" pos="5 2 0" rgba="1 0 0 1"/>
          <body pos="0 0 0.01"><joint type="slide" axis="1 0 0"/><geom size="0.05" pos="0 0 -3"/>
            <camera name="eye" xyaxes="1 0 0 0 0 1"/></body></worldbody></mujoco>""")
    monkeypatch.setattr("torchrl_athletic.training.video.acting", lambda *_: [None])
    env = SimpleNamespace(physics=SimpleNamespace(model=model, qpos=torch.tensor([[5.0]])))
    (frame,) = draw_episode(env, None, 1, (40, 60), "eye")
    rows, columns = np.nonzero(redness(frame) > 50)
    assert (rows.mean(), columns.mean()) == pytest.approx((19.5, 29.5), abs=2)


def test_the_camera_looks_at_the_middle_of_all_bodies_of_the_first_keyframe_from_beyond_them():
    """A ball 4 m up and a post 12 m ahead, 1 m down: a little above their middle, with 1.2 m to spare."""
    centre, distance = _centre_and_distance(mujoco.MjModel.from_xml_string(TWO))
    np.testing.assert_allclose(centre, [6.0, 0.0, 1.5 + 13.0 / 4])
    assert distance == pytest.approx(14.2)
    ahead = TWO.replace('name="ball"', 'name="ball" pos="8 0 0"')  # the world's own origin is no body to be seen
    centre, distance = _centre_and_distance(mujoco.MjModel.from_xml_string(ahead))
    np.testing.assert_allclose(centre, [10.0, 0.0, 1.5 + 0.25 * 41**0.5])
    assert distance == pytest.approx(1.2 + 41**0.5)


def test_ffmpeg_is_told_width_before_height_and_the_rate_and_given_every_frame(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: name == "ffmpeg")
    monkeypatch.setattr("subprocess.run", lambda command, **options: told.append((command, options)))
    frames = [np.full((4, 6, 3), shade, np.uint8) for shade in (1, 2, 3)]
    assert write_video(frames, tmp_path / "a.mp4", frame_rate=25.0) == tmp_path / "a.mp4"
    ((command, options),) = told
    after = dict(pairwise(command))
    assert (after["-s"], after["-r"], after["-pix_fmt"]) == ("6x4", "25.0", "yuv420p")
    assert command[-1] == str(tmp_path / "a.mp4")
    assert options["input"] == b"".join(frame.tobytes() for frame in frames)
    assert "-y" in command  # over the one of an earlier run
    assert options["check"]  # a video that was not written is no success


def test_a_strip_shows_frames_evenly_from_the_first_to_the_last_side_by_side(tmp_path):
    frames = [np.full((4, 3, 3), shade, np.uint8) for shade in range(0, 90, 10)]
    for count, shades in ((3, [0, 40, 80]), (4, [0, 30, 50, 80])):  # the nearest ones
        with Image.open(frame_strip(frames, count, tmp_path / "r" / "s" / "strip.png")) as picture:
            shown = np.asarray(picture)
        assert shown.shape == (4, 3 * count, 3)
        assert shown[0, ::3, 0].tolist() == shades


def test_the_camera_keeps_a_floating_base_in_its_middle_unless_told_otherwise(monkeypatch, tmp_path):
    drawn, robot, far = [], SimpleNamespace(base="trunk"), View(distance=9.0)
    env = SimpleNamespace(physics=object(), robot=robot)
    for name in ("draw_episode", "write_video"):
        monkeypatch.setattr(f"torchrl_athletic.training.video.{name}", lambda *told: drawn.append(told))
    for follow in (None, "hand"):
        record_video(
            env, "policy", tmp_path / "a.mp4", steps=7, frame_rate=25.0, size=(8, 9), camera=2, annotate="goal",
            follow=follow, view=far,
        )  # fmt: skip
    assert drawn[::2] == [(env, "policy", 7, (8, 9), 2, "goal", body, far) for body in ("trunk", "hand")]
    assert drawn[1] == (None, tmp_path / "a.mp4", 25.0)


def test_every_other_frame_goes_into_a_gif_at_its_time(tmp_path):
    frames = [np.full((8, 8, 3), shade, np.uint8) for shade in range(0, 100, 10)]
    with Image.open(write_video(frames, tmp_path / "a.gif", frame_rate=50.0)) as video:
        assert video.n_frames == 5
        assert video.info["duration"] == 40
        assert video.info["loop"] == 0  # again and again
        video.seek(0)
        assert np.asarray(video.convert("RGB")).max() == 0  # the first one is among them


def test_where_nothing_can_draw_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr("torchrl_athletic.training.video.BACKENDS", ("none_of_these",))
    with pytest.raises(RuntimeError, match=r"libegl1.*none_of_these"):
        record_video(arm_env(1), policy(), tmp_path / "a.mp4")


def test_other_endings_and_environments_without_physics_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\.mp4 or a \.gif"):
        record_video(arm_env(1), policy(), tmp_path / "a.avi")
    env = TransformedEnv(CountingEnv(), StepCounter())
    with pytest.raises(ValueError, match="no MuJoCo physics"):
        record_video(env, policy(), tmp_path / "a.gif")


def test_the_first_way_to_draw_that_works_is_taken_and_what_needs_no_screen_is_tried_first(monkeypatch):
    asked = []

    def module(name):
        asked.append(name)
        if name != "mujoco.osmesa":
            raise ImportError(f"{name} is not here")
        return SimpleNamespace(GLContext=lambda width, height: (name, width, height))

    monkeypatch.setattr("importlib.import_module", module)
    assert _gl_context(64, 48) == ("mujoco.osmesa", 64, 48)
    assert asked == ["mujoco.egl", "mujoco.osmesa"]


def test_a_screen_is_tried_at_last_and_a_way_that_fails_in_silence_is_named(monkeypatch):
    def module(name):
        raise OSError if name == "mujoco.osmesa" else ImportError(f"no {name}\nand more")

    monkeypatch.setattr("importlib.import_module", module)
    told = r"Tried: egl: no mujoco\.egl; osmesa: OSError; glfw: no mujoco\.glfw\."
    with pytest.raises(RuntimeError, match=told):
        _gl_context(64, 48)


def test_a_picture_may_be_larger_than_a_model_says():
    if not can_draw():
        pytest.skip("nothing here can draw")
    wall = '<camera name="above" pos="0 0 2"/><body><geom type="box" size="50 50 0.1" rgba="1 0 0 1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{wall}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    larger = (model.vis.global_.offheight + 40, model.vis.global_.offwidth + 60)
    with renderer(model, larger, "above") as draw:
        frame = draw(data)
    assert frame.shape == (*larger, 3)
    assert redness(frame).min() > 10  # up to its edges


def test_a_gif_is_a_gif_also_where_there_is_ffmpeg(tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: True)
    path = write_video([np.zeros((8, 8, 3), np.uint8)] * 2, tmp_path / "b" / "c" / "a.gif", frame_rate=50.0)
    assert path.read_bytes().startswith(b"GIF")
