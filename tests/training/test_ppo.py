import itertools
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RenameTransform
from training.tasks import arm_env, arm_learner

from torchrl_athletic.functional.phase import sled_phases
from torchrl_athletic.networks import RunningNormalizer, actor, critic
from torchrl_athletic.physics import CapacityError
from torchrl_athletic.training import FINE_TUNE, PPO, PRE_TRAIN, UAN, Learner, NonFiniteError, Processes, iterate, train
from torchrl_athletic.training.distributed import ALONE
from torchrl_athletic.training.ppo import collect, estimate_advantage

module = sys.modules["torchrl_athletic.training.ppo"]


@pytest.mark.parametrize(
    ("preset", "discount", "entropy", "horizon", "actor_minibatch", "critic_minibatch"),
    [
        (UAN, 0.995, 0.0, 96, 98_304, 393_216),
        (PRE_TRAIN, 0.99, 0.01, 24, 24_576, 98_304),
        (FINE_TUNE, 0.99, 0.0, 24, 24_576, 98_304),
    ],
    ids=["uan", "pre-train", "fine-tune"],
)
def test_presets_are_the_columns_of_the_papers_table(
    preset, discount, entropy, horizon, actor_minibatch, critic_minibatch
):
    samples = preset.num_envs * preset.horizon
    assert (preset.discount, preset.entropy_coeff, preset.horizon) == (discount, entropy, horizon)
    assert samples / preset.actor_minibatches == actor_minibatch
    assert samples / preset.critic_minibatches == critic_minibatch
    assert (preset.gae_lambda, preset.critic_lr, preset.kl_target) == (0.95, 5e-4, 0.01)
    assert (preset.num_envs, preset.epochs, preset.weight_decay) == (4096, 5, 0.01)


def test_an_iteration_learns_and_counts():
    learner = arm_learner()
    before = [parameter.clone() for parameter in learner.actor.parameters()]
    report = iterate(learner)
    assert learner.iteration == 1
    assert learner.samples == 2 * 4 * 6  # one batch more, for the scale of observations
    assert any((one != other).any() for one, other in zip(before, learner.actor.parameters(), strict=True))
    assert report["reward"] < 0
    iterate(learner)
    assert learner.samples == 3 * 4 * 6


def test_what_comes_before_the_first_update_is_counted_and_not_learnt_from():
    plain = arm_learner()
    for _ in range(3):  # episodes of the first stand where those of the second will begin
        collect(plain)
    first = iterate(plain)
    late = arm_learner()
    late.config = replace(late.config, warm_up=3)
    same = iterate(late)
    assert late.samples == plain.samples == 5 * 4 * 6
    assert same["reward"] == first["reward"]
    iterate(late)
    assert late.samples == 6 * 4 * 6


@pytest.mark.parametrize("coefficient", [0.0, 0.01, 0.3])
def test_entropy_counts_as_much_as_is_told(coefficient):
    policy = actor(7, 7, in_keys=["joint_position"], hidden=(16,))
    value = critic(7, in_keys=["joint_position"], hidden=(16,))
    learner = Learner(arm_env(4), policy, value, PPO(num_envs=4, horizon=6, epochs=1, entropy_coeff=coefficient))
    report = iterate(learner)
    torch.testing.assert_close(report["loss_entropy"], -coefficient * report["entropy"])


def test_the_divergence_aimed_at_falls_as_told_and_the_actors_rate_follows_it():
    torch.manual_seed(0)
    learner = arm_learner()
    learner.config = replace(learner.config, kl_target=0.02, kl_target_last=1e-12, anneal=3)
    rates, targets = [], []
    for _ in range(14):
        rates.append(float(iterate(learner)["actor_lr"]))
        targets.append(float(learner.kl_target))
    assert targets[:4] == pytest.approx([0.02, 0.02 * 2 / 3, 0.02 / 3, 1e-12])
    assert targets[4:] == pytest.approx([1e-12] * 10)
    assert rates[-1] == pytest.approx(learner.stepper.adaptive_kl.bounds[0])  # no step is short enough for that target


def test_the_first_rate_is_not_below_the_least():
    assert PPO(actor_lr=1e-5).least_actor_lr == 1e-5
    assert PPO(actor_lr=9e-6, least_actor_lr=1e-6).actor_lr == 9e-6
    with pytest.raises(ValueError, match=r"actor_lr is 9e-06, below least_actor_lr of 1e-05.*Lower least_actor_lr"):
        PPO(actor_lr=9e-6)


def test_a_divergence_that_falls_needs_its_end_and_its_time():
    with pytest.raises(ValueError, match="Give both, or none"):
        PPO(kl_target_last=0.002)
    with pytest.raises(ValueError, match="Give both, or none"):
        PPO(anneal=100)


def test_annealing_keeps_what_was_told_and_lets_the_rate_fall_too():
    ppo = PRE_TRAIN.annealed(100)
    assert ppo == replace(PRE_TRAIN, kl_target=0.02, kl_target_last=0.002, anneal=100, least_actor_lr=1e-6)
    falls, stays = replace(PRE_TRAIN, kl_target_last=0.005, anneal=7), replace(PRE_TRAIN, kl_target=0.005)
    assert (falls.annealed(100), stays.annealed(100)) == (falls, stays)


def test_each_entry_has_a_scale_of_its_own_and_every_one_learns():
    torch.manual_seed(0)
    scales = {"joint_position": RunningNormalizer(7), "joint_velocity": RunningNormalizer(7)}
    policy = actor(7, 7, in_keys=["joint_position"], hidden=(16,), normalizer=scales["joint_position"])
    value = critic(7, in_keys=["joint_velocity"], hidden=(16,), normalizer=scales["joint_velocity"])
    learner = Learner(arm_env(4), policy, value, PPO(num_envs=4, horizon=6, epochs=1), normalizer=scales)
    first = collect(learner).clone()
    learner.rollout, rollout = lambda: first.clone(), learner.rollout
    iterate(learner)
    for key, scale in scales.items():
        assert scale.count == 2 * 4 * 6  # a batch more at the very first
        torch.testing.assert_close(scale.mean, first[key].flatten(0, 1).mean(0))
    learner.rollout = rollout
    iterate(learner)
    assert [int(scale.count) for scale in scales.values()] == [3 * 4 * 6] * 2


def test_the_policy_that_learns_is_the_policy_that_acted():
    """The scale of observations changes after an update, before the next collection: the first step moves nothing."""
    learner = arm_learner()
    for _ in range(2):
        iterate(learner)
    seen = []
    loss_actor = learner.stepper.loss.loss_actor

    def noting(batch):
        report = loss_actor(batch)
        seen.append(report["kl"].item())
        return report

    learner.stepper.loss.loss_actor = noting
    iterate(learner)
    assert seen[0] == pytest.approx(0.0, abs=1e-6)
    assert max(seen) > 1e-5


def test_advantages_bootstrap_from_the_true_last_observation_of_a_truncated_episode():
    """By hand, for a lambda of 0: r + γ V(last) - V(first), at a truncation as elsewhere."""
    learner = arm_learner()
    learner = Learner(learner.env, learner.actor, learner.critic, replace(learner.config, gae_lambda=0.0))
    batch = learner.rollout()
    estimate_advantage(learner, batch)
    assert batch["next", "truncated"].any()
    with torch.no_grad():
        here = learner.critic(batch.select("joint_position").clone())["state_value"]
        there = learner.critic(batch["next"].select("joint_position").clone())["state_value"]
    wanted = batch["next", "reward"] + learner.config.discount * there
    torch.testing.assert_close(batch["value_target"], wanted)
    assert batch["advantage"].mean().abs() < 1e-5
    assert (batch["advantage"].std() - 1).abs() < 1e-3
    assert ((wanted - here).flatten().argsort() == batch["advantage"].flatten().argsort()).all()


def test_advantages_do_not_depend_on_the_size_of_the_pieces():
    learner = arm_learner()
    whole = learner.rollout().clone()
    pieces = whole.clone()
    estimate_advantage(learner, whole)
    learner.config = replace(learner.config, micro_batch=3)
    estimate_advantage(learner, pieces)
    for key in ("state_value", "advantage", "value_target"):
        torch.testing.assert_close(pieces[key], whole[key])
    assert whole["state_value"].std() > 0


def test_the_collector_of_torchrl_teaches_the_same():
    """For one seed, the two ways to collect end in the same weights."""
    learners = [arm_learner(collector=collector) for collector in (False, True)]
    for learner in learners:
        torch.manual_seed(7)
        for _ in range(2):
            iterate(learner)
    for ours, theirs in zip(*(learner.actor.parameters() for learner in learners), strict=True):
        torch.testing.assert_close(ours, theirs)


class Log:
    def __init__(self):
        self.rows = {}

    def log_metrics(self, metrics, step=None):
        self.rows[step] = metrics


def test_training_measures_logs_and_ends_when_told():
    log, learner = Log(), arm_learner()
    metrics = train(
        learner, iterations=3, evaluate=lambda: {"error": 1.0}, evaluate_every=2, logger=log, progress=False
    )
    assert list(log.rows) == [1, 2, 3]
    assert ["error" in row for row in log.rows.values()] == [False, True, True]
    assert metrics == log.rows[3]
    assert metrics["samples"] == learner.samples
    seconds = [row["seconds"] for row in log.rows.values()]
    assert seconds == sorted(seconds)
    assert seconds[0] > 0


def test_time_that_earlier_runs_took_counts():
    learner = arm_learner()
    learner.seconds = 59.9999
    train(learner, minutes=1.0, progress=False)
    assert learner.iteration == 1


def test_the_bar_shows_speed_time_left_and_what_to_watch(capsys):
    train(arm_learner(), iterations=2, show=["reward"])
    shown = capsys.readouterr().err
    assert re.search(r"100%.*spent.* left.*samples=72.*samples/s=\d.*reward=-\d", shown)


def test_without_an_end_there_is_no_start():
    with pytest.raises(ValueError, match="never end"):
        train(arm_learner())


def test_the_reward_and_what_is_watched_are_reported_by_their_means():
    learner, seen = arm_learner(watch=["joint_velocity"]), []
    rollout = learner.rollout

    def noting():
        seen.append(rollout().clone())
        return seen[-1].clone()

    learner.rollout = noting
    report = iterate(learner)
    for key in ("reward", "joint_velocity"):
        torch.testing.assert_close(report[key], seen[-1]["next", key].mean())


@pytest.mark.parametrize("rows", [2, 8])
def test_a_batch_of_another_size_than_configured_is_refused(rows):
    learner = arm_learner()
    with pytest.raises(ValueError, match=r"num_envs=config\.num_envs"):
        Learner(arm_env(rows), learner.actor, learner.critic, PPO(num_envs=4))


def test_every_number_of_the_configuration_reaches_the_update():
    policy = actor(7, 7, in_keys=["joint_position"], hidden=(16,))
    value = critic(7, in_keys=["joint_position"], hidden=(16,))
    config = PPO(
        num_envs=4, horizon=7, discount=0.9, gae_lambda=0.8, entropy_coeff=0.03, actor_lr=2e-3, critic_lr=3e-3,
        kl_target=0.04, epochs=3, actor_minibatches=6, critic_minibatches=2, weight_decay=0.05, clip_epsilon=0.15,
        max_grad_norm=0.7, micro_batch=11, least_actor_lr=1e-7,
    )  # fmt: skip
    learner = Learner(arm_env(4), policy, value, config, seed=9)
    stepper = learner.stepper
    told = ("actor_lr", "critic_lr", "epochs", "critic_minibatches", "max_grad_norm", "micro_batch")
    for name in told:
        assert float(getattr(stepper, name)) == pytest.approx(getattr(config, name)), name
    assert (stepper.minibatches, stepper.generator.initial_seed()) == (6, 9)
    assert (stepper.loss.clip_epsilon, stepper.loss.entropy_coeff) == (pytest.approx(0.15), pytest.approx(0.03))
    decays = [group["weight_decay"] for each in (stepper.actor_optimizer, stepper.critic_optimizer)
              for group in each.param_groups]  # fmt: skip
    assert decays == [0.05, 0.05]
    assert float(learner.kl_target) == pytest.approx(0.04)
    assert stepper.adaptive_kl.target is learner.kl_target
    assert stepper.adaptive_kl.bounds == (1e-7, 1e-2)
    assert (learner.rollout.horizon, float(learner.advantage.gamma), float(learner.advantage.lmbda)) == (
        7, pytest.approx(0.9), pytest.approx(0.8),
    )  # fmt: skip


def test_a_state_counts_iterations_samples_and_time_and_does_not_change_as_training_goes_on():
    first, second = arm_learner(), arm_learner(seed=1)
    iterate(first)
    first.seconds = 12.5
    first.stepper.actor_lr.fill_(3e-3)
    state = first.state_dict()["rollout"]["current"]
    stood = {key: value.clone() for key, value in state.items()}
    second.load_state_dict(first.state_dict())
    assert (second.iteration, second.samples, second.seconds) == (1, 48, 12.5)
    assert float(second.stepper.actor_lr) == pytest.approx(3e-3)
    for net in ("actor", "critic"):
        for one, other in zip(*(getattr(learner, net).parameters() for learner in (first, second)), strict=True):
            assert one.equal(other), net
    for key, value in stood.items():
        assert value.equal(second.rollout.current[key]), key
    for value in first.rollout.current.values():
        value.zero_()
    assert stood["joint_position"].any()
    for key, value in stood.items():
        assert value.equal(state[key]), key


def test_a_number_that_an_update_breaks_stops_the_training():
    learner = arm_learner()
    update = learner.stepper.update
    learner.stepper.update = lambda batch: update(batch).set("loss_critic", torch.tensor(torch.nan))
    with pytest.raises(NonFiniteError, match="'loss_critic' of the update is nan"):
        iterate(learner)


def test_speed_is_that_of_this_run_however_much_was_done_before(capsys):
    learner = arm_learner()
    learner.samples, learner.seconds = 10**12, 1e6
    metrics = train(learner, iterations=2, show=[])
    assert metrics["samples"] == learner.samples > 10**12  # what is logged is of all runs
    speeds = re.findall(r"samples/s=([\d,]+)", capsys.readouterr().err)
    assert 0 < int(speeds[-1].replace(",", "")) < 10**8


def test_a_run_that_had_come_to_its_end_is_measured_once_more():
    learner = arm_learner()
    learner.iteration = 3
    assert train(learner, iterations=3, evaluate=lambda: {"error": 1.5}, progress=False) == {"error": 1.5}
    assert learner.samples == 0


def test_it_ends_by_whichever_comes_first():
    learner = arm_learner()
    train(learner, iterations=2, minutes=1e6, progress=False)
    assert learner.iteration == 2
    learner.seconds = 61.0
    train(learner, iterations=10**9, minutes=1.0, progress=False)
    assert learner.iteration == 2


def test_contacts_that_were_left_out_are_told_but_end_nothing():
    learner = arm_learner()

    def full():
        raise CapacityError("contacts were left out")

    learner.env.base_env.physics.check = full
    with pytest.warns(UserWarning, match="contacts were left out"):
        train(learner, iterations=1, progress=False)
    assert learner.iteration == 1


class Two(Processes):
    """The first of two processes, whose generators began so far apart."""

    apart = 1

    def gather(self, value):
        return [value, value + self.apart]

    def average_(self, tensors, weight=None):
        """Alike."""

    def moments(self, value):
        return ALONE.moments(value)


def test_processes_begin_with_all_that_the_first_ones_networks_hold_and_with_seeds_of_their_own(monkeypatch):
    copied = []
    monkeypatch.setattr(Two, "copy_from_first_", lambda self, tensors: copied.extend(tensors))
    learner = arm_learner(processes=Two(0, 2))
    held = {id(t) for net in (learner.actor, learner.critic) for t in (*net.parameters(), *net.buffers())}
    assert {id(t) for t in copied} == held
    assert id(learner.normalizers["joint_position"].mean) in held
    monkeypatch.setattr(Two, "apart", 0)
    with pytest.raises(ValueError, match="two alike try the same actions"):
        arm_learner(processes=Two(0, 2))


def test_graphs_are_given_up_before_the_processes_part(monkeypatch):
    learner, done = arm_learner(), []
    learner.stepper.release = lambda: done.append("graphs")
    monkeypatch.setattr(Two, "leave", lambda self: done.append("processes"))
    learner.processes = Two(0, 2)
    learner.close()
    assert done == ["graphs", "processes"]


class Half(Two):
    """The first of two processes, of which the other one's numbers are the opposite of its own."""

    def gather(self, value):
        return [value, value + 1 if isinstance(value, int) else value]

    def average_(self, tensors, weight=None):
        for tensor in tensors:
            tensor.zero_()

    def moments(self, value):
        mean, variance, count = ALONE.moments(value)
        return mean, variance, 2 * count


def test_what_is_learnt_and_reported_is_that_of_all_processes(monkeypatch):
    asked = []
    monkeypatch.setattr(Half, "copy_from_first_", lambda self, tensors: None)
    monkeypatch.setattr(module, "standardized", lambda value, processes: asked.append(processes) or value)
    learner = arm_learner(processes=Half(0, 2))
    assert not any(iterate(learner).values())
    assert learner.normalizers["joint_position"].count == learner.samples == 2 * 4 * 6
    assert asked == [learner.processes]


def test_the_update_knows_what_a_rollout_writes_anew_and_how_processes_average(monkeypatch):
    told, stepper = [], module.SplitOptimizationStepper
    monkeypatch.setattr(
        module, "SplitOptimizationStepper", lambda *nets, **rest: told.append(rest) or stepper(*nets, **rest)
    )
    monkeypatch.setattr(Two, "copy_from_first_", lambda self, tensors: None)
    nets = actor(7, 7, in_keys=["joint_position"], hidden=(4,)), critic(7, in_keys=["joint_velocity"], hidden=(4,))
    for processes in (ALONE, Two(0, 2)):
        Learner(arm_env(2), *nets, PPO(num_envs=2 * processes.count), processes=processes)
    assert [each["in_place"] for each in told] == [["joint_position", "joint_velocity"]] * 2
    assert [each["average"] is not None for each in told] == [False, True]


def test_rows_of_what_collects_elsewhere_are_counted_there():
    nets = actor(7, 7, in_keys=["joint_position"], hidden=(4,)), critic(7, in_keys=["joint_velocity"], hidden=(4,))
    rollout = SimpleNamespace(num_envs=64)
    assert Learner(arm_env(1), *nets, PPO(num_envs=64), rollout=rollout).rollout is rollout
    with pytest.raises(ValueError, match="the environment has 64 rows"):
        Learner(arm_env(1), *nets, PPO(num_envs=1), rollout=rollout)


def test_a_policy_rests_while_its_critic_learns_and_then_begins_at_its_own_rate_once():
    nets = actor(7, 7, in_keys=["joint_position"], hidden=(4,)), critic(7, in_keys=["joint_position"], hidden=(4,))
    learner, rates = Learner(arm_env(4), *nets, PPO(num_envs=4, horizon=1, actor_lr=1e-4, critic_first=2)), []

    def update(batch):
        rates.append(float(learner.stepper.actor_lr))
        learner.stepper.actor_lr.mul_(2)  # as the divergence tells it
        return TensorDict(kl=torch.zeros(()))

    learner.stepper.update = update
    for _ in range(4):
        iterate(learner)
    assert rates == pytest.approx([0.0, 0.0, 1e-4, 2e-4])


class Second(Processes):
    """A process after the first one, whose clock ticks once for each look."""

    def of_first(self, make):
        tick = float(next(self.ticks))
        return {"error": 2.0, "at": tick} if isinstance(make(), dict) else tick


def counting(processes=ALONE):
    return SimpleNamespace(iteration=0, samples=0, seconds=0.0, processes=processes)


def one_more(learner):
    learner.iteration, learner.samples = learner.iteration + 1, learner.samples + 10
    return TensorDict(kl=torch.tensor(0.5))


def test_all_processes_go_by_what_the_first_one_measures_which_alone_logs_and_shows(capsys):
    Second.ticks, log = itertools.count(1), Log()
    metrics = train(
        counting(Second(1, 2)),
        iterations=2,
        evaluate=lambda: {"error": 9.0},
        evaluate_every=1,
        logger=log,
        step=one_more,
    )
    assert (metrics["error"], metrics["samples"], metrics["kl"]) == (2.0, 20.0, 0.5)
    assert metrics["seconds"] == metrics["at"] + 1  # what an evaluation took counts
    assert not log.rows
    assert not capsys.readouterr().err
    done = counting(Second(1, 2))
    assert train(done, iterations=0, evaluate=lambda: {"error": 9.0}, step=one_more)["error"] == 2.0
    assert done.iteration == 0


@pytest.mark.parametrize("told", [{"iterations": 0}, {"minutes": 0.0}])
def test_no_time_is_no_training(told):
    learner = counting()

    def refuse(learner):
        raise AssertionError("it began")

    assert train(learner, step=refuse, progress=False, **told) == {}


@pytest.mark.parametrize("cuda_graph", [False, True])
def test_what_the_critic_reads_and_what_is_watched_of_the_step_after_is_collected_and_no_more(monkeypatch, cuda_graph):
    told = {}
    monkeypatch.setattr(module, "SplitOptimizationStepper", lambda *nets, **rest: told.update(rest))
    nets = actor(7, 7, in_keys=["joint_position"], hidden=(4,)), critic(7, in_keys=["joint_velocity"], hidden=(4,))
    config = PPO(num_envs=2, horizon=3)
    rollout = Learner(arm_env(2), *nets, config, watch=["joint_power"], cuda_graph=cuda_graph).rollout
    assert type(rollout) is (module.CapturedRollout if cuda_graph else module.Rollout)
    assert (rollout.keys, rollout.horizon) == (["joint_velocity", ("next", "joint_power")], 3)
    assert told["cuda_graph"] is cuda_graph


@pytest.mark.parametrize(("rank", "told"), [(0, True), (1, False)])
def test_a_run_that_goes_on_says_once_from_where_and_its_bar_begins_there(rank, told, capsys):
    learner = SimpleNamespace(iteration=0, samples=0, seconds=0.0, processes=Processes(rank, 1))
    states = SimpleNamespace(resume=lambda learner, log: one_more(learner) is not None, save=lambda learner, log: None)
    train(learner, iterations=2, checkpoints=states, step=one_more)
    shown = capsys.readouterr()
    assert ("going on after iteration 1" in shown.out + shown.err) is told
    assert (" 50%|" in shown.err) is told
    assert "  0%|" not in shown.err


@pytest.mark.parametrize("watch", ["told", ("told", "speed")])
def test_what_is_watched_in_a_group_is_reported_by_its_whole_path(watch):
    """Two groups may have an entry of one name."""
    env = arm_env(4)
    env.append_transform(RenameTransform(["joint_velocity"], [("told", "speed")], create_copy=True))
    report = iterate(arm_learner(env=env, watch=[watch]))
    assert {"reward", "told/speed"} <= set(report.keys())
    assert "speed" not in report.keys()


def test_states_are_saved_every_so_many_iterations_and_at_the_end():
    learner, saved = counting(), []
    states = SimpleNamespace(resume=lambda *_: False, save=lambda learner, log: saved.append(learner.iteration))
    train(learner, iterations=7, checkpoints=states, checkpoint_every=3, step=one_more, progress=False)
    assert saved == [3, 6, 7]


def test_values_are_taken_in_small_pieces_and_their_slopes_are_not_kept():
    learner, sizes = arm_learner(), []
    learner.config = replace(learner.config, micro_batch=5)
    learner.critic.register_forward_hook(lambda net, given, values: sizes.append(values["state_value"].shape[0]))
    batch = learner.rollout()
    estimate_advantage(learner, batch)
    assert max(sizes) == 5
    assert not any(batch[key].requires_grad for key in ("state_value", "advantage", "value_target"))


def test_tuning_begins_slowly_and_after_the_longest_set_up_of_a_task():
    """By the paper's rate; the curve would otherwise begin with the sled's set-up and fall as it ends."""
    assert FINE_TUNE.actor_lr == 1e-5
    passed = FINE_TUNE.warm_up * FINE_TUNE.horizon * 0.02
    assert passed > sled_phases().phases[0].duration
    assert FINE_TUNE.critic_first == PRE_TRAIN.warm_up == UAN.warm_up == 0
