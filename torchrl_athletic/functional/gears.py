"""Where a link hangs in a model whose motor has a joint of its own."""

from __future__ import annotations

from typing import Any


def link_joint(model: Any, joint: str) -> str:
    """The joint that a motor's link hangs at: ``<joint>_link`` behind a gear of a ``corrected.xml``, else its own.

    The tendon ``<joint>_gear`` between them tells such a link from any joint of that name.

    Args:
        model: An ``mjModel``.
        joint: Name of the motor's joint.

    Example:
        >>> import mujoco
        >>> link_joint(mujoco.MjModel.from_xml_string("<mujoco/>"), "elbow")
        'elbow'
    """
    joints = {model.joint(i).name for i in range(model.njnt)}
    gears = {model.tendon(i).name for i in range(model.ntendon)}
    link = f"{joint}_link"
    return link if link in joints and f"{joint}_gear" in gears else joint
