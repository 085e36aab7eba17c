"""The fit of the standard joints as a trial: its draws, what of it is a name, and its way through a checkpoint."""

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.plants import pendulum

from torchrl_athletic.diagnosis import joints
from torchrl_athletic.diagnosis.corrected import Simulation
from torchrl_athletic.diagnosis.fit import Fitted, Hypothesis
from torchrl_athletic.diagnosis.fitting import JointParameter
from torchrl_athletic.diagnosis.joints import _decode, _encode, _with_draws, standard_joints_of
from torchrl_athletic.diagnosis.screen import Candidate
from torchrl_athletic.diagnosis.stages import Given
from torchrl_athletic.diagnosis.standard import LIMITS
from torchrl_athletic.diagnosis.thresholds import SIMULATION
from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, JointAddress, Parameter


def fit(catalogue=tuple(CATALOGUE)):
    """Three numbers with intervals of unlike widths, of which the last one is what every model is a little wrong in."""
    model, names = mujoco.MjModel.from_xml_string(pendulum()), ("pendulum",)
    address = JointAddress.of(model, names)
    dry, damping = (next(e for e in CATALOGUE if e.name == name) for name in ("coulomb_friction", "viscous_friction"))
    trim = next(e for e in FIT_TRIMS if e.name not in {e.name for e in CATALOGUE})
    terms = tuple(Candidate(e, 0, "pendulum", e.parameters(model, address, 0)) for e in (trim, damping, dry))
    h = Hypothesis(terms)
    values = np.array([p.nominal + 0.3 * (p.upper - p.nominal) for p in h.parameters])
    widths = 1e-3 * (1.0 + np.arange(len(values)))
    place = [(c, p) for c in terms for p in c.parameters]
    said = [
        JointParameter(c.where, c.effect.name, p.name, p.unit, p.nominal, v, (v - w / 2, v + w / 2), "identified")
        for (c, p), v, w in zip(place, values, widths, strict=True)
    ]
    given = Given(model, "", "", (), (), catalogue, seed=3)
    found = SimpleNamespace(corrected=Simulation(model, names, h, values), parameters=said[::-1])
    return _with_draws(found, given), h, values, widths


def test_draws_have_the_widths_of_the_stated_intervals_each_its_own():
    drawn, h, values, widths = fit()
    for c in h.terms:
        samples, own = drawn.hypothesis.values_of(c, drawn.samples), h.values_of(c, values)
        np.testing.assert_array_equal(drawn.hypothesis.values_of(c, drawn.values), own)
        low, high = np.quantile(samples, [0.025, 0.975], axis=0)
        np.testing.assert_allclose(high - low, h.values_of(c, widths), rtol=0.25)
        np.testing.assert_allclose(samples.mean(0), own, atol=2e-3)


def test_what_is_no_effect_of_the_catalogue_is_a_trim():
    drawn, h, _, _ = fit()
    trim, *terms = h.terms
    assert drawn.hypothesis.trims == (trim,)
    assert drawn.hypothesis.terms == tuple(terms)
    drawn, h, _, _ = fit((*CATALOGUE, trim.effect))  # whoever wants it named gets a name
    assert (drawn.hypothesis.trims, drawn.hypothesis.terms) == ((), h.terms)


def test_a_fit_comes_back_from_a_checkpoint_as_it_was():
    drawn, _, _, _ = fit()
    known = {e.name: e for e in (*FIT_TRIMS, *CATALOGUE)}
    again = _decode(json.loads(json.dumps(_encode(drawn))), known)
    for group in ("terms", "trims"):
        ours, theirs = (getattr(f.hypothesis, group) for f in (again, drawn))
        assert [(c.key, c.joint, c.parameters) for c in ours] == [(c.key, c.joint, c.parameters) for c in theirs]
    np.testing.assert_array_equal(again.values, drawn.values)
    np.testing.assert_array_equal(again.samples, drawn.samples)
    assert again.values == pytest.approx(drawn.values)


def test_with_an_empty_catalogue_nothing_is_fitted_since_nothing_could_be_kept():
    unasked = SimpleNamespace(result=lambda *told: pytest.fail("a fit was asked for"))
    assert standard_joints_of(SimpleNamespace(catalogue=()), SimpleNamespace(checkpoint=unasked)) is None


def law(name, *bounds, grid=(), takes=("one", "two")):
    """A candidate of the second joint with a number between each of the bounds."""
    effect = SimpleNamespace(
        name=name, grid_of=lambda signals, joint: list(grid), applies=lambda take: take in takes, identical_to=()
    )
    parameters = tuple(Parameter(f"p{k}", "1", low, low, high, 1.0) for k, (low, high) in enumerate(bounds))
    return Candidate(effect, 1, "knee", parameters)


def test_draws_stay_within_bounds_and_a_number_without_an_interval_is_drawn_as_it_is():
    h = Hypothesis((law("drag", (0.0, 5.0), (0.0, 1.0)),))
    said = JointParameter("knee", "drag", "p0", "1", 0.0, 0.1, (-3.0, 3.0), "identified")
    found = SimpleNamespace(parameters=[said], corrected=SimpleNamespace(hypothesis=h, values=np.array([0.1, 0.5])))
    drawn = _with_draws(found, Given(None, "", "", (), (), ()))
    assert drawn.samples[:, 0].min() == 0.0
    assert drawn.samples[:, 0].max() > 1.0
    assert (drawn.samples[:, 1] == 0.5).all()
    assert drawn.cost == 0.0
    nothing = SimpleNamespace(parameters=[], corrected=SimpleNamespace(hypothesis=Hypothesis(()), values=np.zeros(0)))
    assert _with_draws(nothing, Given(None, "", "", (), (), ())).values.shape == (0,)


def test_what_acts_at_the_given_models_numbers_is_no_finding():
    """A given limit, met before an offset that was fitted, belongs to the simulation and misses nothing."""
    h = Hypothesis((law("drag", (0.0, 5.0), (0.0, 1.0)), law("limit", (0.0, 2.0))))
    corrected = SimpleNamespace(hypothesis=h, values=np.array([0.0, 0.5, 0.0]))
    drawn = _with_draws(SimpleNamespace(parameters=[], corrected=corrected), Given(None, "", "", (), (), ()))
    assert (drawn.hypothesis.terms, drawn.hypothesis.trims) == (h.terms[:1], h.terms[1:])
    assert drawn.values.tolist() == [0.0, 0.5, 0.0]


@pytest.mark.parametrize(
    ("kept", "is_trial"), [(("drag",), True), ((), False), (("drag", "unheard_of"), False), (("unheard_of",), False)]
)
def test_a_fit_is_a_trial_where_the_catalogue_has_names_for_all_that_it_keeps(monkeypatch, kept, is_trial):
    """It is fitted once with the settings that were given, and kept."""
    asked, stored = [], {}
    laws = {name: law(name, (0.0, 1.0)) for name in ("drag", "unheard_of")}
    h = Hypothesis(tuple(laws[name] for name in kept))
    n = len(h.parameters)
    monkeypatch.setattr(joints, "fit", lambda *told, **settings: asked.append((told, settings)) or "found")
    monkeypatch.setattr(
        joints,
        "_with_draws",
        lambda found, given: Fitted(h, np.full(n, 0.5), np.full((SIMULATION.samples, n), 0.25), 0),
    )

    def result(key, compute, encode, decode):
        if key in stored:
            return decode(json.loads(stored[key]))
        value = compute()
        stored[key] = json.dumps(encode(value))
        return value

    given = Given(None, "<xml/>", "", ("takes",), (), (laws["drag"].effect,), drive="measured", seed=7)
    run = SimpleNamespace(checkpoint=SimpleNamespace(result=result), time_budget=None, left=lambda share: None)
    first = standard_joints_of(given, run)
    assert (first is not None) is is_trial
    assert asked == [(("<xml/>", ("takes",)), {"drive": "measured", "seed": 7, "time_budget": None})]
    if is_trial:
        again = standard_joints_of(given, run)
        assert len(asked) == 1
        hurried = SimpleNamespace(checkpoint=run.checkpoint, time_budget=60.0, left=lambda share: share * 60.0)
        standard_joints_of(given, hurried)  # what a hurried fit has found is not for a run that has time
        assert [settings["time_budget"] for _, settings in asked] == [None, 45.0]
        assert [c.key for c in again.hypothesis.terms] == [("drag", "knee")]
        np.testing.assert_array_equal(again.samples, first.samples)


def test_in_the_torques_a_fit_is_its_laws_at_their_fitted_values_where_all_takes_show_them():
    """Numbers that enter linearly are the torques' own; those of a grid are the fit's, or the grid's if it has none."""
    late = law("late", (0.0, 9.0), (0.0, 9.0), grid=({"p1": 1.0, "shape": 3.0}, {"p1": 2.0, "shape": 4.0}))
    seldom, hidden, unseen = law("seldom", (0, 9), grid=({},), takes=("one",)), law("hidden", (0, 9)), law("unseen")
    unseen.effect.grid_of = lambda signals, joint: [{"takes": signals, "joint": joint}]
    asked, scored = [], []

    def add(c, fixed):
        asked.append((c.effect.name, fixed))
        return None if c is unseen else c.effect.name

    bank = SimpleNamespace(takes=("one", "two"), add=add)
    free = SimpleNamespace(fit=SimpleNamespace(stand_ins=[]))
    judge = SimpleNamespace(bank=bank, score=lambda atoms: scored.append(atoms) or free)
    h = Hypothesis((seldom, late, hidden, unseen))
    fitted = Fitted(h, np.array([5.0, 6.0, 7.0, 8.0]), np.zeros((0, 4)), 0.0)
    assert joints.in_torques(judge, fitted) is free
    assert asked == [("late", {"p1": 7.0, "shape": 3.0}), ("unseen", {"takes": ("one", "two"), "joint": 1})]
    assert scored == [["late"]]


@pytest.mark.parametrize(
    ("stops", "named"),
    [
        ([], ["hip a", "hip b", "knee a", "robot c"]),
        (["hip b"], ["knee a", "robot c"]),  # what stands beside a stand-in is bent by it
        (["hip b", "knee a"], ["robot c"]),  # the second stops when the first has gone
        (["robot c"], []),  # it is on every joint
    ],
)
def test_a_joint_of_which_a_number_stops_at_a_bound_has_no_names(monkeypatch, stops, named):
    atoms = {
        name: SimpleNamespace(name=name, candidate=SimpleNamespace(joint_name=joint))
        for name, joint in (("hip a", "hip"), ("hip b", "hip"), ("knee a", "knee"), ("robot c", None))
    }

    def score(of):
        stuck = next(([a] for name in stops for a in of if a.name == name), [])
        return SimpleNamespace(fit=SimpleNamespace(terms=tuple(of), stand_ins=stuck))

    monkeypatch.setattr(joints, "_atom", lambda judge, c, values: atoms[c])
    h = SimpleNamespace(terms=tuple(atoms), values_of=lambda c, values: None)
    found = joints.in_torques(SimpleNamespace(score=score), SimpleNamespace(hypothesis=h, values=None))
    assert [a.name for a in found.fit.terms] == named


def asked_for(*names):
    """What the motion asks for: effects of the elbow with the shares that come back without them."""
    classes = {"friction": "friction", "drag": "friction", "rotor": "inertia"}
    effects = {n: SimpleNamespace(name=n, family=classes[n], grid_of=lambda *_: [{}]) for n in classes}
    p = Parameter("p", "1", 0.0, 0.0, 1.0, 1.0)
    terms = tuple(Candidate(effects[n], 1, "elbow", (p,)) for n, _ in names)
    fitted = Fitted(Hypothesis(terms), np.full(len(terms), 0.5), np.full((200, len(terms)), 0.5), 0.0)
    late = SimpleNamespace(name="late", family="timing")
    offered = tuple(Candidate(e, 1, "elbow", (p,)) for e in (*effects.values(), late))
    rivals = tuple((joints.Rival(Candidate(effects["rotor"], 1, "elbow", (p,)), np.array([0.3]), 4.0),) for _ in names)
    return joints.Asked(fitted, tuple(share for _, share in names), rivals, offered, complete=True)


def test_a_class_is_asked_for_by_the_effect_that_is_missed_most_and_one_that_is_not_asked_for_has_nothing():
    assert asked_for(("friction", 0.2), ("drag", 0.6)).classes == {
        ("friction", "elbow"): 0.6, ("inertia", "elbow"): 0.0, ("timing", "elbow"): 0.0,
    }  # fmt: skip
    assert set(asked_for().classes.values()) == {0.0}


def test_rivals_of_the_motion_are_told_as_far_as_the_torques_show_them(monkeypatch):
    asked = asked_for(("friction", 0.2))
    monkeypatch.setattr(joints, "_atom", lambda judge, c, values: (c.effect.name, values.tolist()))
    assert joints.rivals_in_torques(None, asked) == {("friction", "elbow"): ((("rotor", [0.3]), 4.0),)}
    monkeypatch.setattr(joints, "_atom", lambda judge, c, values: None)
    assert joints.rivals_in_torques(None, asked) == {("friction", "elbow"): ()}


@pytest.fixture(scope="module")
def arm():
    """Recordings of two links, the lower of which has dry friction that the model lacks."""
    from diagnosis.test_selection import arm, command, record

    from torchrl_athletic.diagnosis.prepare import prepare
    from torchrl_athletic.diagnosis.stages import Ready

    model = mujoco.MjModel.from_xml_string(arm())
    taken = record(arm(lower='damping="0.02" frictionloss="0.06"'), command())
    given = Given(model, arm(), "", (taken,), (), tuple(CATALOGUE))
    return Ready(given, prepare([taken], model), None)


def test_the_motion_is_offered_the_standard_joints_what_links_lack_and_what_the_torques_propose(arm):
    hypothesis, starts = joints._offered(arm, ())
    keys = [c.key for c in hypothesis.terms]
    assert len(set(keys)) == len(keys)
    assert {("coulomb_friction", "upper"), ("reflected_inertia", "lower"), ("link_mass", "upper")} <= set(keys)
    assert ("gravity_tilt", None) in keys
    assert ("offset_payload", "lower") not in keys  # of fewer than three joints the torques do not look for it
    assert {c.key for c in starts} == {("torque_saturation", "upper"), ("torque_saturation", "lower")}
    asked = np.abs(arm.given.recordings[0].torque_command).max(0)
    for c, sizes in starts.items():  # which would have none from its unit to its bound
        np.testing.assert_allclose(np.concatenate(sizes) / asked[c.joint], LIMITS, rtol=0.1)
    from diagnosis.plants import candidate

    from torchrl_athletic.effects import Compliance, StribeckFriction

    stribeck, soft = (
        candidate(e, arm.given.recordings[0], arm.given.xml, 1) for e in (StribeckFriction(), Compliance())
    )
    known = next(c for c in hypothesis.terms if c.key == ("coulomb_friction", "lower"))
    h = Hypothesis((stribeck, soft, known))
    values = h.nominal + 0.1
    more, starts = joints._offered(arm, [Fitted(h, values, values[None], 0.0)])
    assert more.terms[-1] is stribeck
    assert len(more.terms) == len(hypothesis.terms) + 1  # a gear is not offered, nor twice what is known
    np.testing.assert_array_equal(starts[stribeck], [h.values_of(stribeck, values)])
    again = next(c for c in more.terms if c.key == ("coulomb_friction", "lower"))
    np.testing.assert_array_equal(starts[again], [h.values_of(known, values)])  # what the torques say of it


def test_the_motion_asks_once_and_its_answer_comes_back_from_a_checkpoint(arm, monkeypatch):
    from torchrl_athletic.diagnosis.checkpoint import Checkpoint
    from torchrl_athletic.diagnosis.progress import Progress
    from torchrl_athletic.diagnosis.stages import Run

    kept = Checkpoint(None, "inputs")
    run = Run(Progress(), kept)
    first = joints.asked_of_motion(arm, run, ())
    assert first.complete
    assert first.fitted.hypothesis.terms[0].key == ("coulomb_friction", "lower")
    assert first.fitted.values[0] == pytest.approx(0.06, rel=0.05)
    assert first.classes["friction", "lower"] > 0.5
    assert first.classes["timing", "upper"] == 0.0
    json.dumps(kept._results)  # plain numbers
    monkeypatch.setattr(joints, "select", lambda *_: pytest.fail("asked again"))
    again = joints.asked_of_motion(arm, run, ())
    assert (again.shares, again.complete) == (first.shares, True)
    assert [c.key for c in again.fitted.hypothesis.terms] == [c.key for c in first.fitted.hypothesis.terms]
    np.testing.assert_array_equal(again.fitted.values, first.fitted.values)
    for ours, theirs in zip(again.rivals, first.rivals, strict=True):
        assert [(r.candidate.key, r.against) for r in ours] == [(r.candidate.key, r.against) for r in theirs]


def test_an_answer_of_no_effects_comes_back_from_a_checkpoint_and_one_that_was_cut_short_says_so(arm, tmp_path):
    from torchrl_athletic.diagnosis.checkpoint import Checkpoint
    from torchrl_athletic.diagnosis.progress import Progress
    from torchrl_athletic.diagnosis.stages import Run

    path = tmp_path / "progress.json"
    for _ in range(2):
        over = Run(Progress(), Checkpoint(path, "inputs"), time_budget=1.0, started=-1e9)
        asked = joints.asked_of_motion(arm, over, ())
        assert asked.fitted.hypothesis.terms == ()
        assert not asked.complete
    assert path.exists()


@pytest.mark.parametrize("targets", [False, True])
def test_what_the_motion_asks_for_is_fitted_in_the_steps_of_the_search_where_a_controller_closes_the_loop(
    arm, monkeypatch, targets
):
    from torchrl_athletic.diagnosis.checkpoint import Checkpoint
    from torchrl_athletic.diagnosis.progress import Progress
    from torchrl_athletic.diagnosis.stages import Run

    copies, told = {"copy": arm.train.takes[0]}, []
    nothing = Hypothesis(())
    found = SimpleNamespace(hypothesis=nothing, values=np.zeros(0), shares=(), rivals=(), complete=True)
    monkeypatch.setattr(joints, "coarse", lambda *_: copies)
    monkeypatch.setattr(joints, "select", lambda h, takes, *_: told.append(takes) or found)
    monkeypatch.setattr(joints, "follow_targets", lambda takes: takes == arm.train.takes and targets)
    fitted = Fitted(nothing, np.zeros(0), np.zeros((200, 0)), 0.0)
    monkeypatch.setattr(joints, "fit_in_steps_of", lambda copies, *_: told.append(copies) or fitted)
    joints.asked_of_motion(arm, Run(Progress(), Checkpoint(None, "")), ())
    assert told == [("copy",), copies if targets else {take: take for take in arm.train.takes}]
