"""Which combination is the answer: what torques and simulation say of each, together."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_athletic.diagnosis import decide as deciding
from torchrl_athletic.diagnosis.decide import decided_by, others_than
from torchrl_athletic.diagnosis.proposal import Proposal
from torchrl_athletic.diagnosis.result import Score
from torchrl_athletic.diagnosis.stages import Trial
from torchrl_athletic.diagnosis.thresholds import DECISION, SEARCH


def leaving(share, joints=1):
    """A score that leaves a share of the error energy above the floor."""
    joint = {"before": np.sqrt(101.0), "after": np.sqrt(1.0 + 100.0 * share), "floor": 1.0}
    return Score(1.0, 1.0, 1.0, 0.0, {f"joint{k}": joint for k in range(joints)})


def decided(options, errors, scores, began):
    """The decision between trials with these proposals, window errors (W, J) and scores."""
    trials = [
        Trial(option, None, {"train": score}, error, began)
        for option, error, score in zip(options, errors, scores, strict=True)
    ]
    return decided_by(trials)


@pytest.mark.parametrize(
    ("better", "left", "behind", "is_richer", "expected"),
    [
        (0.0, 0.1, 2.0, False, 0),  # the torques decide between equals
        (0.04, 0.1, 2.0, False, 0),  # and between what an optimiser makes equal
        (0.10, 0.1, 2.0, False, 1),  # a little on every window is enough for a rival
        (0.10, 0.08, 0.0, True, 0),  # not for a law that contains the first, and always gains a little
        (0.10, 0.07, 0.0, True, 1),
        (0.04, 0.07, 0.0, True, 0),
    ],
)
def test_the_simulation_decides_between_what_the_torques_leave_open(better, left, behind, is_richer, expected):
    errors = 10 * np.exp(0.01 * np.random.default_rng(0).normal(size=(2, 100, 1)))
    options = [Proposal(None, None), Proposal(None, None, behind, is_richer)]
    scores = [leaving(0.1), leaving(left)]
    chosen, against, _ = decided(options, [errors[0], errors[1] * np.exp(-better)], scores, 0.5 * np.arange(100))
    assert chosen == expected
    assert against[chosen] == 0 or expected == 0


def test_a_richer_law_that_is_not_taken_does_not_keep_a_rival_from_being_preferred():
    noise = 10 * np.exp(0.01 * np.random.default_rng(0).normal(size=(3, 100, 1)))
    options = [Proposal(None, None), Proposal(None, None, 0.0, True), Proposal(None, None, 3.0)]
    errors, began = list(noise * np.exp([[[0.0]], [[-0.5]], [[-0.2]]])), 0.5 * np.arange(100)
    assert decided(options, errors, [leaving(0.10), leaving(0.08), leaving(0.09)], began)[0] == 2
    assert decided(options, errors, [leaving(0.10), leaving(0.02), leaving(0.09)], began)[0] == 1


def seldom(lost, turned=(), times=50.0, left=(0.99, 0.01), size=1.0):
    """Which of three is chosen: nothing, a spring that follows better but where it counts, a stop that follows there.

    Args:
        lost: Windows and joints that nothing and spring miss.
        turned: The same of the stop.
        times: How far.
        left: Share of the error energy that they leave, and that the stop leaves.
        size: Of the errors, in units of the floor.
    """
    rng = np.random.default_rng(0)
    plain = size * np.exp(0.2 * rng.normal(size=(400, 3)))  # what a start state adds is in all of them
    stop = plain.copy()
    plain[tuple(np.transpose(lost))] *= times
    if turned:
        stop[tuple(np.transpose(turned))] *= times
    spring = plain * np.exp(-0.3 * (1 + rng.normal(size=(400, 1))))
    options = [Proposal(None, None), Proposal(None, None, 3.0), Proposal(None, None, DECISION.behind)]
    scores = [leaving(left[0], 3), leaving(left[0], 3), leaving(left[1], 3)]
    return decided(options, [plain, spring, stop], scores, 0.5 * np.arange(400))[0]


TWICE = ((20, 1), (21, 1), (200, 1))


def test_what_acts_on_two_occasions_is_taken_where_it_alone_explains_the_error():
    assert seldom(TWICE) == 2


@pytest.mark.parametrize(
    "case",
    [
        {"lost": TWICE, "turned": ((300, 0),)},  # elsewhere it is the other way round
        {"lost": ((20, 1), (21, 1), (23, 1))},  # one occasion may be a blow that nobody recorded
        {"lost": ((20, 1), (200, 2))},  # two joints, one occasion each
        {"lost": TWICE, "left": (0.99, 0.15)},  # it does not explain the error
        {"lost": TWICE, "left": (0.40, 0.01)},  # the others do not leave it
        {"lost": TWICE, "times": 2.0},  # what they leave is hardly more than the floor
        {"lost": TWICE, "size": 0.01},  # it is below all floors
        {"lost": TWICE, "times": 5.0, "size": 20.0},  # the stop does not follow either
    ],
)
def test_what_acts_seldom_refutes_nothing_that_it_does_not_clearly_beat(case):
    assert seldom(**case) != 2


def scored(floors, before, after):
    """A score with these numbers of each joint."""
    joints = zip(floors, before, after, strict=True)
    told = {f"joint{k}": dict(zip(("floor", "before", "after"), joint, strict=True)) for k, joint in enumerate(joints)}
    return Score(1.0, 1.0, 1.0, 0.0, told)


def test_errors_of_all_joints_count_each_above_the_floor_of_its_own_trial():
    """The second trial halves the error of one joint and not that of the other, which is larger and on its floor."""
    rng, began = np.random.default_rng(0), 0.5 * np.arange(100)
    noise = np.exp(0.01 * rng.normal(size=(2, 100, 2)))
    first, second = noise * [[[1.0, 50.0]], [[0.5, 50.0]]]
    options, score = [Proposal(None, None), Proposal(None, None, 2.0)], leaving(0.3, 2)
    low = scored([0.1, 0.1], [10.0, 99.0], [4.0, 60.0])
    assert decided(options, [first, second], [low, low], began)[0] == 1
    blind = scored([1.0, 0.1], [10.0, 99.0], [4.0, 60.0])  # half of a floor that the sensors do not see
    assert decided(options, [first, second], [low, blind], began)[0] == 0
    assert decided(options, [first, second], [score, score], began)[0] == 0


def test_errors_of_a_millionth_count_where_the_sensors_are_perfect():
    errors = 1e-6 * np.exp(0.01 * np.random.default_rng(0).normal(size=(2, 100, 1))) * [[[1.0]], [[0.5]]]
    perfect = scored([0.0], [1e-5], [1e-6])
    options = [Proposal(None, None), Proposal(None, None, 2.0)]
    assert decided(options, list(errors), [perfect] * 2, 0.5 * np.arange(100))[0] == 1


def test_what_is_not_taken_is_as_far_behind_as_can_be_whatever_the_torques_say_of_it():
    """A rival that the simulation and the torques speak against, both at their most, is still preferred to it."""
    errors = 10 * np.exp(0.01 * np.random.default_rng(0).normal(size=(3, 100, 1))) * [[[2.0]], [[1.0]], [[0.5]]]
    options = [Proposal(None, None, 50.0), Proposal(None, None, 60.0), Proposal(None, None, 0.0, True)]
    scores = [leaving(0.10), leaving(0.10), leaving(0.09)]
    chosen, against, taken = decided(options, list(errors), scores, 0.5 * np.arange(100))
    assert (chosen, taken) == (0, [True, True, False])
    assert against.tolist() == [SEARCH.decisive, 0.0, SEARCH.decisive]


@pytest.mark.parametrize(
    ("floors", "level", "taken"),
    [
        ((1.0, 1.0), 1.0, False),
        ((9.0, 1.0), 1.0, True),
        ((1.0, 9.0), 1.0, True),
        ((1.0, 1.0), 2.0, False),
        ((1.0, 1.0), 3.0, True),
    ],
)
def test_a_miss_is_one_above_the_floors_of_both_and_following_is_twice_the_floor(floors, level, taken):
    """Nothing misses two windows far apart by twenty floors, of which a better one leaves ``level``."""
    first, second = np.ones((400, 1)), np.ones((400, 1))
    first[[20, 200]], second[[20, 200]] = 20.0, level
    options = [Proposal(None, None), Proposal(None, None, 9.0)]
    high, low = np.array(floors) * 10.0
    scores = [scored([floors[0]], [high], [0.99 * high]), scored([floors[1]], [low], [1.1 * floors[1]])]
    assert decided(options, [first, second], scores, 0.5 * np.arange(400))[2] == [taken, True]


def test_the_odds_against_the_worse_are_the_square_of_its_paired_z_score_beyond_a_twentieth():
    """Log errors 0.15 ± 0.1 of 16 windows lie four standard errors beyond; of 4 windows two, and equal ones none."""
    worse = 0.15 + 0.1 * np.where(np.arange(16) % 2, 1.0, -1.0)
    assert deciding._against(worse[:4]) == pytest.approx(4.0)
    assert deciding._against(worse[:6]) == pytest.approx(6.0)
    assert deciding._against(worse) == SEARCH.decisive
    assert deciding._against(worse - 0.11) == deciding._against(-worse) == 0.0


def test_the_best_is_that_of_the_least_mean_of_logarithms_though_one_of_its_windows_is_wild():
    rng, began = np.random.default_rng(0), 0.5 * np.arange(100)
    first, second = 10 * np.exp(0.01 * rng.normal(size=(2, 100, 1)))
    second *= 0.5
    second[7] = 40.0
    options = [Proposal(None, None), Proposal(None, None, 2.0)]
    _, against, _ = decided(options, [first, second], [leaving(0.3)] * 2, began)
    assert against.tolist() == [SEARCH.decisive, 0.0]


def test_an_option_that_is_as_lost_elsewhere_refutes_what_it_follows_on_two_occasions():
    """Two windows are lost by both, so that neither is better there; floors are those of a joint in metres."""
    for unit in (1.0, 0.01):
        worse, better, began = np.ones((400, 1)), np.ones((400, 1)), 0.5 * np.arange(400)
        worse[[20, 200]], better[[20, 200]] = 20.0, 2.0
        worse[[100, 300]], better[[100, 300]] = 20.0, 30.0
        floor = np.array([unit])
        assert deciding._misses(unit * worse, unit * better, floor, began)
        better[[20, 200]] = 3.0  # which is no following
        assert not deciding._misses(unit * worse, unit * better, floor, began)


@pytest.mark.parametrize(("level", "taken"), [(4.0, True), (6.0, False)])
def test_a_miss_is_more_than_twice_the_error_of_what_follows(level, taken):
    """Beside one that follows within two floors, at 2.5 times its error."""
    first, second = np.ones((400, 1)), np.ones((400, 1))
    first[[20, 200]], second[[20, 200]] = level, 2.0
    options = [Proposal(None, None), Proposal(None, None, 9.0)]
    assert decided(options, [first, second], [leaving(0.99), leaving(0.01)], 0.5 * np.arange(400))[2] == [taken, True]


def test_a_richer_law_that_is_not_taken_refutes_nothing():
    plain = np.ones((400, 1))
    plain[[20, 200]] = 50.0
    options = [Proposal(None, None), Proposal(None, None, 0.0, True)]
    scores = [leaving(0.99), leaving(0.01)]
    chosen, against, _ = decided(options, [plain, np.ones((400, 1))], scores, 0.5 * np.arange(400))
    assert (chosen, against[0]) == (0, 0)


def test_what_the_simulation_refutes_does_not_need_or_was_asked_about_alone_is_no_other_explanation():
    def option(*names: str, alone: bool = False) -> Proposal:
        terms = [SimpleNamespace(candidate=SimpleNamespace(key=(name, "hip"))) for name in names]
        return Proposal(None, SimpleNamespace(fit=SimpleNamespace(terms=terms)), alone=alone)

    found, gains, refuted, idle, late = (option(n) for n in ("rotor", "gains", "richer", "offset", "spring"))
    both, stop = option("gains", "rotor"), option("stop", alone=True)
    options = (found, gains, refuted, idle, both, stop, late)
    needed = [{("rotor", "hip")}, {("gains", "hip")}, set(), set(), {("gains", "hip")}, {("stop", "hip")}]
    assert others_than(0, options, needed) == (gains.best, both.best, late.best)  # that was not fitted for lack of time
    assert others_than(5, options, needed) == ()


@pytest.mark.parametrize(("left", "better", "chosen"), [(0.6, 0.7, 1), (0.9, 0.7, 0), (0.6, 0.99, 0)])
def test_a_late_effect_has_to_be_decisively_better_and_to_close_much(left, better, chosen):
    options = [Proposal(None, None), Proposal(None, None, DECISION.behind, on_trial=True, alone=True)]
    errors = np.random.default_rng(0).normal(10.0, 1.0, (2, 400, 1)) * np.array([1.0, better])[:, None, None]
    found, _, taken = decided(options, errors, [leaving(0.95), leaving(left)], 0.5 * np.arange(400))
    assert (found, taken) == (chosen, [True, bool(chosen)])


def test_a_trial_that_gives_no_names_is_never_chosen_and_speaks_against_no_other():
    errors = np.random.default_rng(0).normal(10.0, 1.0, (2, 400, 1)) * np.array([1.0, 0.1])[:, None, None]
    options = [Proposal(None, None), Proposal(None, None, np.inf, on_trial=True, joints=True)]
    found, against, taken = decided(options, errors, [leaving(0.9), leaving(0.01)], 0.5 * np.arange(400))
    assert (found, against[0], taken) == (0, 0.0, [True, False])


@pytest.mark.parametrize(
    ("preferred", "joints", "kept"), [(0, True, [1]), (0, False, []), (1, True, [0]), (2, False, [0])]
)
def test_beside_the_chosen_one_stay_the_first_of_the_torques_and_the_standard_joints(
    preferred, joints, kept, monkeypatch
):
    def proposal(of_joints):
        return Proposal(None, SimpleNamespace(fit=SimpleNamespace(terms=[])), joints=of_joints)

    trials = tuple(
        Trial(proposal(of_joints), hypothesis([]), {}, np.zeros((1, 1)), np.zeros(1))
        for of_joints in (False, joints, False)
    )
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (preferred, np.array([0.0, 1.0, 2.0]), [True] * 3))
    monkeypatch.setattr(deciding, "others_than", lambda *_: ())
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: False)
    proposed = SimpleNamespace(located=None, drive=None)
    found = deciding.decide(SimpleNamespace(proposed=proposed, trials=trials, untried=(), asked=None))
    assert found.trial.fitted is trials[preferred].fitted
    assert list(found.beside) == [trials[k] for k in kept]


def test_what_the_simulation_says_against_each_combination_is_told_beside_it(monkeypatch):
    fitted = hypothesis([])
    options = [
        Proposal(None, SimpleNamespace(fit=SimpleNamespace(terms=terms))) for terms in ([atom("mass")], [atom("play")])
    ]
    trials = tuple(Trial(option, fitted, {}, np.zeros((1, 1)), np.zeros(1)) for option in options)
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (0, np.array([0.0, 7.0]), [True, False]))
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: False)
    proposed = SimpleNamespace(located=None, drive=None)
    found = deciding.decide(SimpleNamespace(proposed=proposed, trials=trials, untried=(), asked=None))
    told = {next(iter(names))[0]: against for names, against in found.trial.proposal.simulated.items()}
    assert told == {"mass": 0.0, "play": 7.0}
    assert found.trial.proposal.others == ()  # what is not taken is no other explanation


def atom(name, joint="hip"):
    return SimpleNamespace(candidate=SimpleNamespace(key=(name, joint), name=name))


def hypothesis(terms, trims=()):
    return SimpleNamespace(hypothesis=SimpleNamespace(terms=tuple(terms), trims=tuple(trims)))


@pytest.mark.parametrize(("open_joints", "is_open"), [((False, True), True), ((False, False), False)])
def test_torques_are_open_where_one_joint_misses_some_with_all_numbers_within_their_tolerances(open_joints, is_open):
    """Terms that are findings do not count, since their absence is what is asked about; trims do."""
    friction, mass, scored = atom("friction"), atom("mass"), []
    judge = SimpleNamespace(
        score=lambda atoms: scored.append(list(atoms)) or SimpleNamespace(fit="fit"),
        is_open=lambda fit: np.array(open_joints),
    )
    best = SimpleNamespace(fit=SimpleNamespace(terms=[friction, mass]))
    fitted = hypothesis([friction.candidate], [SimpleNamespace(key=("mass", "hip"))])
    trial = Trial(Proposal(judge, best), fitted, {}, np.zeros((1, 1)), np.zeros(1))
    assert deciding.torque_is_open(trial) is is_open
    assert scored == [[mass]]


def test_a_term_that_became_a_trim_is_needed_too_and_a_trim_that_is_no_term_is_not():
    friction, mass, tilt, gone = (atom(name) for name in ("friction", "mass", "tilt", "gone"))
    best = SimpleNamespace(fit=SimpleNamespace(terms=[friction, mass, gone]))
    fitted = hypothesis([friction.candidate], [mass.candidate, tilt.candidate])
    trial = Trial(Proposal(None, best), fitted, {}, np.zeros((1, 1)), np.zeros(1))
    assert deciding.needed_by(trial) == {("friction", "hip"), ("mass", "hip")}


def test_only_what_the_simulation_does_not_refute_may_need_its_terms(monkeypatch):
    asked, friction, gear = [], atom("friction"), atom("gear")
    trials = tuple(
        Trial(
            Proposal(None, SimpleNamespace(fit=SimpleNamespace(terms=[a]))), hypothesis([a.candidate]), {},
            np.zeros((1, 1)), np.zeros(1),
        )
        for a in (friction, gear)
    )  # fmt: skip
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (0, np.array([0.0, 7.0]), [True, False]))
    monkeypatch.setattr(deciding, "others_than", lambda own, options, needed: asked.append(needed) or ())
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: False)
    monkeypatch.setattr(deciding, "answer_set", lambda part, term: ())
    proposed = SimpleNamespace(located=None, drive=None)
    deciding.decide(SimpleNamespace(proposed=proposed, trials=trials, untried=(), asked=None))
    assert asked == [[{("friction", "hip")}, set()]]


def test_only_what_is_stated_is_asked_who_could_stand_in_its_place(monkeypatch):
    friction, dropped = atom("friction"), atom("dropped")
    best = SimpleNamespace(fit=SimpleNamespace(terms=[friction, dropped]))
    trial = Trial(Proposal(None, best), hypothesis([friction.candidate]), {}, np.zeros((1, 1)), np.zeros(1))
    asked = []
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (0, np.array([0.0]), [True]))
    monkeypatch.setattr(deciding, "others_than", lambda *_: ())
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: True)
    monkeypatch.setattr(deciding, "answer_set", lambda part, term: asked.append(term) or "set")
    proposed = SimpleNamespace(located="where", drive=None)
    found = deciding.decide(SimpleNamespace(proposed=proposed, trials=(trial,), untried=(), asked=None))
    assert asked == [friction]
    assert found.sets == {("friction", "hip"): "set"}
    assert found.is_open
    nothing = deciding.decide(SimpleNamespace(proposed=proposed, trials=(), untried=(), asked=None))
    assert (nothing.located, nothing.trial) == ("where", None)


def test_of_the_standard_joints_only_what_the_motion_asks_for_is_a_finding(monkeypatch):
    """All joints have eight numbers each; of another combination every term is one, whatever it closes."""
    much, little = atom("much"), atom("little")
    best = SimpleNamespace(fit=SimpleNamespace(terms=[much, little]))
    closes = {much.candidate.key: DECISION.asked_for, little.candidate.key: 0.9 * DECISION.asked_for}
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (0, np.array([0.0]), [True]))
    monkeypatch.setattr(deciding, "others_than", lambda *_: ())
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: True)
    monkeypatch.setattr(deciding, "answer_set", lambda part, term: "set")
    proposed, h = SimpleNamespace(located="where", drive=None), hypothesis([much.candidate, little.candidate])
    for joints, stated in ((True, [much]), (False, [much, little])):
        trial = Trial(Proposal(None, best, joints=joints), h, {}, np.zeros((1, 1)), np.zeros(1), closes)
        found = deciding.decide(SimpleNamespace(proposed=proposed, trials=(trial,), untried=(), asked=None))
        assert list(found.sets) == [a.candidate.key for a in stated]


def test_the_fit_of_the_standard_joints_speaks_for_no_combination_of_the_same_names(monkeypatch):
    """It has more numbers than names: what the simulation says of it is not said of these."""
    friction, stribeck = atom("friction"), atom("stribeck")
    best, other = (SimpleNamespace(fit=SimpleNamespace(terms=[a])) for a in (friction, stribeck))
    proposals = [Proposal(None, best), Proposal(None, best, joints=True), Proposal(None, other, joints=True)]
    trials = tuple(Trial(p, hypothesis([friction.candidate]), {}, np.zeros((1, 1)), np.zeros(1)) for p in proposals)
    monkeypatch.setattr(deciding, "decided_by", lambda trials: (0, np.array([0.0, 10.0, 0.0]), [True, False, True]))
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: True)
    monkeypatch.setattr(deciding, "answer_set", lambda part, term: "set")
    proposed = SimpleNamespace(located="where", drive=None)
    found = deciding.decide(SimpleNamespace(proposed=proposed, trials=trials, untried=(), asked=None))
    assert found.trial.proposal.simulated == {frozenset({friction.candidate.key}): 0.0}
    assert found.trial.proposal.others == ()


def few_and_many(few=0.3, many=0.1, offered=("friction", "inertia"), named=("friction",), kept=("friction",)):
    """What the torques speak for first and second, and what the motion asks for, which leave shares of the error."""
    rich = hypothesis([SimpleNamespace(key=("friction", "hip")), SimpleNamespace(key=("inertia", "hip"))])
    best = SimpleNamespace(fit=SimpleNamespace(terms=[atom(name) for name in named]))
    motion = Proposal(None, best, motion=True, offered=frozenset((name, "hip") for name in offered))
    sparse = hypothesis([SimpleNamespace(key=(name, "hip")) for name in kept])
    parts = ((Proposal(None, None), rich, many), (Proposal(None, None), rich, many), (motion, sparse, few))
    return [Trial(p, f, {"train": leaving(left)}, np.zeros((1, 1)), np.zeros(1)) for p, f, left in parts]


@pytest.mark.parametrize(
    ("change", "takes"),
    [
        ({}, True),
        ({"few": 0.54}, True),
        ({"few": 0.56}, False),  # less than half of the nine tenths that more effects close
        ({"many": 0.9, "few": 0.94}, True),
        ({"many": 0.01, "few": 0.4}, True),
        ({"offered": ("friction",)}, False),  # what the torques name was not offered
        ({"offered": ()}, False),  # nor was anything, as there was no time to ask for all
        ({"named": ()}, False),  # the torques show none of it, so that it has no names
        ({"kept": ()}, False),  # all of it is within its tolerance
        ({"named": ("inertia",)}, False),
    ],
)
def test_few_effects_of_the_motion_take_the_place_of_many_that_were_offered_to_it(change, takes):
    trials = few_and_many(**change)
    for spoken_for in (0, 1):
        assert deciding.fewest(spoken_for, trials) == (2 if takes else spoken_for)
    assert deciding.fewest(2, trials) == 2
    assert deciding.fewest(1, trials[:2]) == 1  # where nothing was asked


@pytest.mark.parametrize(
    ("reach", "few", "many", "takes"),
    [
        (20.0, 10.0, 4.1, True),
        (20.0, 10.0, 3.9, False),  # more than 2.5 times the error of what follows
        (50.0, 10.0, 3.9, True),  # the given model does not fall
        (20.0, 2.4, 0.5, True),  # what is below the floor is followed, and the floor is the larger one of both
        (20.0, 2.6, 0.0, False),
    ],
)
def test_of_a_model_that_falls_few_effects_take_the_place_only_of_what_follows_no_better(reach, few, many, takes):
    def score_of(error, floor):
        joint = {"before": 50.0, "before_within_reach": reach, "after": error, "floor": floor}
        return {"train": Score(1.0, 1.0, 1.0, 0.0, {f"joint{k}": joint for k in range(2)})}

    *torques, motion = few_and_many()
    trials = [replace(t, scores=score_of(many, 0.1)) for t in torques]
    trials.append(replace(motion, scores=score_of(few, 1.0)))
    assert deciding.fewest(0, trials) == (2 if takes else 0)


@pytest.mark.parametrize(("preferred", "spoken_for"), [(0, 0), (1, 1), (2, 1)])
def test_the_torques_behind_few_effects_are_the_best_of_theirs_whatever_the_simulation_prefers(
    monkeypatch, preferred, spoken_for
):
    """Of theirs alone the second is best where the simulation prefers what it has chosen itself."""
    trials = tuple(few_and_many())
    for t, name in zip(trials, ("zero", "one"), strict=False):
        object.__setattr__(t.proposal, "best", SimpleNamespace(fit=SimpleNamespace(terms=[atom(name)])))
    told = lambda some: (preferred if len(some) == 3 else spoken_for, np.zeros(len(some)), [True] * len(some))  # noqa: E731
    monkeypatch.setattr(deciding, "decided_by", told)
    monkeypatch.setattr(deciding, "torque_is_open", lambda trial: False)
    monkeypatch.setattr(deciding, "answer_set", lambda part, term: ())
    proposed = SimpleNamespace(located=None, drive=None)
    found = deciding.decide(SimpleNamespace(proposed=proposed, trials=trials, untried=(), asked={"asked": 0.5}))
    assert found.trial.proposal.motion
    assert found.trial.proposal.torques.best is trials[spoken_for].proposal.best
    assert found.asked == {"asked": 0.5}
    assert set(found.trial.proposal.simulated) == {frozenset({("zero", "hip")}), frozenset({("one", "hip")})}
