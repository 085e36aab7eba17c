"""The given model: MJCF as a path, as text or as a spec, compiled."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import mujoco

Model: TypeAlias = str | Path | mujoco.MjSpec

_MESH_IS_MISSING = (
    'Name the folder of its meshes: <compiler meshdir="FOLDER"/>, in a URDF <mujoco><compiler meshdir="FOLDER" '
    'strippath="true"/></mujoco> inside <robot>. Where nothing touches anything in the recordings, the shapes of links '
    "that have an <inertial> may be deleted."
)


def load_model(model: Model) -> tuple[mujoco.MjModel, str, str]:
    """Compile MJCF given as a path, as text or as a spec.

    Returns:
        The model, its MJCF and its name.

    Raises:
        FileNotFoundError: If the path does not exist.
        ModelError: If MuJoCo cannot compile it.
    """
    source, spec = "the model", None
    try:
        if isinstance(model, mujoco.MjSpec):
            spec = model.copy()
        elif isinstance(model, str) and model.lstrip().startswith("<"):
            spec = mujoco.MjSpec.from_string(model)
        else:
            source = str(model)
            if not Path(model).is_file():
                raise FileNotFoundError(f"{source}: there is no such model. Name an MJCF file, or pass its text.")
            spec = mujoco.MjSpec.from_file(str(Path(model).resolve()))  # absolute, or it forgets its folder
        if spec.modelfiledir and (spec.meshes or spec.textures or spec.hfields):  # its MJCF is written elsewhere
            spec.meshdir = str(Path(spec.modelfiledir, spec.meshdir).resolve())
            spec.texturedir = str(Path(spec.modelfiledir, spec.texturedir).resolve())
        return spec.compile(), spec.to_xml(), spec.modelname or "model"
    except ValueError as error:
        reason = " ".join(str(error).split())
        meshes = [] if spec is None else [Path(mesh.file).name for mesh in spec.meshes]
        is_missing = "opening file" in reason and any(f"{mesh}'" in reason for mesh in meshes if mesh)
        mend = _MESH_IS_MISSING if is_missing else "Mend it until MuJoCo's viewer opens it."
        raise ModelError(f"{source}: MuJoCo cannot compile it ({reason}). {mend}") from error


class ModelError(ValueError):
    """A model that MuJoCo cannot compile; the message names it and says why."""


def position_unit(model: mujoco.MjModel, joint: str) -> str:
    """Unit of a joint's position: m of a slide, else rad."""
    return "m" if model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
