import warnings
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from diagnosis.columns import NAMES, STEP, signals
from diagnosis.plants import slider

from torchrl_athletic.diagnosis import locate as locating
from torchrl_athletic.diagnosis.locate import _binned, _said, feature, feature_unit, locate, regime_maps, regime_of
from torchrl_athletic.diagnosis.screen import Bank
from torchrl_athletic.effects import JointAddress

N = 3000
TIME = STEP * np.arange(N)
V = np.stack([np.sin(1.3 * TIME), np.cos(1.7 * TIME)], -1)
MOTION = {
    "position": np.stack([-np.cos(1.3 * TIME) / 1.3, np.sin(1.7 * TIME) / 1.7], -1),
    "velocity": V,
    "acceleration": np.stack([1.3 * np.cos(1.3 * TIME), -1.7 * np.sin(1.7 * TIME)], -1),
}
SPEEDS = np.abs(V)


def rng():
    return np.random.default_rng(0)


def bank_of(missing, **given) -> Bank:
    return Bank([signals(missing, **{**MOTION, **given})], [], noise=np.ones(2))


def at_elbow(torque):
    noise = np.random.default_rng(1).normal(size=(N, 2))
    return bank_of(np.stack([np.zeros(N), torque], -1) + noise)


def joints_and_regimes(found):
    return found[:2], found[2:]


def test_shares_of_the_joints_sum_to_one_and_come_largest_first():
    bank = bank_of(np.random.default_rng(0).normal(0, [3, 5], (N, 2)))
    joints, _ = joints_and_regimes(locate(bank, rng()))
    assert [x.regime for x in joints] == ["everywhere"] * 2
    assert {x.joint for x in joints} == set(NAMES)
    assert sum(x.share_of_error for x in joints) == pytest.approx(1)
    assert joints[0].share_of_error >= joints[1].share_of_error


def test_a_share_is_the_energy_of_the_acceleration_that_the_joints_own_missing_torque_would_cause():
    torque = np.tile([6.0, 4.0], (N, 1))
    bank = bank_of(torque)
    own = np.diagonal(bank.takes[0].inertia, axis1=1, axis2=2)
    energy = ((torque**2 - 1) / own**2).sum(0)
    joints, _ = joints_and_regimes(locate(bank, rng()))
    got = {x.joint: x.share_of_error for x in joints}
    assert [got[name] for name in NAMES] == pytest.approx(list(energy / energy.sum()))


def test_a_controllers_gains_hold_a_light_joint_back():
    """By hand: over half a second a gain of 80 N·m/rad and 2 N·m·s/rad are worth 11 kg·m²."""
    torque = np.tile([6.0, 4.0], (N, 1))
    (take,) = bank_of(torque).takes
    gains = {"kp": np.array([0.0, 80.0]), "kd": np.array([0.0, 2.0])}
    targets = replace(take.recording, torque_command=None, position_target=take.recording.position, **gains)
    servo = replace(take, recording=targets)
    joints, _ = joints_and_regimes(locate(Bank([servo], [], noise=np.ones(2)), rng()))
    own = np.diagonal(take.inertia, axis1=1, axis2=2) + np.array([0.0, 80 * 0.125 + 2 * 0.5])
    energy = ((torque**2 - 1) / own**2).sum(0)
    got = {x.joint: x.share_of_error for x in joints}
    assert [got[name] for name in NAMES] == pytest.approx(list(energy / energy.sum()))


@pytest.mark.parametrize("metre", [1.0, 100.0])
def test_shares_of_a_cart_and_its_pole_are_those_of_the_robot_whatever_its_unit_of_length(metre):
    """By hand: 2 N on 4 kg are 1 W/s, 6 N·m on 12 kg·m² are 3."""
    cart = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body><joint name="shoulder" type="slide" axis="1 0 0"/>
        <inertial pos="0 0 0" mass="4" diaginertia="1 1 1"/></body>
      <body><joint name="elbow" axis="0 1 0"/><inertial pos="0 0 0" mass="1"
        diaginertia="{12 * metre**2} {12 * metre**2} {12 * metre**2}"/></body></worldbody></mujoco>""")
    s = signals(np.tile([2 * metre, 6 * metre**2], (N, 1)), **MOTION)
    s = replace(s, model=cart, nominal=cart, address=JointAddress.of(cart, NAMES), noise=np.zeros(2))
    joints, _ = joints_and_regimes(locate(Bank([s], [], noise=np.ones(2)), rng()))
    assert [(x.joint, x.share_of_error) for x in joints] == [
        ("elbow", pytest.approx(0.75)), ("shoulder", pytest.approx(0.25))
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("torque", "regime"),
    [
        (np.where(V[:, 1] > 0, 6.0, 0.0), "moving forwards"),
        (np.where(V[:, 1] < 0, 6.0, 0.0), "moving backwards"),
        (np.where(SPEEDS[:, 1] > np.quantile(SPEEDS[:, 1], 2 / 3), 6.0, 0.0), "faster than 0.87 rad/s"),
        (np.where(SPEEDS[:, 1] < np.quantile(SPEEDS[:, 1], 1 / 3), 6.0, 0.0), "slower than 0.51 rad/s"),
        (np.where(MOTION["position"][:, 1] > 0.3, 6.0, 0.0), "position above 0.29 rad"),
        (np.where(TIME > 20, 6.0, 0.0), "in the last third of the take"),
        (np.where(TIME < 10, 6.0, 0.0), "in the first third of the take"),
    ],
)
def test_an_error_is_located_at_its_joint_and_in_its_regime(torque, regime):
    joints, regimes = joints_and_regimes(locate(at_elbow(torque), rng()))
    assert joints[0].joint == "elbow"
    assert joints[0].share_of_error > 0.95
    assert regime in [x.regime for x in regimes if x.joint == "elbow"][:3]


def test_errors_just_after_a_reversal_are_seen():
    turned = np.flatnonzero(np.diff(np.sign(V[:, 1]))) + 1
    since = np.min(np.where(np.arange(N) >= turned[:, None], np.arange(N) - turned[:, None], N), axis=0)
    _, regimes = joints_and_regimes(locate(at_elbow(np.where(since < 10, 9.0, 0.0)), rng()))
    assert regimes[0].joint == "elbow"
    assert regimes[0].regime == "just after a reversal"
    assert regimes[0].share_of_error > 0.8


def test_an_even_error_has_no_regime():
    _, regimes = joints_and_regimes(locate(bank_of(np.full((N, 2), 6.0)), rng()))
    assert not [x for x in regimes if x.share_of_error > 0.5]


def test_bands_hold_the_share_and_are_narrow_for_a_long_even_take():
    uneven = at_elbow(np.where(TIME < 1.5, 30.0, 1.5))
    for bank in (uneven, at_elbow(6 * V[:, 0])):
        for x in locate(bank, rng()):
            low, high = x.ci95
            assert 0 <= low <= x.share_of_error <= high <= 1
    wide, narrow = (
        next(np.ptp(x.ci95) for x in locate(bank, rng()) if x.regime == "moving forwards" and x.joint == "elbow")
        for bank in (
            at_elbow(np.where((V[:, 1] > 0) & (TIME < 4), 9.0, 0.5)),
            at_elbow(np.where(V[:, 1] > 0, 9.0, 0.5)),
        )
    )
    assert narrow < 0.1
    assert wide > narrow


def test_the_band_of_a_map_is_of_95_percent():
    """Over blocks that are drawn apart it is as wide as the band of a normal mean: 2 x 1.96 standard errors."""
    count = 400
    block = np.repeat(np.arange(count), 5)
    own = rng().normal(size=count)
    used = np.ones(block.size, dtype=bool)
    mean, band = _binned(own[block], np.zeros(block.size, dtype=np.intp), used, block, np.random.default_rng(1))
    assert mean[0] == pytest.approx(own.mean())
    assert np.ptp(band[0]) == pytest.approx(2 * 1.96 * own.std() / np.sqrt(count), rel=0.15)


def test_the_band_of_a_share_is_of_95_percent():
    """Blocks are as strong as each other, and half of them are the elbow's: resampled shares are a binomial's."""
    any_bank = bank_of(np.full((N, 2), 6.0))
    block, own = any_bank.block, np.diagonal(any_bank.takes[0].inertia, axis1=1, axis2=2)
    count = int(block[-1]) + 1
    of_elbow = rng().permutation(count) < count // 2
    bank = bank_of(np.where(of_elbow[block][:, None] == [False, True], 1000.0 * own, 0.0))
    drawn = [joints_and_regimes(locate(bank, np.random.default_rng(seed)))[0] for seed in range(8)]
    for joint in (0, 1):
        found = [joints[joint] for joints in drawn]
        assert found[0].share_of_error == pytest.approx(0.5, abs=0.1)
        assert np.mean([np.ptp(f.ci95) for f in found]) == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(count), rel=0.1)


def test_below_the_noise_there_is_nothing_to_locate_and_masked_rows_count_for_nothing():
    assert locate(bank_of(np.full((N, 2), 0.9)), rng()) == ()
    valid = np.tile([True, False], (N, 1))
    masked = Bank([signals(np.full((N, 2), 6.0), valid, **MOTION)], [], noise=np.ones(2))
    joints, _ = joints_and_regimes(locate(masked, rng()))
    assert [(x.joint, x.share_of_error) for x in joints] == [("shoulder", 1.0), ("elbow", 0.0)]


def test_the_same_seed_draws_the_same_bands():
    bank = at_elbow(6 * V[:, 0])
    assert locate(bank, rng()) == locate(bank, rng())


def test_what_lasts_most_of_the_time_is_no_regime_though_all_of_the_error_is_there():
    forwards = {"velocity": np.stack([np.ones(N), np.where(TIME < 22, 1.0, -1.0)], -1), "position": np.zeros((N, 2))}
    bank = bank_of(np.stack([0 * TIME, np.where(TIME < 22, 6.0, 0.0)], -1), **forwards)
    assert "moving forwards" not in {x.regime for x in locate(bank, rng(), most=99)}


def test_regimes_are_told_by_their_share_times_how_much_denser_than_elsewhere_they_are(monkeypatch):
    """Three tenths of the error in a tenth of the time tell more than nine tenths in six tenths of it."""
    row = np.arange(N)
    often, seldom = row < 0.6 * N, row < 0.1 * N
    share = np.where(seldom, 0.3 / 0.1, np.where(often, 0.6 / 0.5, 0.1 / 0.4))
    bank = bank_of(np.stack([0 * TIME, np.sqrt(1 + 50 * share)], -1))
    both = [("often", often), ("seldom", seldom)]
    monkeypatch.setattr(locating, "_regimes", lambda takes, joint: both if joint else [])
    _, regimes = joints_and_regimes(locate(bank, rng()))
    assert [(x.regime, x.joint) for x in regimes] == [("seldom", "elbow"), ("often", "elbow")]
    assert [x.share_of_error for x in regimes] == pytest.approx([0.3, 0.9], abs=0.01)


def test_no_more_regimes_than_asked_for():
    torque = np.where((V[:, 1] > 0) & (TIME < 10), 9.0, 0.0)
    assert len(locate(at_elbow(torque), rng(), most=2)) == 2 + 2


# --- maps ---


def test_a_map_shows_the_missing_torque_as_a_function_of_its_feature():
    left = np.zeros((N, 2))
    maps = {(m.joint, m.feature): m for m in regime_maps(bank_of(np.stack([0 * TIME, 2 * V[:, 1]], -1)), left, rng())}
    assert set(maps) >= {(j, f) for j in NAMES for f in ("speed", "position", "load", "acceleration", "time")}
    speed = maps["elbow", "speed"]
    np.testing.assert_allclose(speed.before, 2 * speed.centre, atol=0.08)
    np.testing.assert_allclose(speed.after, 0)
    assert speed.after.shape == speed.centre.shape
    assert speed.after_band.shape == speed.before_band.shape == (len(speed.centre), 2)
    assert (speed.before_band[:, 0] <= speed.before).all()
    assert (speed.before <= speed.before_band[:, 1]).all()
    assert (speed.unit, speed.torque_unit, speed.noise) == ("rad/s", "N·m", 1.0)
    np.testing.assert_allclose(maps["shoulder", "speed"].before, 0)


def test_the_noise_of_a_map_is_that_of_its_joint_the_mean_over_the_takes():
    take = signals(np.zeros((N, 2)), **MOTION)
    takes = [replace(take, noise=np.array(noise)) for noise in ([1.0, 3.0], [2.0, 5.0])]
    maps = regime_maps(Bank(takes, [], noise=np.ones(2)), np.zeros((2 * N, 2)), rng())
    assert {m.joint: m.noise for m in maps} == {"shoulder": 1.5, "elbow": 4.0}


def test_a_joint_that_hardly_ever_counts_has_no_map():
    valid = np.tile([True, False], (N, 1))
    masked = Bank([signals(np.ones((N, 2)), valid, **MOTION)], [], noise=np.ones(2))
    assert {m.joint for m in regime_maps(masked, np.zeros((N, 2)), rng())} == {"shoulder"}


# --- features and words ---


def test_features_run_along_all_takes():
    bank = Bank([signals(np.ones((N, 2)), **MOTION) for _ in range(2)], [], noise=np.ones(2))
    np.testing.assert_array_equal(feature(bank.takes, "speed", 1), np.tile(V[:, 1], 2))
    np.testing.assert_allclose(feature(bank.takes, "time", 0), np.tile(TIME, 2))
    s = bank.takes[0]
    assert [feature_unit(s, f, 0) for f in ("speed", "position", "load", "acceleration", "time")] == [
        *("rad/s", "rad", "N·m", "rad/s²", "s")
    ]


@pytest.mark.parametrize(
    ("explained", "name", "words"),
    [
        (V[:, 1] ** 3, "speed", "most at speeds above 0.87 rad/s: "),
        (np.sign(V[:, 1]), "speed", "at all speeds"),
        (np.where(np.abs(V[:, 1]) < 0.4, 1.0, 0.0), "speed", "most at speeds below 0.51 rad/s: 100 %"),
        (
            np.where(np.abs(SPEEDS[:, 1] - 0.7) < 0.1, 1.0, 0.0),
            "speed",
            "most at speeds from 0.51 to 0.87 rad/s: 100 %",
        ),
        (np.where(MOTION["position"][:, 1] > 0.3, 1.0, 0.0), "position", "most at positions above 0.29 rad: 100 %"),
        (MOTION["acceleration"][:, 1] ** 3, "acceleration", "most at accelerations above"),
        (0 * TIME, "speed", "everywhere"),
    ],
)
def test_where_an_effect_explains_most_is_said_in_words(explained, name, words):
    torque = np.stack([0 * TIME, explained], -1)
    assert regime_of(bank_of(torque), torque, 1, name).startswith(words)


def test_where_an_effect_predicts_twice_too_much_or_worse_it_explains_nothing():
    slow = SPEEDS[:, 1] < 0.4
    bank = bank_of(np.stack([0 * TIME, np.ones(N)], -1))
    for times, words in ((3.0, "most at speeds below 0.51 rad/s: 100 %"), (1.5, "at all speeds")):
        explained = np.stack([0 * TIME, np.where(slow, 1.0, times)], -1)
        assert regime_of(bank, explained, 1, "speed").startswith(words)
    assert regime_of(bank, np.full((N, 2), 2.1), 1, "speed") == "everywhere"


def signals_of(time, velocity):
    shape = np.stack([0 * time, velocity], 1)
    return SimpleNamespace(time=time, velocity=shape, position=shape, load=shape, acceleration=shape, command=shape)


def test_regimes_of_time_are_thirds_of_a_take_and_a_tenth_of_a_second_after_a_reversal(monkeypatch):
    monkeypatch.setattr(locating, "feature_unit", lambda s, name, joint: "u")
    time = 5.0 + np.arange(600) * 0.01
    velocity = np.where(np.arange(600) < 300, 1.0, -1.0) * (1 + 0.001 * np.arange(600))
    take = signals_of(time, velocity)
    inside = dict(locating._regimes([take], 1))
    assert np.flatnonzero(inside["in the first third of the take"]).tolist() == list(range(200))
    assert np.flatnonzero(inside["in the last third of the take"]).tolist() == list(range(400, 600))
    after = np.flatnonzero(inside["just after a reversal"])
    assert (after[0], len(after)) == (300, pytest.approx(10, abs=1))
    several = dict(locating._regimes([take, take], 1))
    assert not [name for name in several if "take" in name]
    assert np.flatnonzero(several["moving backwards"]).tolist() == [*range(300, 600), *range(900, 1200)]


# --- masked rows, slides, and what is too little to name ---


def test_features_are_those_of_their_joint_and_units_of_a_slide_are_of_a_slide():
    rows = rng().normal(size=(5, N, 2))
    names = ("position", "velocity", "acceleration", "command", "required")
    (s,) = takes = [signals(np.ones((N, 2)), **dict(zip(names, rows, strict=True)))]
    for joint in (0, 1):
        for name, told in (("speed", s.velocity), ("acceleration", s.acceleration), ("command", s.command)):
            np.testing.assert_array_equal(feature(takes, name, joint), told[:, joint])
        np.testing.assert_array_equal(feature(takes, "load", joint), s.load[:, joint])
        np.testing.assert_array_equal(feature(takes, "position", joint), s.position[:, joint])
    model = mujoco.MjModel.from_xml_string(slider())
    rail = SimpleNamespace(nominal=model, address=JointAddress.of(model, ("carriage",)))
    units = [feature_unit(rail, name, 0) for name in locating.FEATURES]
    assert units == ["m/s", "m", "N", "m/s²", "N", "s"]


def test_regimes_are_thirds_on_the_side_that_they_name(monkeypatch):
    """The thirds are of the magnitude of speed and acceleration, and of the signed position, load and command."""
    monkeypatch.setattr(locating, "feature_unit", lambda s, name, joint: "u")
    names = ("velocity", "position", "load", "acceleration", "command")
    columns = dict(zip(names, rng().normal(size=(5, 900, 2)), strict=True))
    take = SimpleNamespace(time=0.01 * np.arange(900), **columns)
    of = {"position": columns["position"], "load": columns["load"], "command": columns["command"]}
    of |= {"slower": np.abs(columns["velocity"]), "faster": np.abs(columns["velocity"])}
    of |= {"accelerating": np.abs(columns["acceleration"])}
    seen = []
    for label, inside in locating._regimes([take], 1):
        word = label.split()[0]
        if word not in of:
            continue
        seen.append(label.rpartition(" than ")[0] or label[: label.index(" ", label.index(" ") + 1)])
        x, number = of[word][:, 1], float(label.split()[-2])
        low = "below" in label or "slower" in label
        assert inside.mean() == pytest.approx(1 / 3, abs=0.01)
        assert (inside != ((x < number) if low else (x > number))).mean() < 0.01
    assert seen == ["slower", "faster", *(f"{n} {s}" for n in ("position", "load", "command")
                                          for s in ("below", "above")), "accelerating harder"]  # fmt: skip


def test_what_lasts_a_fiftieth_of_the_time_and_what_is_hardly_stronger_there_is_no_regime():
    turned = np.where(TIME < 20, 1.0, -1.0)
    velocity = {"velocity": np.stack([np.ones(N), turned], -1), "position": np.zeros((N, 2))}
    just_after = np.where((TIME >= 20) & (TIME < 20.1), 90.0, 0.0)  # 10 rows of 3000
    bank = bank_of(np.stack([0 * TIME, just_after], -1), **velocity)
    assert "just after a reversal" not in {x.regime for x in locate(bank, rng(), most=99)}
    uneven = {}
    for stronger in (1.08, 1.5):
        torque = np.where(V[:, 1] > 0, 6.0 * stronger, 6.0)
        found = locate(bank_of(np.stack([0 * TIME, torque], -1)), rng(), most=99)
        uneven[stronger] = any(x.regime == "moving forwards" and x.joint == "elbow" for x in found)
    assert uneven == {1.08: False, 1.5: True}


def test_where_nothing_counts_is_no_part_of_the_time_of_a_regime_nor_of_a_map():
    """The elbow is masked where it moves backwards or fast, so that it moved forwards all the time."""
    valid = np.stack([np.ones(N), (V[:, 1] > 0) & (V[:, 1] < 0.9)], -1).astype(bool)
    bank = Bank([signals(np.full((N, 2), 6.0), valid, **MOTION)], [], noise=np.ones(2))
    found = {x.regime for x in locate(bank, rng(), most=99) if x.joint == "elbow"}
    assert not found & {"moving forwards", "moving backwards"}
    maps = {m.feature: m for m in regime_maps(bank, np.zeros((N, 2)), rng()) if m.joint == "elbow"}
    assert 0.0 < maps["speed"].centre[0] < 0.1
    assert 0.8 < maps["speed"].centre[-1] < 0.9
    used = V[valid[:, 1], 1]
    fast = np.where(V[:, 1] > np.quantile(used, 2 / 3), 6.0, 0.0)
    torque = np.stack([0 * TIME, fast], -1)
    masked = Bank([signals(torque, valid, **MOTION)], [], noise=np.ones(2))
    words = f"most at speeds above {np.quantile(used, 2 / 3):.2g} rad/s: 100 %"
    assert regime_of(masked, torque, 1, "speed").startswith(words)


@pytest.mark.parametrize(("top", "words"), [(0.40, "at all speeds"), (0.52, "most at speeds above 0.87 rad/s: 5")])
def test_little_less_than_half_in_a_third_of_the_time_is_everywhere(top, words):
    cuts = np.quantile(SPEEDS[:, 1], [1 / 3, 2 / 3])
    share = np.where(SPEEDS[:, 1] > cuts[1], top, (1 - top) / 2)
    torque = np.stack([0 * TIME, 10 * np.sqrt(share)], -1)
    assert regime_of(bank_of(torque), torque, 1, "speed").startswith(words)


def test_a_map_after_the_correction_is_of_its_own_joint():
    left = np.stack([np.zeros(N), 3.0 * np.ones(N)], -1)
    for m in regime_maps(bank_of(np.full((N, 2), 6.0)), left, rng()):
        np.testing.assert_allclose(m.after, {"shoulder": 0.0, "elbow": 3.0}[m.joint])


def test_a_bin_with_two_rows_has_no_mean():
    index = np.repeat([0, 1, 2], [20, 2, 3]).astype(np.intp)
    used = np.ones(25, dtype=bool)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a bin without rows is nothing that a user could mend
        mean, band = _binned(np.ones(25), index, used, np.arange(25) // 5, rng())
    assert np.isfinite(mean[:4]).tolist() == [True, False, True, False]
    assert np.isfinite(band[:4]).all(1).tolist() == [True, False, True, False]


def test_the_noise_below_which_nothing_counts_is_the_mean_over_the_takes():
    take = signals(np.full((N, 2), 6.0), **MOTION)
    takes = [replace(take, noise=np.array(noise)) for noise in ([1.0, 1.0], [3.0, 1.0])]
    bank = Bank(takes, [], noise=np.ones(2))
    own = np.diagonal(take.inertia, axis1=1, axis2=2)
    energy = ((36.0 - np.array([2.0, 1.0]) ** 2) / own**2).sum(0)
    joints, _ = joints_and_regimes(locate(bank, rng()))
    got = {x.joint: x.share_of_error for x in joints}
    assert [got[name] for name in NAMES] == pytest.approx(list(energy / energy.sum()))


@pytest.mark.parametrize(
    ("edge", "said"), [(-4.3e-8, "0"), (0.0, "0"), (0.0019, "0"), (0.0021, "0.0021"), (-0.31, "-0.31")]
)
def test_an_edge_that_is_nothing_beside_the_range_is_zero(edge, said):
    assert _said(edge, np.array([-0.5, 0.0, 1.5])) == said
