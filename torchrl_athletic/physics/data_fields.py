"""Fields of ``mjData`` that a step need not compute, and what its sensors read."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

_NOT_COMPUTED = ("cacc", "cfrc_ext", "cfrc_int", "energy", "qfrc_inverse", "subtree_angmom", "subtree_linvel")

_sensor = mujoco.mjtSensor
_OF_CONSTRAINTS = (
    _sensor.mjSENS_JOINTLIMITPOS,
    _sensor.mjSENS_TENDONLIMITPOS,
    _sensor.mjSENS_JOINTLIMITVEL,
    _sensor.mjSENS_TENDONLIMITVEL,
    _sensor.mjSENS_GEOMDIST,
    _sensor.mjSENS_GEOMNORMAL,
    _sensor.mjSENS_GEOMFROMTO,
    _sensor.mjSENS_CONTACT,
    _sensor.mjSENS_TACTILE,
    _sensor.mjSENS_PLUGIN,
    _sensor.mjSENS_USER,
)


def check_computed(name: str) -> None:
    """Raise if a step need not compute the field, so that what it holds means nothing.

    Raises:
        ValueError: With what to read instead.
    """
    if name in _NOT_COMPUTED:
        raise ValueError(f"a step need not compute {name}: it could be another env's. Read a sensor of it instead.")


def late_columns(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Columns of ``sensordata`` that follow from accelerations and contact forces: touch, accelerometer, force."""
    late = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
    spans = [np.arange(a, a + n) for a, n in zip(model.sensor_adr[late], model.sensor_dim[late], strict=True)]
    return np.concatenate([np.zeros(0, np.int64), *spans])


def sensors_need_constraints(model: mujoco.MjModel) -> bool:
    """Whether a sensor of position or velocity reads collisions or constraints, which poses do without."""
    early = model.sensor_needstage < mujoco.mjtStage.mjSTAGE_ACC.value
    return bool(np.isin(model.sensor_type[early], [int(kind) for kind in _OF_CONSTRAINTS]).any())


def sensors_read_actuators(model: mujoco.MjModel) -> bool:
    """Whether a sensor reads the length or velocity of an actuator."""
    kinds = (_sensor.mjSENS_ACTUATORPOS, _sensor.mjSENS_ACTUATORVEL)
    return bool(np.isin(model.sensor_type, [int(kind) for kind in kinds]).any())
