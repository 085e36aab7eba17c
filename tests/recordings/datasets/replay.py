"""Replay of a recording by a plain loop over ``mj_step``, which shares no code with the package's own physics."""

import mujoco
import numpy as np

from torchrl_athletic.recordings.recording import Recording


def open_loop(mjcf: str, recording: Recording, position=None, velocity=None) -> np.ndarray:
    """Positions of a simulation that starts in the first sample, or in the given state, and follows the command."""
    model = mujoco.MjModel.from_xml_string(mjcf)
    data = mujoco.MjData(model)
    data.qpos[:] = recording.position[0] if position is None else position
    measured = 0.0 if recording.velocity is None else recording.velocity[0]
    data.qvel[:] = measured if velocity is None else velocity
    step = np.round((recording.time - recording.time[0]) / model.opt.timestep).astype(int)
    limit = model.actuator_ctrlrange[:, 1]
    simulated = np.empty_like(recording.position)
    for sample in range(recording.num_samples):
        simulated[sample] = data.qpos
        steps = step[min(sample + 1, len(step) - 1)] - step[sample]
        if recording.torque_command is not None:
            data.ctrl[:] = recording.torque_command[sample]
            mujoco.mj_step(model, data, nstep=steps)
            continue
        for _ in range(steps):
            error = recording.position_target[sample] - data.qpos
            data.ctrl[:] = np.clip(recording.kp * error - recording.kd * data.qvel, -limit, limit)
            mujoco.mj_step(model, data)
    return simulated


def rmse(mjcf: str, recording: Recording, **start) -> np.ndarray:
    """Root mean square error of :func:`open_loop`. Shape (J,)."""
    return np.sqrt(np.mean((open_loop(mjcf, recording, **start) - recording.position) ** 2, axis=0))


def window_rmse(mjcf: str, recording: Recording, window: float = 0.5) -> np.ndarray:
    """RMSE of each whole window, every one started from the measured state. Shape (windows, J)."""
    time = recording.time - recording.time[0]
    starts = np.arange(0.0, time[-1] - window + 1e-9, window)
    edges = np.searchsorted(time, [starts, starts + window]).T
    return np.array([rmse(mjcf, recording.slice(*edge)) for edge in edges])
