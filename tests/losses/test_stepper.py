import copy
import io

import pytest
import torch
from networks.samples import collected, move, networks
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
from torchrl.trainers import Trainer

from torchrl_athletic.losses import AdaptiveKL, SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import actor, critic

WAITS = {"aten._local_scalar_dense.default", "aten.nonzero.default", "aten.masked_select.default", "aten.equal.default"}
"""Operations after which the host must know a value that the GPU has."""


def parameters(*modules):
    return [parameter.detach().clone() for module in modules for parameter in module.parameters()]


def agree(ours, theirs, **tolerance):
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, **tolerance)


def make(loss=None, dtype=torch.float32, **options):
    policy, value = networks(dtype)
    loss = loss or {}
    return SplitOptimizationStepper(SplitClipPPOLoss(policy, value, **loss), **options)


@pytest.mark.parametrize("critic_lr", [3e-4, 7e-5])
@pytest.mark.parametrize("limit", [None, 0.05])
def test_one_minibatch_is_stock_ppo_step_by_step_with_a_rate_and_a_limit_for_each_network(critic_lr, limit):
    policy, value = networks(torch.float64)
    batch = collected(policy, 32)
    twins = copy.deepcopy((policy, value))
    stepper = SplitOptimizationStepper(
        SplitClipPPOLoss(policy, value, clip_value=0.2),
        actor_lr=3e-4, critic_lr=critic_lr, adaptive_kl=None, epochs=3, minibatches=1, max_grad_norm=limit,
    )  # fmt: skip
    report = stepper.update(batch)

    loss = ClipPPOLoss(*twins, clip_value=0.2)
    groups = [
        {"params": list(net.parameters()), "lr": torch.tensor(lr)}
        for net, lr in zip(twins, (3e-4, critic_lr), strict=False)
    ]
    optimizer = torch.optim.AdamW(groups, weight_decay=0.01, fused=True)
    for _ in range(3):
        out = loss(batch)
        optimizer.zero_grad()
        (out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]).backward()
        for group in groups:
            torch.nn.utils.clip_grad_norm_(group["params"], float("inf") if limit is None else limit)
        optimizer.step()
    if limit is not None:
        assert min(report["actor_grad_norm"], report["critic_grad_norm"]) > limit  # both are cut
    agree(parameters(policy, value), parameters(*twins), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("micro_batch", [1, 7, 32, 1000])
def test_micro_batches_add_up_to_the_whole_batch(masked, micro_batch):
    found = []
    for size in (None, micro_batch):
        stepper = make({"clip_value": 0.2}, torch.float64, micro_batch=size, epochs=1, max_grad_norm=None)
        batch = collected(stepper.loss.actor_network, 32)
        if masked:
            batch["shifted_valid"] = torch.arange(32) > 12  # some pieces have no sample that counts
        report = stepper.update(batch)
        gradient = [parameter.grad for parameter in stepper.critic_parameters]
        found.append([*gradient, *(report[key] for key in ("loss_critic", "value_clip_fraction", "critic_grad_norm"))])
    agree(*found, rtol=1e-12, atol=1e-15)


def test_no_more_samples_than_a_micro_batch_go_through_the_critic_at_once():
    stepper = make(micro_batch=10)
    sizes = []
    stepper.loss.critic_network.register_forward_pre_hook(lambda _, given: sizes.append(len(given[0])))
    stepper.update(collected(stepper.loss.actor_network, 32))
    assert sizes == [10, 10, 10, 2] * 5


@pytest.mark.parametrize(("critic_minibatches", "critic_sizes"), [(1, [30]), (4, [8, 8, 7, 7])])
def test_each_epoch_moves_the_actor_on_minibatches_that_cover_the_batch_once(critic_minibatches, critic_sizes):
    stepper = make(epochs=3, critic_minibatches=critic_minibatches)
    seen, sizes = [], []
    batch = collected(stepper.loss.actor_network, 5, 6)
    stepper.loss.actor_network.register_forward_pre_hook(lambda *_: None)
    original = stepper.loss.loss_actor, stepper.loss.loss_critic
    stepper.loss.loss_actor = lambda part: seen.append(part["observation"][:, 0]) or original[0](part)
    stepper.loss.loss_critic = lambda part: sizes.append(len(part)) or original[1](part)
    stepper.update(batch)
    assert [len(part) for part in seen] == [8, 8, 7, 7] * 3
    assert sizes == critic_sizes * 3
    everything = batch["observation"][..., 0].flatten().sort().values
    epochs = [torch.cat(seen[4 * k : 4 * k + 4]) for k in range(3)]
    for epoch in epochs:
        assert epoch.sort().values.equal(everything)
    assert not epochs[0].equal(epochs[1])


def test_the_rate_falls_while_the_policy_runs_and_never_moves_the_critics():
    stepper = make(actor_lr=1e-2)
    report = stepper.update(collected(stepper.loss.actor_network, 64))
    assert report["kl"] > 0.02
    assert report["actor_lr"] < 1e-2
    assert report["critic_lr"] == torch.tensor(5e-4)
    assert stepper.actor_optimizer.param_groups[0]["lr"] is stepper.actor_lr


def test_a_timid_policy_is_sped_up():
    stepper = make(actor_lr=1e-5, minibatches=1)
    assert stepper.update(collected(stepper.loss.actor_network, 64))["actor_lr"] > 1e-5


def test_without_adaptation_the_rate_stays():
    stepper = make(actor_lr=1e-2, adaptive_kl=None)
    assert stepper.update(collected(stepper.loss.actor_network, 64))["actor_lr"] == torch.tensor(1e-2)


def test_long_gradients_are_cut_but_reported_as_they_were():
    lengths = []
    for limit in (None, 1e-3):
        stepper = make(adaptive_kl=None, epochs=1, minibatches=1, max_grad_norm=limit)
        report = stepper.update(collected(stepper.loss.actor_network, 64))
        gradient = torch.cat([p.grad.flatten() for p in stepper.actor_parameters])
        lengths.append((report["actor_grad_norm"].item(), gradient.norm().item()))
    (free, unchanged), (reported, cut) = lengths
    assert free == pytest.approx(unchanged)
    assert reported == pytest.approx(free)
    assert cut == pytest.approx(1e-3, rel=1e-3)


def test_without_a_limit_the_longest_gradient_is_left_as_it_is():
    stepper = make({"loss_critic_type": "l2"}, adaptive_kl=None, epochs=1, minibatches=1, max_grad_norm=None)
    batch = collected(stepper.loss.actor_network, 64)
    batch["value_target"] = batch["value_target"] * 1e3
    report = stepper.update(batch)
    gradient = torch.cat([p.grad.flatten() for p in stepper.critic_parameters]).norm()
    assert gradient > 1.0
    torch.testing.assert_close(gradient, report["critic_grad_norm"])


def test_decay_pulls_weights_that_have_no_gradient_to_zero():
    options = {"actor_lr": 1e-2, "critic_lr": 2e-2, "weight_decay": 0.03}
    stepper = make({"entropy_bonus": False}, adaptive_kl=None, epochs=1, minibatches=1, **options)
    batch = collected(stepper.loss.actor_network, 8)
    batch["advantage"].zero_()
    with torch.no_grad():
        batch["value_target"] = stepper.loss.critic_network(batch.clone())["state_value"]
    nets = stepper.loss.actor_network, stepper.loss.critic_network
    before = [parameters(net) for net in nets]
    stepper.update(batch)
    for net, old, rate in zip(nets, before, (1e-2, 2e-2), strict=True):
        agree(parameters(net), [p * (1 - rate * 0.03) for p in old])


def test_making_a_stepper_moves_nothing():
    policy, value = networks()
    before = parameters(policy, value)
    stepper = SplitOptimizationStepper(SplitClipPPOLoss(policy, value))
    assert all(a.equal(b) for a, b in zip(parameters(policy, value), before, strict=True))
    assert all(state["step"] == 0 for state in stepper.actor_optimizer.state.values())
    assert stepper.actor_lr == torch.tensor(1e-3)


def test_the_value_loss_falls_and_good_actions_become_likelier():
    stepper = make(epochs=20)
    policy = stepper.loss.actor_network
    batch = collected(policy, 256)
    batch["advantage"] = (batch["action"][:, :1] > 0).float() - 0.5
    first = stepper.update(batch)
    assert stepper.update(batch)["loss_critic"] < first["loss_critic"]
    assert policy(batch.clone())["loc"][:, 0].mean() > batch["loc"][:, 0].mean()


def test_an_interrupted_training_goes_on_as_if_it_had_not_been():
    whole, first = make(), make()
    batches = [collected(whole.loss.actor_network, 32, seed=k) for k in range(3)]
    for batch in batches:
        whole.update(batch)
    for batch in batches[:2]:
        first.update(batch)
    file = io.BytesIO()
    torch.save([first.loss.state_dict(), first.state_dict()], file)
    file.seek(0)
    networks_, optimizers = torch.load(file, weights_only=True)
    resumed = make(seed=99, actor_lr=2e-3, critic_lr=1e-4)
    resumed.loss.load_state_dict(networks_)
    resumed.load_state_dict(optimizers)
    report = resumed.update(batches[2])
    ours, theirs = (parameters(s.loss.actor_network, s.loss.critic_network) for s in (resumed, whole))
    assert all(a.equal(b) for a, b in zip(ours, theirs, strict=True))
    assert report["actor_lr"] == whole.actor_lr
    assert resumed.actor_optimizer.param_groups[0]["lr"] is resumed.actor_lr


def test_same_seed_same_training_other_seed_another():
    found = []
    for seed in (0, 0, 1):
        stepper = make(seed=seed)
        stepper.update(collected(stepper.loss.actor_network, 32))
        found.append(parameters(stepper.loss.actor_network)[0])
    assert found[0].equal(found[1])
    assert not found[0].equal(found[2])


def test_processes_speak_once_a_step_before_gradients_are_cut():
    """Gradients and reports of both networks, in one exchange each; here with one that has nothing to say."""
    heard = []

    def average(tensors, weight):
        heard.append((len(tensors), weight))
        for tensor in tensors[-3:]:
            tensor.add_(7.0)
        tensors[0].zero_()

    stepper = make(epochs=3, minibatches=2, micro_batch=5, average=average, max_grad_norm=1e-3)
    batch = collected(stepper.loss.actor_network, 32)
    batch["shifted_valid"] = torch.arange(32) < 16
    report = stepper.update(batch)
    assert report["loss_critic"] > 5  # what is reported goes with the gradients
    assert report["kl"] > 5
    assert len(heard) == 3 * (2 + 1)
    assert sum(float(weight) for _, weight in heard) == 3 * (16 + 16)
    assert stepper.critic_parameters[0].grad.count_nonzero() == 0
    assert stepper.critic_parameters[1].grad.count_nonzero() > 0


def test_all_processes_capture_if_one_of_many_has_to():
    stepper = make(average=lambda tensors, weight: tensors[0].div_(64))
    assert stepper._anywhere(True)
    assert not stepper._anywhere(False)
    another = make(average=lambda tensors, weight: tensors[0].fill_(1 / 64))
    assert another._anywhere(False)


def test_a_graph_fits_only_while_all_that_it_reads_in_place_lies_where_it_was():
    stepper = make(in_place=("observation", "action"))
    batch = collected(stepper.loss.actor_network, 8)
    stepper._static = stepper._inputs(batch)
    assert stepper._fits(stepper._inputs(batch))
    assert stepper._fits(stepper._inputs(batch.copy().set("advantage", batch["advantage"].clone())))
    assert not stepper._fits(stepper._inputs(batch[:7]))
    for name in ("observation", "action"):
        assert not stepper._fits(stepper._inputs(batch.copy().set(name, batch[name].clone())))


def test_another_state_needs_another_graph():
    stepper = make()
    stepper._graph = object()
    stepper.load_state_dict(stepper.state_dict())
    assert stepper._graph is None


def test_a_report_is_the_mean_over_all_steps_and_tells_what_the_values_explained_before():
    stepper = make({"clip_value": 0.2}, epochs=3, minibatches=2, critic_minibatches=3)
    batch = collected(stepper.loss.actor_network, 30)
    batch["shifted_valid"] = torch.arange(30) % 3 > 0
    batch["value_target"][::3] = 1e3
    told = {}
    for name in ("loss_actor", "loss_critic"):
        told[name], loss = [], getattr(stepper.loss, name)
        setattr(stepper.loss, name, lambda part, name=name, loss=loss: told[name].append(loss(part)) or told[name][-1])
    report = stepper.update(batch)
    assert (len(told["loss_actor"]), len(told["loss_critic"])) == (6, 9)
    for name, keys in (("loss_actor", ("loss_objective", "kl", "max_ratio", "ESS")), ("loss_critic", ("loss_critic",))):
        for key in keys:
            torch.testing.assert_close(report[key], torch.stack([each[key].detach() for each in told[name]]).mean())
    target, value = (batch[key][batch["shifted_valid"]] for key in ("value_target", "state_value"))
    expected = 1 - (target - value).var(correction=0) / target.var(correction=0)
    torch.testing.assert_close(report["explained_variance"], expected, rtol=1e-4, atol=1e-5)


def test_minibatches_of_which_no_sample_counts_do_not_spoil_the_report():
    stepper = make({"log_explained_variance": False}, epochs=1, minibatches=8)
    batch = collected(stepper.loss.actor_network, 16)
    batch["shifted_valid"] = torch.arange(16) < 2
    report = stepper.update(batch)
    assert torch.isfinite(torch.stack(list(report.values()))).all()
    assert report["mean_ratio"] == pytest.approx(1.0, abs=0.2)


def test_a_batch_with_fewer_samples_than_minibatches_is_refused():
    stepper = make(minibatches=4)
    with pytest.raises(ValueError, match="3 samples for 4 minibatches"):
        stepper.update(collected(stepper.loss.actor_network, 3))


def test_one_sample_alone_is_not_standardised_and_spoils_no_weight():
    stepper = make({"normalize_advantage": True}, epochs=1, minibatches=4)
    report = stepper.update(collected(stepper.loss.actor_network, 5))  # minibatches of 2, 1, 1 and 1
    assert torch.isfinite(report["kl"])
    assert all(torch.isfinite(p).all() for p in stepper.actor_parameters)


def test_a_copied_loss_trains_the_parameters_that_it_runs_with_and_a_stepper_is_not_copied():
    stepper = make()
    batch = collected(stepper.loss.actor_network, 32)
    other = copy.deepcopy(stepper.loss)
    moved = SplitOptimizationStepper(other)
    moved.update(batch)
    assert other.loss_actor(batch)["kl"] > 0
    assert stepper.loss.loss_actor(batch)["kl"] == 0
    with pytest.raises(TypeError, match="state_dict"):
        copy.deepcopy(stepper)


def test_networks_that_may_not_learn_are_refused():
    loss = make().loss
    loss.actor_network_params.requires_grad_(False)
    with pytest.raises(ValueError, match="actor has no parameter that may learn"):
        SplitOptimizationStepper(loss)


def test_both_networks_are_given_what_their_losses_read_and_nothing_else():
    stepper = make()
    batch = collected(stepper.loss.actor_network, 8)
    batch["shifted_valid"], batch["idle"] = torch.ones(8, dtype=torch.bool), torch.zeros(8)
    shared = {"observation", "shifted_valid"}
    acted = {"action", "action_log_prob", "advantage", "loc", "scale"}
    assert set(stepper._actor_keys(batch)) == shared | acted
    assert set(stepper._critic_keys(batch)) == shared | {"value_target", "state_value"}


def test_an_update_finds_every_entry_under_the_name_it_is_told():
    """Also the networks' inputs, which need not be the same."""
    trained = []
    for renamed in (False, True):
        torch.manual_seed(0)
        seen, known = ("seen", "known") if renamed else ("observation", "observation")
        policy, value = actor(5, 3, in_keys=(seen,)), critic(5, in_keys=(known,))
        loss = SplitClipPPOLoss(policy, value)
        batch = collected(networks()[0], 16)
        move(policy)
        if renamed:
            batch["known"] = batch["observation"]
            names = {"action": "act", "advantage": "gain", "value_target": "returns", "action_log_prob": "log"}
            for name, other in (names | {"observation": "seen"}).items():
                batch.rename_key_(name, other)
            names["sample_log_prob"] = names.pop("action_log_prob")
            loss.set_keys(**names)
        stepper = SplitOptimizationStepper(loss, epochs=1, minibatches=2)
        report = stepper.update(batch)
        trained.append([*parameters(policy, value), report["explained_variance"]])
    agree(*trained, rtol=0, atol=0)


def test_where_no_sample_counts_nothing_is_learnt_and_nothing_breaks():
    stepper = make({"clip_value": 0.2}, weight_decay=0.0, micro_batch=5)
    batch = collected(stepper.loss.actor_network, 16)
    batch["shifted_valid"] = torch.zeros(16, dtype=torch.bool)
    nets = stepper.loss.actor_network, stepper.loss.critic_network
    before = parameters(*nets)
    report = stepper.update(batch)
    assert report["loss_critic"] == report["loss_objective"] == report["critic_grad_norm"] == 0
    agree(parameters(*nets), before, rtol=0, atol=0)


class Overheard(TorchDispatchMode):
    """Keeps the names of operations."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(str(func))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("masked", [False, True])
def test_the_host_never_waits_for_a_value(masked):
    stepper = make({"clip_value": 0.2, "normalize_advantage": True}, micro_batch=10)
    batch = collected(stepper.loss.actor_network, 32)
    if masked:
        batch["shifted_valid"] = torch.arange(32) > 12
    with Overheard() as overheard:
        stepper.update(batch)
    assert "aten.mm.default" in overheard.names
    assert overheard.names & WAITS == set()


def test_the_listener_above_hears_the_stock_loss_wait():
    policy, value = networks()
    with Overheard() as overheard:
        ClipPPOLoss(policy, value)(collected(policy, 8))
    assert overheard.names & WAITS


def test_it_runs_in_torchrls_trainer():
    env = ContinuousActionVecMockEnv()
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    policy, value = actor(size, actions, hidden=(8,)), critic(size, hidden=(8,))
    loss = SplitClipPPOLoss(policy, value)
    stepper = SplitOptimizationStepper(loss, epochs=2)
    trainer = Trainer(
        collector=Collector(env, policy, frames_per_batch=16, total_frames=48),
        total_frames=48, frame_skip=1, optim_steps_per_batch=1, loss_module=loss, optimization_stepper=stepper,
        progress_bar=False, log_interval=1,
    )  # fmt: skip
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=value, average_gae=True, vectorized=False)
    trainer.register_op("batch_process", gae)
    before = parameters(policy, value)
    assert "actor_optimizer" in trainer.state_dict()["optimization_stepper"]
    trainer.train()
    assert not any(a.equal(b) for a, b in zip(parameters(policy, value), before, strict=True))
    assert all(state["step"] == 3 * 2 * 4 for state in stepper.actor_optimizer.state.values())
    assert all(state["step"] == 3 * 2 for state in stepper.critic_optimizer.state.values())


def test_networks_that_share_weights_are_refused():
    policy, value = networks()
    value.module.mlp = policy[0].module.network.mlp
    with pytest.raises(ValueError, match="Give each its own"):
        SplitOptimizationStepper(SplitClipPPOLoss(policy, value))


def test_networks_may_share_an_encoder_that_does_not_learn():
    policy, value = networks()
    shared = policy[0].module.network.mlp[0].requires_grad_(False)
    value.module.mlp[0] = shared
    before, rest = shared.weight.clone(), value.module.mlp[-1].weight.clone()
    stepper = SplitOptimizationStepper(SplitClipPPOLoss(policy, value), weight_decay=0.1)
    stepper.update(collected(policy, 16))
    assert shared.weight.equal(before)
    assert not value.module.mlp[-1].weight.equal(rest)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"epochs": 0}, "epochs is 0.*Give 1 or more"),
        ({"minibatches": 0}, "minibatches is 0.*Give 1 or more"),
        ({"critic_minibatches": 0}, "critic_minibatches is 0.*Give 1 or more"),
        ({"micro_batch": 0}, "None for no limit"),
        ({"actor_lr": 0.1}, "Start within the bounds"),
        ({"actor_lr": 1e-3, "adaptive_kl": AdaptiveKL(bounds=(1e-5, 1e-4))}, "Start within the bounds"),
        ({"cuda_graph": True}, "Move the networks to CUDA"),
        ({"loss": {"reduction": "sum"}}, "take 'mean'"),
    ],
)
def test_an_update_that_cannot_work_is_refused(options, advice):
    with pytest.raises(ValueError, match=advice):
        make(**options)


def test_an_actor_alone_is_refused():
    policy, _ = networks()
    with pytest.raises(ValueError, match="Give SplitClipPPOLoss a critic_network"):
        SplitOptimizationStepper(SplitClipPPOLoss(policy))


def test_capture_needs_a_gpu():
    stepper = make()
    with pytest.raises(RuntimeError, match="on a GPU"):
        stepper.capture(collected(stepper.loss.actor_network, 8))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_one_graph_trains_as_the_steps_one_by_one_do():
    found = []
    for cuda_graph in (False, True):
        policy, value = (module.cuda() for module in networks())
        stepper = SplitOptimizationStepper(SplitClipPPOLoss(policy, value), cuda_graph=cuda_graph, micro_batch=100)
        reports = []
        for k in range(3):
            batch = collected(networks()[0], 256, seed=k).cuda()
            reports.append(torch.stack(list(stepper.update(batch).values())))
        found.append([*parameters(policy, value), *reports])
        move(policy, 0.0)
    agree(*found, rtol=1e-4, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_graph_reads_entries_in_place_and_notices_when_they_move():
    found = []
    for in_place in ((), ("observation",)):
        policy, value = (module.cuda() for module in networks())
        loss = SplitClipPPOLoss(policy, value)
        stepper = SplitOptimizationStepper(loss, cuda_graph=True, micro_batch=100, in_place=in_place)
        kept = collected(networks()[0], 256, seed=0).cuda()
        for k in range(4):
            batch = collected(networks()[0], 256, seed=k).cuda()
            if k < 3:  # where the first one was; the last one lies elsewhere
                batch["observation"] = kept["observation"].copy_(batch["observation"])
            stepper.update(batch)
        found.append(parameters(policy, value))
        move(policy, 0.0)
    agree(*found, rtol=1e-4, atol=1e-5)


def test_pieces_of_a_batch_do_not_add_up_to_an_explained_variance():
    """It is no sum over samples: told only of values that the batch remembers, and of the whole batch."""
    stepper = make(micro_batch=8)
    batch = collected(stepper.loss.actor_network, 32)
    assert "explained_variance" not in stepper.update(batch.exclude("state_value"))


def test_each_epoch_has_an_order_of_its_own_for_the_critic_too(monkeypatch):
    stepper = make(epochs=2, critic_minibatches=2, micro_batch=None)
    seen, whole = [], stepper.loss.loss_critic
    batch = collected(stepper.loss.actor_network, 8)
    batch["value_target"] = torch.arange(8.0).unsqueeze(-1)
    monkeypatch.setattr(
        stepper.loss,
        "loss_critic",
        lambda piece: seen.append(set(piece["value_target"].flatten().tolist())) or whole(piece),
    )
    stepper.update(batch)
    first, second, third, fourth = seen
    assert first | second == third | fourth == set(range(8))
    assert first not in (third, fourth)


def test_a_batch_that_carries_gradients_trains_as_one_that_does_not():
    """What collected it, an encoder say, is not trained through it."""
    reports = []
    for carries in (False, True):
        stepper = make(dtype=torch.float64, epochs=1)
        batch = collected(stepper.loss.actor_network, 16)
        source = torch.ones((), dtype=torch.float64, requires_grad=carries)
        for key in ("observation", "advantage", "value_target"):
            batch[key] = batch[key] * source
        reports.append(stepper.update(batch))
        assert source.grad is None
    for key, value in reports[0].items():
        assert torch.equal(value, reports[1][key]), key
