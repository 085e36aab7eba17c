"""Bolting bodies together, against MuJoCo's own bookkeeping of bodies that cannot move against each other."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_athletic.robots.inertial import Inertial, box, combine

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers)
edges = st.tuples(*[st.floats(0.05, 1.0)] * 3)
boxes = st.builds(box, st.floats(0.1, 10.0), edges, vectors)


def kinetic_energy(part: Inertial, velocity: np.ndarray, spin: np.ndarray) -> float:
    """Kinetic energy of a body whose frame's origin moves at ``velocity`` and which turns with ``spin``."""
    of_centre = velocity + np.cross(spin, part.centre)
    return 0.5 * part.mass * of_centre @ of_centre + 0.5 * spin @ part.matrix() @ spin


@given(st.lists(boxes, min_size=1, max_size=4), vectors, vectors)
def test_bolted_bodies_have_the_kinetic_energy_of_their_parts(parts, velocity, spin):
    velocity, spin = np.array(velocity), np.array(spin)
    apart = sum(kinetic_energy(part, velocity, spin) for part in parts)
    assert kinetic_energy(combine(*parts), velocity, spin) == pytest.approx(apart, abs=1e-9)


def test_bolted_boxes_are_what_mujoco_makes_of_one_body_with_two_geoms():
    first, second = ((0.3, 0.2, 0.1), (0.1, -0.2, 0.3), 2.0), ((0.1, 0.4, 0.2), (-0.3, 0.1, 0.0), 1.0)
    geoms = "".join(
        f'<geom type="box" size="{a / 2} {b / 2} {c / 2}" pos="{x} {y} {z}" mass="{m}"/>'
        for (a, b, c), (x, y, z), m in (first, second)
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body><freejoint/>{geoms}</body></worldbody></mujoco>")
    whole = combine(*(box(mass, size, centre) for size, centre, mass in (first, second)))
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[1])
    frame = frame.reshape(3, 3)
    np.testing.assert_allclose(frame @ np.diag(model.body_inertia[1]) @ frame.T, whole.matrix(), atol=1e-12)
    np.testing.assert_allclose(model.body_ipos[1], whole.centre)


def test_a_tube_with_a_thin_wall_carries_its_mass_at_its_wall():
    a, mass = 0.05, 0.3
    tube = box(mass, (0.24, a, a), (0.0, 0.0, 0.0), hollow=(0.24, a - 1e-6, a - 1e-6))
    assert tube.tensor[0] == pytest.approx(mass * a**2 / 3, rel=1e-4)  # four plates: m/4 (a²/4 + a²/12) each
    assert tube.mass == mass


@given(boxes, st.sampled_from([0, 1, 2]), vectors, vectors)
def test_a_mirror_image_moves_with_the_same_energy_under_the_mirrored_motion(part, axis, velocity, spin):
    part = combine(part, box(1.0, (0.1, 0.2, 0.3), (0.3, -0.2, 0.1)))  # with products of inertia
    mirror = np.ones(3)
    mirror[axis] = -1.0
    velocity, spin = np.array(velocity), np.array(spin)
    mirrored = kinetic_energy(part.mirrored(axis), mirror * velocity, -mirror * spin)  # a spin is a pseudovector
    assert mirrored == pytest.approx(kinetic_energy(part, velocity, spin), abs=1e-9)
