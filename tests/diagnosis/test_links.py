"""Links that the model has far off: searched all at once, where folds ask for several."""

import sys
from dataclasses import dataclass
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import STEP, double_pendulum, record, slider, smooth_torque

from torchrl_athletic.diagnosis import fit
from torchrl_athletic.diagnosis.deadline import Deadline
from torchrl_athletic.diagnosis.fit import Hypothesis
from torchrl_athletic.diagnosis.links import DRAWS, INERTIA, asks_for_links, with_links
from torchrl_athletic.diagnosis.prepare import prepare
from torchrl_athletic.diagnosis.standard import seen_in, standard_joints

module = sys.modules["torchrl_athletic.diagnosis.links"]


@pytest.mark.parametrize(
    ("asked", "several"),
    [
        ([], False),
        ([("link_mass", 0), ("link_inertia", 0), ("coulomb_friction", 1)], False),
        ([("link_mass", 0), ("link_com_shift", 1)], True),
    ],
)
def test_several_links_are_asked_for_where_laws_are_of_two_of_them(asked, several):
    terms = [SimpleNamespace(effect=SimpleNamespace(name=name), joint=joint) for name, joint in asked]
    assert asks_for_links(SimpleNamespace(problem=SimpleNamespace(hypothesis=SimpleNamespace(terms=terms)))) == several


def searched(monkeypatch, xml, better=True, deadline=np.inf):
    """What :func:`with_links` makes of a fit of the standard joints, and what it searched and compared."""
    torque = np.repeat(smooth_torque(2.0), xml.count("<joint"), axis=1)
    prepared = prepare([record(xml, torque, 0.4)], mujoco.MjModel.from_xml_string(xml))
    near, told = solved_of(standard_joints(prepared, seen_in(prepared))), {}

    def search(h, takes, begin, rng, deadline, torques):
        told.update(hypothesis=h, takes=takes, begin=begin, left=deadline.left)
        told["found"] = SimpleNamespace(values=h.nominal + 0.5)
        return told["found"]

    def follows(one, other, least):
        told.update(one=one, other=other)
        return better

    monkeypatch.setattr(module, "search", search)
    monkeypatch.setattr(module, "weighed", lambda problem, x: problem)
    monkeypatch.setattr(module, "descend", lambda problem, x, free, slopes, deadline: x + 0.25)
    monkeypatch.setattr(module, "linearise", lambda problem, x, free: SimpleNamespace(problem=problem, values=x))
    monkeypatch.setattr(module, "trusted", lambda near: near)
    monkeypatch.setattr(module, "follows_better", follows)
    found = with_links(near, prepared, np.random.default_rng(0), Deadline(deadline))
    return found, told, near


@dataclass(frozen=True)
class Windows:
    """A problem whose windows nobody simulates."""

    hypothesis: Hypothesis
    windows: tuple[SimpleNamespace, ...] = (SimpleNamespace(take="take"),)
    torques: None = None


def solved_of(h):
    return SimpleNamespace(problem=Windows(h), values=h.nominal + 0.125, seconds=1.0)


def test_all_numbers_of_all_links_are_searched_beside_the_fit_from_given_known_and_drawn_ones(monkeypatch):
    _, told, near = searched(monkeypatch, double_pendulum())
    assert told["takes"] == ("take",)
    h, first = told["hypothesis"], len(near.values)
    names = [(c.effect.name, c.where) for c in h.terms[len(near.problem.hypothesis.terms) :]]
    assert names == [(e, j) for j in ("upper", "lower") for e in ("link_mass", "link_com_shift", "link_inertia")]
    (scale,) = h.terms[-1].parameters
    assert (scale.lower, scale.upper) == INERTIA
    begin, low, high = told["begin"], *h.bounds
    assert len(begin) == 2 + DRAWS
    assert (begin[0] == h.nominal).all()
    assert (begin[1] == np.append(near.values, h.nominal[first:])).all()
    assert (begin[2::2, :first] == h.nominal[:first]).all()
    assert (begin[3::2, :first] == near.values).all()
    drawn = begin[2:, first:]
    assert ((drawn >= low[first:]) & (drawn <= high[first:])).all()
    assert (drawn.std(0) > 0).all()


def test_what_was_found_is_compared_on_the_windows_of_the_fit(monkeypatch):
    """A search draws windows of its own, whose error is another one."""
    found, told, near = searched(monkeypatch, double_pendulum())
    assert told["one"] is near
    assert found is told["found"]
    judged = told["other"]
    assert judged.problem.windows is near.problem.windows
    assert judged.problem.hypothesis is told["hypothesis"]
    assert (judged.values == told["hypothesis"].nominal + 0.75).all()


def test_links_stay_as_they_are_where_folds_are_not_followed_better_or_there_is_no_time(monkeypatch):
    for change in ({"better": False}, {"deadline": 20.0}):
        found, _, near = searched(monkeypatch, double_pendulum(), **change)
        assert found is near


def test_the_search_has_all_of_the_time_that_is_left(monkeypatch):
    _, told, _ = searched(monkeypatch, double_pendulum(), deadline=100.0)
    assert told["left"] > 95.0


def test_a_slide_has_no_inertia_and_no_centre_to_search(monkeypatch):
    _, told, _ = searched(monkeypatch, slider())
    assert [c.effect.name for c in told["hypothesis"].terms if c.effect.name.startswith("link")] == ["link_mass"]


def triple_pendulum(*links: tuple[float, float, float]) -> str:
    """Mass, distance of its centre and inertia of each of three links that hang on each other."""
    body = ""
    for k, (mass, centre, inertia) in reversed([*enumerate(links)]):
        body = f"""<body pos="0 0 {-0.2 * (k > 0)}"><joint name="joint{k}" axis="0 1 0" damping="1e-4"/>
          <inertial pos="0 0 {-centre}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>{body}</body>"""
    return f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody>{body}</worldbody></mujoco>"""


@pytest.mark.slow
def test_a_triple_pendulum_whose_links_are_far_off_is_followed_without_a_motor():
    given = triple_pendulum((0.135, 0.094, 0.0017), (0.135, 0.127, 0.0026), (0.1, 0.12, 0.002))
    true = triple_pendulum((0.26, 0.16, 0.0001), (0.28, 0.2, 0.0003), (0.12, 0.18, 0.0002))
    takes = [record(true, np.zeros((800, 3)), start) for start in (0.3, 0.5)]
    fitted = fit(given, takes, [record(true, np.zeros((400, 3)), 0.4)])
    for part in ("train", "heldout"):
        assert fitted.scores[part].after < 0.05 * fitted.scores[part].before
