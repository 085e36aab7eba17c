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


def floating_places(model: mujoco.MjModel) -> dict[str, NDArray[np.int64]]:
    """Rows of the fields of places in the world, and columns of ``sensordata``, that rise with what floats freely."""
    free = model.body_jntnum > 0
    free[free] = model.jnt_type[model.body_jntadr[free]] == mujoco.mjtJoint.mjJNT_FREE.value
    floats = free[model.body_rootid]
    bodies = np.flatnonzero(floats)
    places = {"xpos": bodies, "xipos": bodies, "subtree_com": bodies}
    owners = {"geom_xpos": model.geom_bodyid, "site_xpos": model.site_bodyid, "xanchor": model.jnt_bodyid}
    owners["cam_xpos"] = model.cam_bodyid
    places |= {name: np.flatnonzero(floats[owner]) for name, owner in owners.items()}
    of_objects = {"BODY": np.arange(model.nbody), "XBODY": np.arange(model.nbody)}
    of_objects |= {"GEOM": model.geom_bodyid, "SITE": model.site_bodyid, "CAMERA": model.cam_bodyid}
    columns = []
    for sensor in range(model.nsensor):
        kind, object_kind = model.sensor_type[sensor], mujoco.mjtObj(model.sensor_objtype[sensor]).name[6:]
        in_world = kind == _sensor.mjSENS_FRAMEPOS.value and model.sensor_refid[sensor] < 0
        body_of = of_objects["BODY"] if kind == _sensor.mjSENS_SUBTREECOM.value else of_objects.get(object_kind)
        if body_of is not None and (in_world or kind == _sensor.mjSENS_SUBTREECOM.value):
            if floats[body_of[model.sensor_objid[sensor]]]:
                columns.append(model.sensor_adr[sensor] + 2)
    return places | {"sensordata": np.array(columns, np.int64)}
