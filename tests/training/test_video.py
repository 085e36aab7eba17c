import numpy as np
import pytest
import torch
from PIL import Image
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import CountingEnv
from training.tasks import SEEN, arm_env

from torchrl_athletic.networks import actor
from torchrl_athletic.training import record_video
from torchrl_athletic.training.video import renderer, write_video


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


def test_every_other_frame_goes_into_a_gif_at_its_time(tmp_path):
    frames = [np.full((8, 8, 3), shade, np.uint8) for shade in range(0, 100, 10)]
    with Image.open(write_video(frames, tmp_path / "a.gif", frame_rate=50.0)) as video:
        assert video.n_frames == 5
        assert video.info["duration"] == 40


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
