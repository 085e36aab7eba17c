"""A rope pulls only when it is stretched, and friction alone brings a sled to rest."""

import itertools
import math

import pytest
import torch

from torchrl_athletic.functional.sled import GRAVITY, STIFFNESS, slide, span, tension

MASS, FRICTION, LENGTH = torch.tensor([60.0]), torch.tensor([0.15]), torch.tensor([2.0])
HELD = torch.tensor([0.15 * 60.0 * GRAVITY])
"""What it takes to move that sled [N]."""
TYPE = torch.float64


def vector(*numbers):
    return torch.tensor(numbers, dtype=TYPE)


def drag(grip, seconds, dt, *, position=(2.0, 0.0), velocity=(0.0, 0.0), friction=FRICTION, mass=MASS):
    """A sled on a rope to a grip that moves level with the hook, from ``grip(t)``: all of its states."""
    position, velocity, still = vector(*position), vector(*velocity), vector(0.0)
    states = []
    for k in range(round(seconds / dt) + 1):
        here, moves = grip(k * dt)
        hook, hook_velocity = torch.cat((position, still)), torch.cat((velocity, still))
        distance, rate, direction = span(here, moves, hook, hook_velocity)
        pull = tension(distance, rate, LENGTH)
        states.append((position, velocity, distance, rate, pull))
        position, velocity = slide(position, velocity, -(pull * direction)[:2], mass, friction, dt)
    return [torch.stack(column) for column in zip(*states, strict=True)]


def fixed(t):
    return vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)


def backwards(speed):
    return lambda t: (vector(-speed * t, 0.0, 0.0), vector(-speed, 0.0, 0.0))


def energy(velocity, distance, mass=MASS):
    """Energy of sled and rope [J]. Shape (T, 1)."""
    stored = STIFFNESS / 3 * (distance - LENGTH).clamp(min=0) ** 3
    return 0.5 * mass * velocity.square().sum(-1, keepdim=True) + stored


@pytest.mark.parametrize(
    ("distance", "rate", "newton"),
    [(1.0, 0.0, 0.0), (1.0, -3.0, 0.0), (2.5, 0.0, 250.0), (2.5, 4.0, 234.0), (2.5, -4.0, 234.0), (2.01, 1.0, 0.0)],
)
def test_a_rope_pulls_by_the_square_of_its_stretch_and_never_pushes(distance, rate, newton):
    assert tension(vector(distance), vector(rate), LENGTH).item() == pytest.approx(newton)


def test_distance_and_rate_are_those_of_the_ends():
    torch.manual_seed(0)
    ends = torch.randn(2, 50, 3, dtype=TYPE)
    velocities = torch.randn(2, 50, 3, dtype=TYPE)
    distance, rate, direction = span(ends[0], velocities[0], ends[1], velocities[1])
    dt = 1e-6
    later = span(ends[0] + dt * velocities[0], velocities[0], ends[1] + dt * velocities[1], velocities[1])[0]
    torch.testing.assert_close((later - distance) / dt, rate, atol=1e-4, rtol=0)
    torch.testing.assert_close(ends[0] + distance * direction, ends[1])


def test_ends_in_one_place_pull_nowhere():
    place = vector(0.3, -0.2, 0.1)
    distance, rate, direction = span(place, vector(1.0, 0.0, 0.0), place, vector(0.0, 0.0, 0.0))
    assert distance == rate == 0
    assert (direction == 0).all()


@pytest.mark.parametrize(("share", "moves"), [(0.0, False), (0.999, False), (1.001, True), (2.0, True)])
def test_it_sticks_until_the_pull_exceeds_friction(share, moves):
    position, velocity = start = vector(0.7, -0.3), vector(0.0, 0.0)
    pull = share * HELD.double() * vector(0.6, -0.8)
    for _ in range(100):
        position, velocity = slide(position, velocity, pull, MASS, FRICTION, 0.005)
    if moves:
        torch.testing.assert_close(velocity, pull * (1 - 1 / share) / MASS * 0.5, atol=1e-6, rtol=1e-6)
    else:
        assert torch.equal(position, start[0])
        assert (velocity == 0).all()


def test_left_alone_it_comes_to_rest_within_its_braking_distance_and_does_not_turn_round():
    position, velocity, way = vector(0.0, 0.0), vector(1.2, -0.9), []
    for _ in range(1100):
        position, velocity = slide(position, velocity, vector(0.0, 0.0), MASS, FRICTION, 0.001)
        way.append(position)
    assert (velocity == 0).all()
    assert (torch.stack(way).diff(dim=0)[:, 0] >= 0).all()
    braked = 1.5**2 / (2 * 0.15 * GRAVITY)
    torch.testing.assert_close(position, braked * vector(0.8, -0.6), atol=2e-3, rtol=0)


def test_turning_everything_about_the_vertical_turns_what_happens():
    angle = 0.7
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=TYPE)

    def curve(t):
        place = vector(-0.8 * t, 0.4 * t * t, 0.3 + 0.1 * t)
        return place, vector(-0.8, 0.8 * t, 0.1)

    plain = drag(curve, 2.0, 0.005, velocity=(0.1, 0.2))
    turned = drag(
        lambda t: tuple(turn @ x for x in curve(t)),
        2.0,
        0.005,
        position=(turn[:2, :2] @ vector(2.0, 0.0)).tolist(),
        velocity=(turn[:2, :2] @ vector(0.1, 0.2)).tolist(),
    )
    assert plain[4].max() > 50
    torch.testing.assert_close(turned[0], plain[0] @ turn[:2, :2].T)
    torch.testing.assert_close(turned[4], plain[4])


@pytest.mark.parametrize("speed", [0.1, 1.0])
def test_pulled_evenly_it_keeps_the_stretch_that_balances_friction(speed):
    stretch = math.sqrt(HELD.item() / STIFFNESS)
    _, velocity, _, _, pull = drag(backwards(speed), 1.0, 0.001, position=(2.0 + stretch, 0.0), velocity=(-speed, 0.0))
    torch.testing.assert_close(pull, HELD.double().expand_as(pull), atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(velocity[-1], vector(-speed, 0.0), atol=1e-5, rtol=0)


def test_pulled_from_rest_it_surges_and_stalls_forever_around_that_tension():
    """Nothing damps it: friction is the same at each speed, and the rope gives back what it takes."""
    dt = 0.004
    _, velocity, _, _, pull = drag(backwards(0.5), 24.0, dt)
    speed, tugs = -velocity[500:, 0], pull[500:, 0]  # from 2 s on
    early, late = speed[:2750], speed[2750:]
    for part in (early, late):
        assert 0.9 < part.max() < 1.1
        assert part.min() < 0.03
    slides = speed[1:] > 0
    impulse = (tugs[:-1][slides].sum() - HELD * slides.sum()) * dt
    assert impulse.item() == pytest.approx(60.0 * (speed[-1] - speed[0]).item(), abs=2.0)  # of some 2000 N s


def test_the_energy_of_rope_and_sled_grows_as_the_rope_lengthens_and_falls_as_it_shortens():
    dt = 1e-4
    _, velocity, distance, rate, pull = drag(fixed, 1.2, dt, velocity=(2.0, 0.0), friction=torch.zeros(1))
    power = energy(velocity, distance).diff(dim=0) / dt
    stretch = (distance - LENGTH).clamp(min=0)
    expected = rate * torch.minimum(rate.square(), STIFFNESS * stretch.square())
    torch.testing.assert_close(power, expected[:-1], atol=0.3, rtol=0.0)
    assert expected.max() > 4
    assert expected.min() < -4
    assert (pull >= 0).all()


@pytest.mark.parametrize("speed", [0.5, 2.0, 6.0])
def test_without_friction_it_comes_back_as_fast_as_it_went(speed):
    _, velocity, distance, _, _ = drag(fixed, 2.0, 5e-4, velocity=(speed, 0.0), friction=torch.zeros(1))
    back = (distance < LENGTH).nonzero()[0, 0]
    assert velocity[back, 0] == pytest.approx(-speed, rel=1e-3)


def test_with_friction_each_way_out_and_back_costs_energy_until_it_rests():
    _, velocity, distance, _, _ = drag(fixed, 10.0, 5e-3, velocity=(3.0, 0.0))
    slack = (distance <= LENGTH).squeeze(-1)
    at_slack = energy(velocity, distance)[slack].squeeze(-1)
    assert (at_slack.diff() <= 0).all()
    assert (velocity[-1] == 0).all()
    out = energy(velocity, distance)[: int(distance.argmax())]
    assert out.diff(dim=0).max() < 0  # at these speeds friction takes more than the law gives


def test_a_finer_step_changes_less_and_less():
    def tug(t):
        return vector(-t - 0.3 * t * t, 0.2 * math.sin(t), 0.4), vector(-1 - 0.6 * t, 0.2 * math.cos(t), 0.0)

    def end(dt):  # of a sled that slides all the time
        return drag(tug, 1.2, dt, position=(2.2, 0.0), velocity=(-1.0, 0.1))[0][-1]

    finest = end(2.5e-4)
    errors = [(end(dt) - finest).norm().item() for dt in (0.02, 0.01, 0.005, 0.0025)]
    assert errors[2] < 5e-3
    for coarse, fine in itertools.pairwise(errors):
        assert 1.6 < coarse / fine < 2.6  # of first order
