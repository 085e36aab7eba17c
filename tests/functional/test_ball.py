"""A ball in a bucket: carried while the bottom pushes, guided by the walls, and free beyond the rim."""

import math

import pytest
import torch

from torchrl_athletic.functional.ball import GRAVITY, carry, fall, fly, landing

DT, RIM = 0.005, 0.045
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
AT_REST = torch.zeros(3, dtype=torch.float64)


def ride(motion, steps, dt=DT, rim=RIM, axis=lambda t: UP):
    """A ball that starts at rest in a bucket whose point moves as ``motion`` says; all of its states."""
    position, velocity = motion(0.0)
    states = []
    for k in range(steps):
        t = (k + 1) * dt
        bucket_position, bucket_velocity = motion(t)
        position, velocity, left = carry(
            position, velocity, bucket_position, bucket_velocity, axis(t), axis(t - dt), rim, dt
        )
        states.append((t, position, velocity, bool(left)))
        if left:
            break
    return states


def along(direction, acceleration):
    """Motion from rest under a constant acceleration."""
    return lambda t: (direction * (0.5 * acceleration * t**2), direction * (acceleration * t))


@pytest.mark.parametrize(("acceleration", "stays"), [(-9.7, True), (20.0, True), (-9.9, False), (-30.0, False)])
def test_it_stays_while_the_bucket_falls_slower_than_a_stone(acceleration, stays):
    states = ride(along(UP, acceleration), 600)
    assert states[-1][3] != stays
    if stays:
        t, position, _, _ = states[-1]
        torch.testing.assert_close(position, UP * (0.5 * acceleration * t**2))


def test_it_leaves_when_it_has_fallen_behind_by_the_height_of_the_rim():
    acceleration = -30.0
    t = ride(along(UP, acceleration), 1000, dt=1e-4)[-1][0]
    assert t == pytest.approx(math.sqrt(2 * RIM / (-acceleration - GRAVITY)), abs=2e-4)


def test_sideways_acceleration_neither_holds_nor_frees_it():
    sideways = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    states = ride(along(sideways, 500.0), 100)
    assert not states[-1][3]
    torch.testing.assert_close(states[-1][1], along(sideways, 500.0)(states[-1][0])[0])


def test_a_bucket_that_is_turned_over_lets_it_fall_at_the_acceleration_of_gravity():
    states = ride(lambda t: (AT_REST, AT_REST), 100, axis=lambda t: -UP)
    t, position, velocity, left = states[-1]
    assert left
    torch.testing.assert_close(velocity, -GRAVITY * t * UP)
    assert position[2] < -RIM


def test_a_lift_that_stops_throws_it_upwards_at_its_speed():
    speed, stop = 2.0, 0.1
    height, still = speed * stop * UP, AT_REST
    states = ride(lambda t: (speed * t * UP, speed * UP) if t < stop - 1e-9 else (height, still), 60)
    t, _, velocity, left = states[-1]
    assert left
    assert float(velocity[2]) == pytest.approx(speed - GRAVITY * (t - stop), abs=GRAVITY * DT + 1e-9)


def test_a_bottom_that_catches_up_carries_it_again():
    """A short drop: it floats by 2 mm, then the bottom comes back before it has left."""
    drop = 0.02  # s of fall at 3 g, then at rest

    def motion(t):
        fallen = min(t, drop)
        return -UP * (0.5 * 30.0 * fallen**2), -UP * (30.0 * fallen * (t < drop))

    states = ride(motion, 40, dt=0.001)
    above = [float((position - motion(t)[0]) @ UP) for t, position, _, _ in states]
    assert 1e-3 < max(above) < RIM
    assert not states[-1][3]
    assert above[-1] == 0.0


def test_walls_turn_it_along_without_pushing_it_out():
    """A tube that turns about its bottom flings a ball outwards as a bead on a rod: r grows as cosh(ω t)."""
    spin, start = 10.0, 0.01
    tube = lambda t: torch.tensor([math.cos(spin * t), math.sin(spin * t), 0.0], dtype=torch.float64)  # noqa: E731
    dt, position, velocity = 1e-5, start * tube(0.0), start * spin * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for k in range(10_000):
        position, velocity, _ = carry(
            position, velocity, AT_REST, AT_REST, tube((k + 1) * dt), tube(k * dt), depth=1.0, dt=dt
        )
    assert float(position @ tube(0.1)) == pytest.approx(start * math.cosh(spin * 0.1), rel=1e-2)


def test_free_flight_keeps_its_energy():
    velocity = torch.tensor([3.0, -1.0, 4.0], dtype=torch.float64)
    position = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    energy = lambda p, v: 0.5 * float(v @ v) + GRAVITY * float(p[2])  # noqa: E731
    later = fall(position, velocity, 0.7)
    assert energy(*later) == pytest.approx(energy(position, velocity))


@pytest.mark.parametrize("speed", [3.0, -3.0])
def test_it_lands_where_it_flies_to_and_stays_there(speed):
    velocity = torch.tensor([[2.0, 0.5, speed]], dtype=torch.float64)
    position = torch.tensor([[-0.1, 0.0, 0.8]], dtype=torch.float64)
    foreseen = landing(position, velocity, height=0.035)
    for _ in range(400):
        position, velocity = fly(position, velocity, DT, height=0.035)
        torch.testing.assert_close(landing(position, velocity, height=0.035), foreseen)
    assert position[0, 2] == 0.035
    assert velocity.abs().max() == 0


def test_level_range_is_greatest_at_45_degrees():
    """v² sin(2 θ) / g."""
    angle = torch.deg2rad(torch.tensor([30.0, 45.0, 60.0], dtype=torch.float64))
    velocity = 5.0 * torch.stack((angle.cos(), torch.zeros_like(angle), angle.sin()), -1)
    reached = landing(torch.zeros_like(velocity), velocity)[:, 0]
    torch.testing.assert_close(reached, 25.0 * torch.sin(2 * angle) / GRAVITY)
