"""The steps of a search, each with evidence that is told: which combination it keeps follows by hand."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.columns import Given, Shifted, candidate

from torchrl_athletic.diagnosis import search as steps
from torchrl_athletic.diagnosis.screen import Atom, Candidate
from torchrl_athletic.diagnosis.search import Scored, search
from torchrl_athletic.diagnosis.thresholds import SEARCH


def law(name: str, joint: int | None = 0, numbers: int = 1, excludes: str = "", contains: str = "") -> Atom:
    """An effect of so many numbers; of the whole robot where its joint is None."""
    effect = Given(name, np.zeros((1, numbers)), excludes=tuple(excludes))
    effect.special_cases = frozenset(contains)  # type: ignore[misc]
    own = candidate(effect, joint or 0)
    return Atom(own if joint is not None else replace(own, joint_name=None), {}, tuple(range(numbers)), (0,))


def names(combination: Scored | SimpleNamespace | Sequence[Atom]) -> str:
    """One letter a term, in order of the alphabet."""
    terms = combination.fit.terms if isinstance(combination, Scored) else getattr(combination, "terms", combination)
    return "".join(sorted(atom.candidate.effect.name for atom in terms))


class Told:
    """A judge that is told evidence by names, and what else a step asks for; what it is not told of is hopeless."""

    def __init__(
        self,
        evidence: Mapping[str, Any],
        *atoms: Atom,
        promise: Mapping[str, float] | None = None,
        closes: Mapping[tuple[str, str], float] | None = None,
        strain: Mapping[str, float] | None = None,
        is_open: Mapping[str, tuple[bool, bool]] | None = None,
        unhelpful: Sequence[str] = (),
        reached: Mapping[str, tuple[int, ...]] | None = None,
        left: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.evidence, self.promised = dict(evidence), promise or {}
        self.shares, self.strain, self.opened = closes or {}, strain or {}, is_open or {}
        self.unhelpful, self.left, self.made = unhelpful, left or {}, {}
        self.atoms = {atom.candidate.effect.name: atom for atom in atoms}
        self.bank = SimpleNamespace(
            atoms=list(atoms),
            joints=2,
            add_all=self.add_all,
            gains=lambda fit, level, among: {},
            is_shelved=lambda atom: False,
            is_coupled=lambda atom: len((reached or {}).get(atom.candidate.effect.name, ())) > 1,
            reaches=lambda atom, joint: joint in (reached or {}).get(atom.candidate.effect.name, ()),
        )
        self.total = self.independent = np.ones((2, 1))
        self.bare = SimpleNamespace(terms=(), strain=0.0, bare=True)

    def __getitem__(self, wanted: str) -> Scored:
        return self.score([self.atoms[name] for name in wanted])

    def score(self, atoms: Sequence[Atom]) -> Scored:
        key = frozenset(atoms)
        if key not in self.made:
            own = names(atoms)
            fit = SimpleNamespace(terms=tuple(atoms), strain=self.strain.get(own, 0.0))
            self.made[key] = Scored(fit, self._told(atoms))
        return self.made[key]

    def _told(self, atoms: Sequence[Atom]) -> float:
        told = self.evidence.get(names(atoms), 1e3)
        return told({a.candidate.effect.name: a.fixed for a in atoms}) if callable(told) else told

    def promise(self, atoms: Sequence[Atom], parent: SimpleNamespace) -> float:
        return self.promised.get(names(atoms), self._told(atoms))

    def add_all(self, of: Candidate, grid: Sequence[Mapping[str, float]]) -> list[Atom]:
        new = [Atom(of, fixed, (), ()) for fixed in grid]
        self.bank.atoms.extend(new)
        return new

    def excess(self, fit: SimpleNamespace) -> np.ndarray:
        return np.array(self.left.get("bare" if hasattr(fit, "bare") else names(fit), (0.0, 0.0)))

    def closes(self, before: SimpleNamespace, after: SimpleNamespace) -> float:
        return self.shares.get((names(before), names(after)), 1.0)

    def helps(self, before: SimpleNamespace, after: SimpleNamespace) -> bool:
        return names(after) not in self.unhelpful

    def is_open(self, fit: SimpleNamespace) -> np.ndarray:
        return np.array(self.opened.get("bare" if hasattr(fit, "bare") else names(fit), (True, True)))

    def level(self, fit: SimpleNamespace) -> np.ndarray:
        return np.ones((2, 1))


@pytest.fixture
def steady(monkeypatch):
    """Every term has the same strength everywhere."""
    monkeypatch.setattr(steps, "scatter", lambda bank, fit, term: 0.0)


A, B, C, D = (law(name) for name in "abcd")


@pytest.mark.parametrize(
    ("evidence", "promise", "start", "kept"),
    [
        ({"a": -10.0, "b": -10.5}, {}, "a", "a"),  # less than one is no gain
        ({"a": -10.0, "b": -10.5}, {"b": 0.0}, "a", "a"),  # whichever is tried last
        ({"a": -10.0, "b": -12.0}, {}, "a", "b"),
        ({"a": -10.0, "b": -30.0, "c": -20.0}, {}, "a", "b"),  # the best of all that gain
        ({"a": -10.0, "b": 0.0, "c": -20.0}, {"b": -99.0}, "a", "c"),  # what promises most may not keep it
        ({"ab": -10.0, "bc": -20.0, "cd": -40.0, "ad": 0.0, "bd": 0.0, "ac": 0.0}, {}, "ab", "cd"),  # one by one
    ],
)
def test_a_term_is_exchanged_for_what_gains_most_until_nothing_gains(evidence, promise, start, kept):
    told = Told(evidence, A, B, C, D, promise=promise)
    assert names(steps._exchange(told, told[start])) == kept


@pytest.mark.parametrize(
    ("own", "reached", "kept"),
    [
        (True, {"a": (0,)}, "a"),
        (True, {"a": (0, 1)}, "b"),
        (False, {"a": (0,)}, "b"),
        (True, {"a": (0,), "b": (0, 1)}, "b"),  # a shaft that gives is felt by the joints before it
    ],
)
def test_what_acts_on_its_own_joint_alone_is_exchanged_for_what_reaches_that_joint(own, reached, kept):
    elsewhere = law("b", joint=1)
    elsewhere.candidate.effect.own_joint = own  # type: ignore[misc]
    told = Told({"a": -10.0, "b": -20.0}, A, elsewhere, reached=reached)
    assert names(steps._exchange(told, told["a"])) == kept


@pytest.mark.parametrize(
    ("two", "other", "kept"), [(-20.0, 0.0, "ab"), (-10.5, 0.0, "w"), (-20.0, -30.0, "c"), (-30.0, -20.0, "ab")]
)
def test_a_term_is_exchanged_for_two_simpler_ones_that_it_excludes_where_these_gain(two, other, kept):
    evidence = {"": 0.0, "w": -10.0, "a": -5.0, "b": -1.0, "ab": two, "c": other}
    told = Told(evidence, law("w", numbers=3, excludes="ab"), A, B, law("c", excludes="ab"))
    assert names(steps._exchange(told, told["w"])) == kept


ELSEWHERE, RICH, OTHER = law("b", joint=1), law("b", numbers=2), law("x")


@pytest.mark.parametrize(
    ("second", "kept"),
    [
        (B, "ab"),
        (ELSEWHERE, "a"),  # of another joint
        (RICH, "a"),  # as many numbers as the whole
        (OTHER, "a"),  # not asked about
        (law("b", excludes="a"), "a"),  # not beside the first
    ],
)
def test_a_law_is_split_into_two_simpler_ones_of_its_joint_that_may_stand_together(second, kept):
    told = Told({"": 0.0, "w": -10.0, "a": -5.0, "b": -1.0, "ab": -9.0, "ax": -9.0}, law("w", numbers=2), A, second)
    assert names(steps._split(told, told[""], told.atoms["w"], "ab")) == kept


def test_a_law_is_split_no_further_than_it_gains():
    told = Told({"": 0.0, "a": -5.0, "b": -6.0, "ab": -4.0}, law("w", numbers=2), A, B)
    assert names(steps._split(told, told[""], told.atoms["w"], "ab")) == "b"


def test_pairs_of_one_joint_are_merged_as_long_as_that_gains_and_pairs_of_two_joints_never():
    m, n = law("m", excludes="ab"), law("n", excludes="cd")
    told = Told({"abcd": -10.0, "cdm": -20.0, "abn": -15.0, "mn": -30.0}, A, B, C, D, m, n)
    assert names(steps._merge(told, told["abcd"])) == "mn"
    told = Told({"ab": -10.0, "m": -20.0}, A, ELSEWHERE, m)
    assert names(steps._merge(told, told["ab"])) == "ab"


def test_a_pair_is_merged_into_an_effect_of_its_own_joint():
    for joint, merged in ((0, "ab"), (1, "m")):
        told = Told({"ab": -10.0, "m": -20.0, "": 0.0}, law("a", joint), law("b", joint), law("m", joint=1))
        assert names(steps._merge(told, told["ab"])) == merged


def test_what_two_are_merged_into_is_judged_at_its_own_best_value():
    told = Told({"ab": -25.0, "l": lambda at: 100 * abs(at["l"]["delay"] - 0.3) - 30.0}, A, B, *grid_of("l", *DELAYS))
    assert points_of(steps._merge(told, told["ab"]))["l"] == {"delay": pytest.approx(0.3)}


def test_a_cause_of_the_whole_robot_takes_the_place_of_all_that_it_excludes():
    everywhere = law("w", joint=None, excludes="ab")
    told = Told({"abc": -10.0, "cw": -20.0}, A, ELSEWHERE, C, everywhere)
    assert names(steps._merge(told, told["abc"])) == "cw"


def test_each_law_gives_way_to_the_best_of_simpler_ones_unless_it_closes_more_or_relieves_trims():
    rich, richer = law("r", numbers=2, excludes="ab"), law("s", joint=1, numbers=2, excludes="cd")
    simple = (A, B, law("c", joint=1), law("d", joint=1))
    evidence = {"rs": -30.0, "as": -20.0, "bs": -25.0, "br": -99.0, "cr": -20.0, "dr": -26.0, "bc": -12.0, "bd": -15.0}
    little = {pair: 0.1 for pair in (("bs", "rs"), ("bd", "bs"), ("dr", "rs"))}
    told = Told(evidence, rich, richer, *simple, closes=little)
    assert names(steps._simplify(told, told["rs"])) == "bd"
    told = Told(evidence, rich, richer, *simple, closes=little, strain={"bs": 20.0, "dr": 20.0})
    assert names(steps._simplify(told, told["rs"])) == "rs"  # trims would have to make up for it


def test_a_law_gives_way_to_its_special_cases_unless_these_leave_more_to_the_trims():
    whole = law("w", numbers=3, contains="ab")
    evidence, little = {"": 0.0, "w": -30.0, "a": -5.0, "b": -1.0, "ab": -25.0}, {("ab", "w"): 0.1}
    for strain, kept in ((0.0, "ab"), (6.0, "w")):
        told = Told(evidence, whole, A, B, closes={**little, ("a", "w"): 1.0}, strain={"ab": strain})
        told.within_misfit = lambda before, after: False
        assert names(steps._simplify(told, told["w"])) == kept


def test_of_superfluous_terms_the_weakest_goes_first():
    told = Told({"abc": -30.0, "ab": -29.0, "ac": -25.0, "bc": 50.0, "a": 0.0, "b": 50.0, "c": 50.0}, A, B, C)
    assert names(steps._prune(told, told["abc"])) == "ab"


def test_what_may_stand_beside_a_combination_is_allowed_by_all_of_it_and_as_much_as_a_joint_may_have():
    few = [law(name) for name in "abcd"]
    more = [law("e"), law("f", joint=1), law("g", joint=1, excludes="f"), law("h", joint=None, excludes="a")]
    told = Told({}, *few, *more)
    assert [a.candidate.effect.name for a in steps._shortlist(told, told["abcd"])] == ["f", "g"]
    assert [a.candidate.effect.name for a in steps._shortlist(told, told["bf"])] == ["a", "c", "d", "e", "h"]


# --- which combinations grow ---


def grown(told: Told, parent: str) -> list[str]:
    return [names(s) for s in steps._extensions(told, told[parent])]


def test_what_grows_is_decisive_and_helps_best_first():
    evidence = {"a": 0.0, "ab": -20.0, "ac": -40.0, "ad": -5.0}
    assert grown(Told(evidence, A, B, C, D), "a") == ["ac", "ab"]
    assert grown(Told(evidence, A, B, C, D, unhelpful=["ac"]), "a") == ["ab"]


@pytest.mark.parametrize(
    ("of_parent", "strain", "reached", "expected"),
    [
        ((True, False), 0.0, {}, ["ab"]),
        ((True, False), 0.0, {"c": (0,)}, ["ac", "ab"]),  # felt where something is open
        ((True, False), 0.0, {"c": (1,)}, ["ab"]),
        ((True, True), 0.0, {}, ["ac", "ab"]),
        ((False, False), 0.0, {}, []),
        ((False, False), 20.0, {}, ["ac", "ab"]),  # trims may hide an effect
    ],
)
def test_effects_are_asked_about_that_act_where_something_is_open(of_parent, strain, reached, expected):
    evidence = {"a": 0.0, "ab": -20.0, "ac": -40.0}
    told = Told(
        evidence, A, B, law("c", joint=1), is_open={"a": of_parent}, strain={"a": strain}, reached=reached
    )  # bare, both joints are open
    assert grown(told, "a") == expected


def test_with_nothing_named_yet_a_joint_is_open_that_trims_alone_close():
    told = Told({"": 0.0, "a": -20.0}, A, is_open={"": (False, False), "bare": (True, False)})
    assert grown(told, "") == ["a"]


def test_what_grows_comes_by_its_evidence_and_not_by_what_it_promised():
    assert grown(Told({"": 100.0, "a": 50.0, "b": 40.0}, A, B, promise={"a": 1.0, "b": 2.0}), "") == ["b", "a"]


def test_of_a_grid_the_point_that_promises_most_is_weighed():
    late = candidate(Shifted("l", np.empty((0, 1))))
    points = [Atom(late, {"delay": x}, (), ()) for x in (0.1, 0.2, 0.4)]
    told = Told({}, *points)
    told.promise = lambda atoms, parent: abs(atoms[-1].fixed["delay"] - 0.2) if atoms[-1].fixed else 0.15
    chosen = steps._promising(told, told[""], [*points, A])
    assert [atom.fixed.get("delay") for atom in chosen] == [0.2, None]
    assert steps._promising(told, told[""], [A, *points], 1) == [points[1]]


# --- grids ---


def grid_of(name: str, *points: Mapping[str, float]) -> list[Atom]:
    late = candidate(Shifted(name, np.empty((0, 1))))
    return [Atom(late, point, (), ()) for point in points]


def points_of(found: Scored) -> dict[str, Mapping[str, float]]:
    return {a.candidate.effect.name: a.fixed for a in found.fit.terms}


DELAYS = tuple({"delay": x} for x in (0.1, 0.2, 0.4))


@pytest.mark.parametrize(("best", "expected"), [(0.27, 0.275), (0.33, 0.325), (0.09, 0.0875), (0.45, 0.45)])
def test_a_grid_is_gone_down_and_then_halved_three_times(best, expected):
    points = grid_of("l", *DELAYS)
    told = Told({"l": lambda at: abs(at["l"]["delay"] - best)}, *points)
    assert points_of(steps._refine(told, told.score(points[:1])))["l"]["delay"] == pytest.approx(expected)


@pytest.mark.usefixtures("steady")
def test_the_newest_term_is_refined_unless_another_is_named_and_at_the_end_all_are():
    one, other = grid_of("l", *DELAYS), grid_of("m", *DELAYS)
    told = Told(
        {"lm": lambda at: sum(abs(at[name]["delay"] - 0.4) for name in "lm") - 60, "l": 0.0, "m": 0.0, "": 0.0},
        *one,
        *other,
    )
    start = told.score([one[0], other[0]])
    for named, expected in ((None, (0.1, 0.4)), (one[0].candidate, (0.4, 0.1))):
        found = points_of(steps._refine(told, start, named))
        assert tuple(found[name]["delay"] for name in "lm") == expected
    found = points_of(steps._polish(told, start))
    assert [found[name]["delay"] for name in "lm"] == [0.4, 0.4]


@pytest.mark.parametrize(("creep", "found"), [(0.0, 0.4), (0.5, 0.1)])
def test_presliding_without_creep_is_no_parameter_and_yet_gone_down_on_its_grid(creep, found):
    points = grid_of("l", *({"delay": 0.2, "presliding": x, "creep": creep} for x in (0.1, 0.2, 0.4)))
    told = Told({"l": lambda at: abs(at["l"]["presliding"] - 0.35)}, *points)
    refined = points_of(steps._refine(told, told.score(points[:1])))["l"]
    assert refined["presliding"] == found
    assert {a.fixed["presliding"] for a in told.bank.atoms} == {0.1, 0.2, 0.4}


def test_only_points_that_differ_in_one_number_lie_on_a_line():
    points = grid_of("l", {"delay": 0.1, "other": 1.0}, {"delay": 0.2, "other": 1.0}, {"delay": 0.4, "other": 2.0})
    told = Told({"l": lambda at: -at["l"]["delay"]}, *points)
    down = steps._down(told, told.score(points[:1]), points[0].candidate, "delay")
    assert points_of(down)["l"] == {"delay": 0.2, "other": 1.0}


# --- what does not hold everywhere ---


@pytest.mark.parametrize(
    ("scatters", "left", "kept"),
    [
        ({"abc": {"b": 0.5, "c": 0.9}, "ab": {"b": 0.1}, "ac": {"c": 0.9}}, {}, "ab"),  # the worst goes first
        ({"abc": {"b": 0.3, "c": 0.3}}, {}, "abc"),
        ({"abc": {"a": 9.0}, "bc": {"b": 9.0, "c": 8.0}, "c": {"c": 9.0}}, {}, "c"),  # one stays
        ({"abc": {"a": 9.0, "b": 0.5}}, {"bc": (5.0, 0.0)}, "ac"),  # half of what is missing stays, and is asked once
        ({"abc": {"a": 9.0}}, {"bc": (2.0, 0.0)}, "bc"),  # a fifth goes, though it is all that is left
        ({"abc": {"a": 9.0}}, {"bc": (0.0, 5.0)}, "bc"),  # what it does elsewhere does not count
    ],
)
def test_terms_that_do_not_hold_everywhere_go_but_for_the_last_and_what_is_much(scatters, left, kept, monkeypatch):
    monkeypatch.setattr(
        steps, "scatter", lambda bank, fit, term: scatters.get(names(fit), {}).get(term.candidate.effect.name, 0.0)
    )
    told = Told({}, A, B, C, left={"bare": (10.0, 10.0), **left})
    assert names(steps._invariant(told, told["abc"])) == kept


@pytest.mark.parametrize(("missing", "kept"), [((10.0, 10.0), "aw"), ((10.0, 0.5), "a")])
def test_a_cause_of_the_whole_robot_stays_for_a_joint_that_misses_more_than_noise(missing, kept, monkeypatch):
    monkeypatch.setattr(steps, "scatter", lambda bank, fit, term: float(term.candidate.joint_name is None))
    everywhere = law("w", joint=None)
    told = Told({}, A, everywhere, left={"bare": missing, "a": (0.0, 0.45 * missing[1])})
    assert names(steps._invariant(told, told["aw"])) == kept


# --- all steps together ---


@pytest.mark.usefixtures("steady")
def test_what_is_superfluous_is_dropped_before_two_terms_are_merged():
    told = Told({"abc": -30.0, "ab": -29.0, "am": -31.0}, A, B, C, law("m", excludes="bc"))
    assert names(steps._polish(told, told["abc"])) == "ab"


@pytest.mark.usefixtures("steady")
def test_what_a_simpler_law_makes_superfluous_is_dropped():
    rich = law("r", numbers=2, excludes="a")
    evidence = {"br": -30.0, "r": -10.0, "b": 0.0, "ab": -20.0, "a": -19.5}
    told = Told(evidence, rich, A, B, closes={("ab", "br"): 0.1})
    assert names(steps._polish(told, told["br"])) == "a"


def test_a_richer_law_that_an_unsteady_term_kept_up_is_asked_about_again(monkeypatch):
    monkeypatch.setattr(steps, "scatter", lambda bank, fit, term: float(term.candidate.effect.name == "b"))
    evidence = {"br": -60.0, "r": -30.0, "b": 0.0, "ab": -40.0, "a": -25.0, "": 0.0}
    told = Told(evidence, law("r", numbers=2, excludes="a"), A, B, closes={("a", "r"): 0.1})
    assert names(steps._polish(told, told["br"])) == "a"


@pytest.mark.usefixtures("steady")
def test_a_beam_follows_several_combinations_and_the_best_end_comes_first():
    """What looks best alone ends first; the fourth best of effects alone ends best, the fifth is not followed."""
    alone = {"a": -100.0, "b": -90.0, "c": -80.0, "d": -70.0, "e": -60.0}
    ends = {"dx": -300.0, "ey": -900.0}
    atoms = [law(name, excludes="abcde".replace(name, "")) for name in "edcba"]
    told = Told({"": 0.0, **alone, **ends}, *atoms, law("x"), law("y"))
    found = search(told)
    assert [names(s) for s in found] == ["dx", "a"]
    assert [s.evidence for s in found] == [-300.0, -100.0]


@pytest.mark.usefixtures("steady")
@pytest.mark.parametrize(("late", "found"), [([False] * 9, "abc"), ([True] * 9, "a"), ([False, True, True], "ab")])
def test_in_a_hurry_a_search_ends_with_what_it_has_found_by_then(late, found):
    told = Told({"": 0.0, "a": -20.0, "ab": -40.0, "abc": -60.0}, A, B, C)
    late = iter(late)
    assert names(search(told, late=lambda: next(late))[0]) == found


@pytest.mark.parametrize(("polished", "found"), [(0, ["ab", "c"]), (1, ["a"]), (2, ["a", "c"])])
def test_what_is_not_polished_is_no_rival_of_what_is(monkeypatch, polished, found):
    """Polishing gives up what looks better than it is."""
    told = Told({"": 0.0, "a": -20.0, "ab": -40.0, "c": -30.0}, law("a", excludes="c"), B, law("c", excludes="ab"))
    done = []
    monkeypatch.setattr(steps, "_polish", lambda judge, s: done.append(s) or (told["a"] if names(s) == "ab" else s))
    in_beam = iter([False] * len(asked_in_beam(told)))
    assert sorted(map(names, search(told, late=lambda: next(in_beam, len(done) == polished)))) == found


def asked_in_beam(told: Told) -> list[int]:
    """How often a search asks for the time before it polishes."""
    asked: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "_polish", lambda judge, s: s)
        whole = search(told, late=lambda: bool(asked.append(1)))
    return asked[: len(asked) - len(whole)]


def test_in_a_hurry_nothing_is_polished(monkeypatch):
    monkeypatch.setattr(steps, "_polish", lambda judge, scored: pytest.fail("there is no time"))
    assert names(search(Told({"": 0.0, "a": -20.0}, A), late=lambda: True)[0]) == "a"


@pytest.mark.usefixtures("steady")
def test_a_combination_that_is_as_deep_as_may_be_is_found():
    depths = {"abcd"[:k]: -20.0 * k for k in range(5)}
    told = Told(depths, A, B, C, D)
    told.bank.joints = 1
    assert SEARCH.most_per_joint == 4
    assert [names(s) for s in search(told)] == ["abcd"]


def test_what_ends_as_the_same_names_is_told_once_as_the_better_of_the_two(monkeypatch):
    points = grid_of("l", *DELAYS)
    told = Told({"": 0.0, "a": -50.0, "b": -40.0, "l": lambda at: -at["l"]["delay"]}, A, law("b", excludes="a"))
    for better in "ab":
        monkeypatch.setattr(steps, "_polish", lambda judge, s, own=better: told.score([points[names(s) == own]]))
        (found,) = search(told)
        assert found.evidence == -0.2


@pytest.mark.usefixtures("steady")
def test_children_of_all_parents_are_compared_and_not_those_of_the_best_one_alone():
    alone = {"a": -100.0, "b": -90.0, "ap": -111.0, "aq": -112.0, "ar": -113.0, "as": -114.0}
    atoms = [law("a", excludes="bz"), law("b", excludes="apqrs"), *map(law, "pqrs"), law("z", excludes="apqrs")]
    assert names(search(Told({"": 0.0, **alone, "bz": -200.0}, *atoms))[0]) == "bz"


@pytest.mark.usefixtures("steady")
def test_a_combination_is_refined_before_it_grows_since_a_coarse_one_hides_weaker_effects():
    def of_both(at):
        return off(at) - (20.0 if off(at) < -49.0 else 5.0)

    def off(at):
        return 100 * abs(at["l"]["delay"] - 0.3) - 50.0

    told = Told({"": 0.0, "l": off, "al": of_both}, A, *grid_of("l", *DELAYS))
    assert names(search(told)[0]) == "al"


@pytest.mark.usefixtures("steady")
def test_at_the_end_two_terms_are_merged_into_one_that_explains_as_much():
    told = Told({"ab": -40.0, "m": -41.0, "a": 0.0, "b": 0.0}, A, B, law("m", excludes="ab"))
    assert names(steps._polish(told, told["ab"])) == "m"


def test_joints_that_are_open_with_the_trims_or_without_them_are_asked_about():
    """A trim may hide what one joint misses, and push what another one does."""
    near, far, still = law("n", 0), law("f", 1), law("s", 1)
    told = Told(
        {"": 100.0, "n": 50.0, "f": 60.0, "s": 99.0}, near, far, still,
        is_open={"": (False, True), "bare": (True, False)},
    )  # fmt: skip
    assert [names(s) for s in steps._extensions(told, told[""])] == ["n", "f"]


def test_samples_of_a_joint_are_thinned_alike_in_all_its_stretches_and_never_added_to():
    """Four hundred samples are thinned to two hundred; a hundred samples stay a hundred, and become no more."""
    bank = SimpleNamespace(rows=lambda fit: "rows", independent_samples=lambda rows: np.array([200.0, 500.0]))
    judge = SimpleNamespace(bank=bank, independent=np.array([[100.0, 300.0], [60.0, 40.0]]))
    found = steps._independent(judge, SimpleNamespace(fit=None))
    np.testing.assert_allclose(found, [[50.0, 150.0], [60.0, 40.0]])


@pytest.mark.parametrize(
    ("joint", "numbers", "whole"), [(0, 2, True), (1, 2, False), (None, 2, False), (0, 1, False), (0, 3, True)]
)
def test_a_law_has_a_simpler_one_in_it_on_its_own_joint_and_with_more_numbers(joint, numbers, whole):
    rich = law("r", joint, numbers, excludes="a", contains="a")
    assert steps._is_richer(rich, A) is whole
    assert steps._contains(rich, A) is steps._is_special(A, rich) is whole
    other = law("o", joint, numbers)
    assert not steps._contains(other, A)
    assert not steps._is_special(A, other)


@pytest.mark.parametrize("values", [(5.0, 3.0), (3.0, 5.0)])
def test_of_two_ways_to_one_combination_the_better_one_is_kept(values, monkeypatch):
    told = Told({"": 100.0}, A, B)
    one, other = Scored(told["a"].fit, 50.0), Scored(told["b"].fit, 51.0)
    both = [Scored(SimpleNamespace(terms=(A, B), strain=0.0), value) for value in values]
    ways = {"": [one, other], "a": both[:1], "b": both[1:], "ab": []}
    monkeypatch.setattr(steps, "_extensions", lambda judge, parent: ways[names(parent)])
    for step in ("_refine", "_polish"):
        monkeypatch.setattr(steps, step, lambda judge, scored: scored)
    assert [s.evidence for s in search(told)] == [3.0]


def test_every_term_of_a_combination_has_rivals_of_its_own(monkeypatch):
    told = Told({"ab": -50.0, "bc": -47.0, "ad": -48.0, "bd": -10.0}, A, B, C, D)
    best = told["ab"]
    others = {A: [best, told["bc"], told["bd"]], B: [best, told["ad"]]}
    monkeypatch.setattr(steps, "alternatives", lambda judge, best, term: others[term])
    assert [(names(s), behind) for s, behind in steps.rivals(told, best, within=6.0)] == [("ad", 2.0), ("bc", 3.0)]


def test_effects_alone_are_material_by_the_share_that_they_close():
    """What is not comes by its evidence."""
    shares = {"a": 1.1, "b": 1.2, "c": 0.9, "d": 0.8}
    told = Told({"": 100.0, "a": 1.0, "b": 2.0, "c": 4.0, "d": 3.0}, A, B, C, D,
                closes={("", name): share * SEARCH.material for name, share in shares.items()})  # fmt: skip
    for name in shares:
        told[name].fit.at_bound = False
    material, others = steps.singles(told)
    assert ([names(s) for s in material], [names(s) for s in others]) == (["b", "a"], ["d", "c"])


def test_any_combination_may_be_weighed_as_a_rival_is(monkeypatch):
    """By the samples that the best one's residual has, at the price of a rival."""
    monkeypatch.setattr(steps, "_independent", lambda judge, best: f"of {best}")
    judge = SimpleNamespace(score=lambda *given: given)
    assert steps.as_rival(judge, "the best", [A]) == ([A], "of the best", SEARCH.rival_price)


def test_the_alternatives_of_each_term_are_remembered_as_its_own(monkeypatch):
    asked = []
    monkeypatch.setattr(steps, "_alternatives", lambda judge, best, term: asked.append(term) or [term])
    judge, best = SimpleNamespace(_alternatives={}), SimpleNamespace(fit=SimpleNamespace(terms=(A, B)))
    assert [steps.alternatives(judge, best, term) for term in (A, B, A)] == [[A], [B], [A]]
    assert asked == [A, B]
