"""Every number by which a diagnosis decides, with its unit, its kind and where it comes from.

Kinds: *statistical* numbers follow from a rule of inference; *physical* ones from machines, sensors or the simulator;
*tuned* ones were chosen on tuning cases of the proof; *budget* ones trade time or memory for thoroughness; *measured*
ones were measured; *contract* ones are part of what the output promises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Torques:
    """Numbers of the torque domain."""

    block: float = 1.0
    """Length of a block of samples that is resampled together [s; statistical]."""
    stretch: float = 2.0
    """Least length of a stretch with an error level of its own [s; statistical]."""
    most_stretches: int = 48
    """Stretches of all recordings together [1; budget]."""
    diverged: float = 1e15
    """Prediction of a unit of a coefficient, over the noise, beyond which an equation of motion has run away [1;
    physical]."""
    torque_floor: float = 0.001
    """Missing torque that nobody needs explained, as a share of the joint's typical torque [1; physical]."""
    bins: int = 10
    """Bins of a map of the missing torque [1; budget]."""
    replicates: int = 200
    """Replicates of a bootstrap of blocks [1; budget]."""


@dataclass(frozen=True)
class Search:
    """Numbers of the search for combinations."""

    open: float = 1.25
    """Mean square of the normalised missing torque above which a joint misses something. Sensor noise alone gives
    about 1 [1; statistical]."""
    chance: float = 4.0
    """Standard deviations of a stretch's mean square that chance is allowed [standard deviations; statistical]."""
    beam: int = 4
    """Combinations that are kept at each depth [1; budget]."""
    most_per_joint: int = 4
    """Effects of a joint [1; budget]."""
    decisive: float = 10.0
    """Evidence that a term must bring, and within which the simulation decides: odds of 150 to 1 [twice the log odds;
    statistical]."""
    term: float = float(2 * np.log(20.0))
    """Evidence against each term: of the catalogue's effects one or two are missing, not most [twice the log odds;
    statistical]."""
    rival_price: float = 2.0
    """Price of a parameter among rivals (Akaike 1974): whatever fits as well may be true, also if it has a number more
    [twice the log odds; statistical]."""
    material: float = 0.1
    """Share of what is still open on its joints that a term must close [1; tuned]."""
    accuracy: float = 0.01
    """Error of a right law, of the torque that is missing without it: below, evidence speaks of tangents and time
    steps [1; physical]."""
    richer: float = 0.25
    """Share of what is open that an effect must close beyond a simpler one that it contains [1; tuned]."""
    all: float = 0.95
    """Share of what is open from which on an effect explains all: a bearing that differs from a formula is no other
    formula to the noise [1; tuned]."""
    sided: float = 0.2
    """Relative difference of what simpler laws have equal, such as friction's two directions: a bearing that differs
    from its formula does so alike both ways [1; tuned]."""
    seen: float = 0.05
    """Share of what is open, or of the evidence, from which on the simulation is asked whether the richer law is the
    true one [1; tuned]."""
    invariant: float = 0.4
    """Relative scatter between stretches of the recordings up to which a term is the same physics everywhere [1;
    tuned]."""
    much: float = 0.3
    """Share of a joint's missing torque that a term must account for to stay without that [1; tuned]."""
    steady: float = 0.1
    """Relative scatter between takes of a term that is no larger than what another may leave [1; tuned]."""
    reweighted: int = 2
    """Rounds of least squares with the joints weighed by what the last one left [1; budget]."""
    shortlist: int = 2
    """Points of a nonlinear grid that are weighed for each candidate, the best by what they would close alone [1;
    budget]."""
    promising: int = 10
    """Candidates beside a combination that are weighed in full [1; budget]."""
    refined: int = 4
    """Rivals of a term, the nearest, whose nonlinear parameters are found as finely as its own [1; budget]."""
    finest: float = 0.02
    """Relative step below which the simulation's fit finds a nonlinear parameter better [1; budget]."""
    folds: int = 5
    """Parts of the recordings, each of which is predicted from the others [1; budget]."""
    predictable: float = 0.1
    """Share of the missing torque that must be predictable for it to count as something missing rather than noise [1;
    tuned]."""
    parts: int = 6
    """Parts that fewer than three takes are cut into to see whether a term holds everywhere [1; budget]."""


@dataclass(frozen=True)
class Simulation:
    """Numbers of fits and scores in the simulation."""

    window: float = 0.5
    """Length of the windows that scores are stated for [s; contract]."""
    fallen: float = 1.0
    """Error of a window from which on a simulation has left the recording, if it moves no further: more is no worse
    [rad, m; physical]."""
    drift: float = 5.0
    """End-to-end error over a window's error up to which a take is fitted end to end [1; tuned]."""
    acts: float = 0.5
    """Motion that a term makes, over the error that is left in a window, from which on the term acts there
    [1; tuned]."""
    helps: float = 0.3
    """Share of that motion which must be error without the term; of a true term all is [1; tuned]."""
    leaves: float = 0.3
    """Share of a window's error that a term may leave to be needed for that window alone [1; tuned]."""
    telling: int = 4
    """Windows of a fit in which a term acts most, beside those drawn at random [1; budget]."""
    looked_at: int = 1000
    """Windows among which those are looked for in which a term acts, as many as 500 s have; a third of them where a
    controller closes the loop, step by step [1; budget]."""
    at_once: int = 200
    """Windows that are simulated at a time: bounds the memory [1; budget]."""
    windows: int = 400
    """Windows that a score is stated over, as many as 200 s have; more are thinned at random [1; budget]."""
    weighed: int = 4000
    """Simulated windows by which is weighed what each term closes: of many terms, each in fewer windows [1; budget]."""
    between: float = 60.0
    """Time that is put between recordings, and between the pieces of one that drop-outs have cut [s; physical]."""
    samples: int = 200
    """Draws from the intervals of a fit [1; budget]."""


@dataclass(frozen=True)
class Decision:
    """Numbers by which torques and simulation decide together."""

    most_fits: int = 4
    """Combinations that the simulation is asked about at first [1; budget]."""
    few: float = 0.5
    """Share of what the torques' combination closes of the error energy that the few effects of the motion must close
    to give the names in its place [1; tuned]."""
    asked: float = 6.0
    """Evidence behind which a rival is not asked about in the simulation: a twentieth of the odds [twice the log odds;
    statistical]."""
    lost: float = 0.5
    """Share of the error energy that the best may leave before each effect is asked about alone, and that what is
    refuted by few windows leaves [1; tuned]."""
    follows: float = 2.5
    """Error of a window over the floor, or over another trial's, from which on a motion is not followed [1; tuned]."""
    closed: float = 0.01
    """Share of the error energy below which the fit of the standard joints, which takes minutes, is not asked for: the
    error has fallen to a tenth without it [1; budget]."""
    alone: int = 2
    """Effects that are asked about alone at a time [1; budget]."""
    behind: float = 9.0
    """Evidence against what was not proposed first: only a simulation that is decisively better speaks for it [twice
    the log odds; statistical]."""
    asked_for: float = 0.05
    """Share of the simulation's error that a number of a standard joint has to close to be a finding [1; budget]."""
    worth: float = 0.1
    """Share of its tolerance that a trim must use in the torque domain to be adjusted in the simulation [1; tuned]."""
    clear: float = 0.1
    """Share of the error energy that one may leave to refute, by few windows, those that leave :attr:`lost` [1;
    tuned]."""
    occasions: float = 2.0
    """Between windows that see two occasions: one blow may be felt that long [s; physical]."""
    equally_good: float = 0.05
    """Difference of the logarithm of the windows' error below which two fits are equally good [nat; tuned]."""


@dataclass(frozen=True)
class Statement:
    """Numbers of what may be said."""

    exercised: float = 0.02
    """Share of usable instants below which a joint counts as not exercised [1; tuned]."""
    likely: float = 0.5
    """Above it a finding is stated as likely; an explanation may rest on no finding that is less probable, its rivals
    included [1; statistical]."""
    explained: float = 0.05
    """Share of the error energy above the floor that may be left by an explanation [1; tuned]."""
    partly: float = 0.8
    """Above this share nothing worth the name is explained [1; tuned]."""
    near_floor: float = 8.0
    """Window error over the floor up to which a model without predictable missing torque is called complete, and one
    with findings explained: whatever was gross before, what is left beyond it shows that a law is another [1;
    tuned]."""
    at_floor: float = 1.5
    """Window error over the floor from which on a model that nothing is missing from is not said to follow as closely
    as noise allows [1; contract]."""
    kept: float = 0.1
    """Share of the given model's window error that a right law may leave, however many times the floor that is, since
    bearings are no formulas. Beyond it and beyond :attr:`near_floor` the simulation is far off, and names are doubted
    [1; tuned]."""
    shown: float = 1.5
    """Window error of the given model over the floor below which the simulation shows nothing of a gear [1; tuned]."""
    same_number: float = 0.05
    """Relative difference below which two numbers of a law are the same [1; tuned]."""
    told: float = 0.05
    """Probability of a class below which the summary counts it and does not tell it [1; budget]."""
    least_share: float = 0.03
    """Share of the evidence below which rivals are not printed [1; budget]."""
    refutes: float = 0.75
    """Share of the evidence from which rivals count as refuted: odds below three to one are "not worth more than a
    bare mention" (Kass, Raftery 1995, doi:10.1080/01621459.1995.10476572) [1; statistical]."""
    refused: float = 0.1
    """The most of a finding with which recordings kept aside are followed worse: of 34 such findings of tuning cases
    and a spent sealed seed two were right [1; tuned]."""
    senseless: float = 0.2
    """The most of a finding that makes no sense as it stands: a motor at the end of what may be, a gear seen in noise
    [1; tuned]."""


@dataclass(frozen=True)
class Plan:
    """Numbers of a planned experiment."""

    enough: float = 12.0
    """Standard deviations beyond which rivals need not be farther apart: odds of e to the 72, were the noise all
    [standard deviations; statistical]."""
    every: int = 4
    """Every fourth instant of the torque domain is nearly independent of the next: the rest costs time only [1;
    budget]."""
    draws: int = 6
    """Parameter sets of each rival, as uncertain as the recordings leave them [1; budget]."""
    unseen: float = 10.0
    """Standard deviation of a parameter that the recordings do not show, in units of its scale
    [scales; statistical]."""
    rate: float = 200.0
    """Rate of the command [Hz; budget]."""
    margin: float = 0.9
    """Share of a limit that a motion may use [1; physical]."""
    motions: int = 60
    """Motions that are tried at most [1; budget]."""
    slowest: float = 0.2
    """Lowest frequency of a mix [Hz; physical]."""
    seconds: float = 8.0
    """Length of the excitation, without the ways there and back [s; budget]."""
    apart: float = 3.0
    """Standard deviations that separate a pair; one that no plan sets so far apart is not what a plan is chosen for
    [standard deviations; statistical]."""
    spare: float = 9.0
    """Standard deviations up to which a plan is repeated: it is a mean, of which the worse half should do as well
    [standard deviations; statistical]."""
    followers: int = 10
    """Motions that are tried as the second of two [1; budget]."""
    confirmed: int = 5
    """Plans that are simulated under every rival before none is proposed [1; budget]."""
    longest: float = 60.0
    """An excitation that tells too little is repeated as long as it all lasts no longer than this [s; budget]."""
    slack: float = 0.02
    """Share of range and speed by which a rival may predict that the robot leaves them: they are clear of the stops
    [1; physical]."""
    gentle: float = 0.2
    """Share of its worth that a plan loses by using up all limits, the whole band and half a minute [1; tuned]."""
    heavy: float = 0.5
    """Mass to fasten to the last link where motions alone tell too little, as a share of its own [1; physical]."""
    bandwidth: float = 1.5
    """Natural frequency of the position loop where the recordings state no gains. Soft, because a drive that is half a
    millisecond late makes friction of its stiffness, kp times that, which nobody logs [Hz; physical]."""


@dataclass(frozen=True)
class Spending:
    """What a run may spend."""

    fixed: float = 0.7 * 2.0**30
    """Memory of a diagnosis of a short log, libraries included [B; measured]."""
    per_second: float = 4e5
    """Memory for each second of each joint: predictions of all effects on the grid of the torque domain
    [B; measured]."""
    per_sample: float = 600.0
    """Memory for each sample of each joint, as recorded and as replayed [B; measured]."""
    stretch: float = 20.0
    """Length of the stretches that are kept of a log that is too long: two slow periods of most motions
    [s; physical]."""
    least: float = 0.1 * 2.0**30
    """Memory for data that is taken in any case [B; budget]."""
    shortest: float = 5.0
    """Least that is kept of a recording, if it is so long [s; physical]."""
    share: float = 0.5
    """Share of the free memory that is taken unless told otherwise [1; budget]."""
    to_propose: float = 0.3
    """Share of the time budget after which the search of the torques goes no further [1; budget]."""
    to_try: float = 0.4
    """Share of it after which the standard joints come before a further combination [1; budget]."""
    to_select: float = 0.55
    """Share of it after which the motion is asked for no further effect [1; budget]."""
    to_fit: float = 0.6
    """Share of it after which no fit begins [1; budget]."""
    to_fit_joints: float = 0.75
    """Share of it after which that of the standard joints comes to an end [1; budget]."""
    to_find: float = 0.85
    """Share of the time budget after which what was found is stated [1; budget]."""
    telling: float = 4.0
    """Time that is kept for saying it, however short the budget is [s; measured]."""
    to_tell: float = 0.97
    """Share of it after which it is told without pictures [1; budget]."""


TORQUES = Torques()
SEARCH = Search()
SIMULATION = Simulation()
DECISION = Decision()
STATEMENT = Statement()
PLAN = Plan()
SPENDING = Spending()
