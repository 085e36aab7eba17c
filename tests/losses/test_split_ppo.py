import pytest
import torch
from networks.samples import ACTION, STATE, collected, gradients, move, networks
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Independent, Laplace, Normal, kl_divergence
from torchrl.modules import IndependentNormal, NormalParamExtractor, OneHotCategorical, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from torchrl_athletic.losses import SplitClipPPOLoss, clipped_surrogate, gaussian_kl, sampled_kl
from torchrl_athletic.losses.split_ppo import divergence, explained_variance, masked_mean, movement, standardized

OPTIONS = [
    {},
    {"clip_epsilon": 0.05, "loss_critic_type": "l2", "clip_value": True, "entropy_coeff": 0.3},
    {"clip_epsilon": (0.05, 0.3), "loss_critic_type": "l1", "clip_value": 0.1, "critic_coeff": 0.5},
    {"normalize_advantage": True, "entropy_bonus": False},
    {"reduction": "sum", "log_explained_variance": False, "functional": False},
    {"reduction": "none", "separate_losses": True},
]


@pytest.fixture
def case():
    policy, value = networks()
    batch = collected(policy, 64)
    move(policy)
    return policy, value, batch


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_on_one_batch_it_is_the_stock_loss_values_and_gradients(case, options):
    policy, value, batch = case
    ours, stock = SplitClipPPOLoss(policy, value, **options)(batch), ClipPPOLoss(policy, value, **options)(batch)
    assert set(ours.keys()) == {*stock.keys(), "kl"}
    for key, expected in stock.items():
        torch.testing.assert_close(ours[key], expected.reshape(ours[key].shape))
    losses = [key for key in stock.keys() if key.startswith("loss_")]
    for network in (policy, value):
        found = gradients(sum(ours[key].sum() for key in losses), network)
        for ours_, stock_ in zip(found, gradients(sum(stock[key].sum() for key in losses), network), strict=True):
            torch.testing.assert_close(ours_, stock_)
            assert ours_.abs().max() > 0


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_it_returns_what_it_says_it_returns(case, options):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value, **options)
    assert set(loss(batch).keys()) == set(loss.out_keys)


@pytest.mark.parametrize("coefficient", [None, 0.0])
def test_without_a_coefficient_the_critic_stays_out_of_the_sum_but_can_be_asked(case, coefficient):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value, critic_coeff=coefficient)
    assert "loss_critic" not in loss(batch).keys()
    assert "loss_critic" not in loss.out_keys
    whole = SplitClipPPOLoss(policy, value).loss_critic(batch)["loss_critic"]
    assert loss.loss_critic(batch)["loss_critic"] == whole


def test_values_that_are_not_to_be_clipped_are_not(case):
    policy, value, batch = case
    plain, told = (SplitClipPPOLoss(policy, value, clip_value=clip).loss_critic(batch) for clip in (None, False))
    assert set(told.keys()) == set(plain.keys()) == {"loss_critic", "explained_variance"}
    assert told["loss_critic"] == plain["loss_critic"]


def test_actor_and_critic_each_see_their_own_samples(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    few = batch[:16]
    assert loss.loss_actor(few)["loss_objective"] == loss(few)["loss_objective"]
    assert loss.loss_critic(batch)["loss_critic"] == loss(batch)["loss_critic"]
    assert loss.loss_actor(few)["loss_objective"] != loss(batch)["loss_objective"]


def test_the_actor_needs_no_critic(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy)
    assert loss(batch)["loss_objective"] == SplitClipPPOLoss(policy, value)(batch)["loss_objective"]
    with pytest.raises(RuntimeError, match="Give SplitClipPPOLoss a critic_network"):
        loss.loss_critic(batch)


def test_the_batch_is_left_as_it_was(case):
    policy, value, batch = case
    before, loss = batch.clone(), SplitClipPPOLoss(policy, value)
    for part in (loss, loss.loss_actor, loss.loss_critic):
        part(batch)
        assert set(batch.keys()) == set(before.keys())
        assert (batch == before).all()


def test_only_losses_carry_a_gradient(case):
    policy, value, batch = case
    report = SplitClipPPOLoss(policy, value, clip_value=0.2)(batch)
    assert {key for key in report.keys() if report[key].requires_grad} == {
        "loss_objective", "loss_entropy", "loss_critic",
    }  # fmt: skip


def test_it_runs_the_networks_with_the_parameters_it_is_given(case):
    """As for a gradient through an update, which puts other parameters in the place of the loss's own."""
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    others = TensorDict.from_module(loss).detach().clone()
    for name in ("actor_network_params", "critic_network_params"):
        others[name] = others[name] * 1.5
    before = loss(batch)
    with others.to_module(loss):
        within = loss(batch)
    for key in ("loss_objective", "loss_critic"):
        assert within[key] != before[key]
        assert loss(batch)[key] == before[key]


@pytest.mark.parametrize("separate", [False, True])
def test_shared_parameters_learn_from_the_critic_unless_losses_are_kept_apart(separate):
    policy, value = networks()
    shared = policy[0].module.network.mlp[0]
    value.module.mlp[0] = shared
    loss = SplitClipPPOLoss(policy, value, separate_losses=separate)
    loss.loss_critic(collected(policy, 8))["loss_critic"].backward()
    assert (shared.weight.grad is None or not shared.weight.grad.any()) is separate
    assert value.module.mlp[-1].weight.grad.any()


def test_what_is_not_said_is_as_documented_and_what_is_said_is_passed_on(case):
    policy, value, _ = case
    plain = SplitClipPPOLoss(policy, value)
    torch.testing.assert_close(plain.clip_epsilon, torch.tensor(0.2))
    assert (plain.entropy_bonus, plain.samples_mc_entropy, plain.reduction) == (True, 1, "mean")
    assert (plain.normalize_advantage, plain.separate_losses, plain.functional) == (False, False, True)
    assert (plain.loss_critic_type, plain.clip_value, plain.log_explained_variance) == ("smooth_l1", None, True)
    torch.testing.assert_close(plain.entropy_coeff, torch.tensor(0.01))
    torch.testing.assert_close(plain.critic_coeff, torch.tensor(1.0))
    told = SplitClipPPOLoss(policy, functional=False, device=torch.device("meta"))
    assert not told.functional
    assert told.clip_epsilon.device.type == "meta"
    told.out_keys = ["loss_objective"]
    assert told.out_keys == ["loss_objective"]


def with_next(batch):
    """The batch as it comes from a collector, before any advantage."""
    done = torch.zeros(64, 1, dtype=torch.bool)
    after = {"observation": torch.randn(64, STATE), "reward": torch.randn(64, 1), "done": done, "terminated": done}
    return batch.exclude("advantage", "value_target", "state_value").set("next", TensorDict(after, [64]))


def test_without_an_advantage_one_is_estimated_as_the_stock_loss_does(case):
    policy, value, batch = case
    batch = with_next(batch)
    losses = SplitClipPPOLoss(policy, value), ClipPPOLoss(policy, value)
    for loss in losses:
        loss.make_value_estimator(gamma=0.99, lmbda=0.95)
    ours, stock = (loss(batch) for loss in losses)
    for key in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(ours[key], stock[key])
    assert "advantage" not in batch.keys()


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss"),
    [
        (1.0, 2.0, -2.0),
        (1.5, 2.0, -2.4),  # a good action: credit stops at 1 + ε
        (1.5, -2.0, 3.0),  # a bad one made likelier: full blame
        (0.5, 2.0, -1.0),  # a good one made rarer: full blame
        (0.5, -2.0, 1.6),  # a bad one: credit stops at 1 - ε
    ],
)
def test_credit_is_bounded_and_blame_is_not(ratio, advantage, loss):
    low, high = torch.tensor(0.8).log(), torch.tensor(1.2).log()
    found = clipped_surrogate(torch.tensor([[ratio]]).log(), torch.tensor([[advantage]]), low, high)
    assert found.item() == pytest.approx(loss)


def gaussians(seed=0):
    torch.manual_seed(seed)
    return [(torch.randn(7, ACTION), torch.rand(7, ACTION) + 0.2) for _ in range(2)]


def test_divergence_is_the_textbook_one_and_never_negative():
    old, new = gaussians()
    expected = kl_divergence(Independent(Normal(*old), 1), Independent(Normal(*new), 1))
    torch.testing.assert_close(gaussian_kl(*old, *new).squeeze(-1), expected)
    assert (gaussian_kl(*old, *new) > 0).all()
    assert gaussian_kl(*old, *old).abs().max() == 0


def test_divergence_from_actions_tends_to_the_exact_one():
    old, new = (Independent(Normal(loc[:1], 0.5 + scale[:1]), 1) for loc, scale in gaussians())
    torch.manual_seed(0)
    actions = old.sample((200_000,))
    found = sampled_kl((new.log_prob(actions) - old.log_prob(actions)).unsqueeze(-1))
    assert found.min() >= 0
    assert found.mean().item() == pytest.approx(kl_divergence(old, new).item(), rel=0.02)


def test_divergence_is_exact_where_the_batch_remembers_the_policy(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    now = policy.get_dist(batch.clone())
    expected = kl_divergence(Independent(Normal(batch["loc"], batch["scale"]), 1), now).mean()
    torch.testing.assert_close(loss(batch)["kl"], expected.detach())
    forgetful = batch.exclude("loc", "scale")
    log_ratio = (now.log_prob(batch["action"]) - batch["action_log_prob"]).unsqueeze(-1)
    torch.testing.assert_close(loss(forgetful)["kl"], sampled_kl(log_ratio).mean().detach())


def squashed():
    """A policy whose entropy has no formula."""
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(STATE, 2 * ACTION), NormalParamExtractor())
    head = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(head, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)


def test_a_map_behind_the_gaussian_leaves_the_divergence_as_it_is():
    policy = squashed()
    _, value = networks()
    batch = collected(policy, 64)
    move(policy)
    with torch.no_grad():
        loc, scale = policy[0].module(batch["observation"])
    torch.manual_seed(3)  # its entropy is drawn
    ours = SplitClipPPOLoss(policy, value)(batch)
    torch.testing.assert_close(ours["kl"], gaussian_kl(batch["loc"], batch["scale"], loc, scale).mean())
    torch.manual_seed(3)
    stock = ClipPPOLoss(policy, value)(batch)
    for key in ("loss_objective", "loss_entropy", "loss_critic"):
        torch.testing.assert_close(ours[key], stock[key])


def test_an_entropy_estimated_from_sixteen_draws_scatters_a_quarter_as_much():
    policy = squashed()
    batch = collected(policy, 4)
    spread = {}
    for draws in (1, 16):
        loss = SplitClipPPOLoss(policy, samples_mc_entropy=draws)
        spread[draws] = torch.stack([loss.loss_actor(batch)["entropy"] for _ in range(300)]).std().item()
    assert spread[16] == pytest.approx(spread[1] / 4, rel=0.2)


def test_each_sample_of_a_batch_of_any_shape_has_its_own_losses_and_masks():
    """Entropy that is drawn included: of samples in rows and steps it is that of the same samples in a line."""
    policy, (_, value) = squashed(), networks()
    batch = collected(policy, 4, 5)
    batch["shifted_valid"] = torch.arange(20).view(4, 5) % 3 > 0
    move(policy)
    found = []
    for part in (batch, batch.reshape(-1)):
        torch.manual_seed(3)
        out = SplitClipPPOLoss(policy, value, reduction="none", clip_value=0.2)(part)
        for key in ("loss_objective", "loss_entropy", "loss_critic"):
            assert out[key].shape == part.batch_size, key
        found.append(out)
    for key, expected in found[1].items():
        torch.testing.assert_close(found[0][key].reshape(expected.shape), expected)
    assert (found[0]["loss_entropy"] != 0).equal(batch["shifted_valid"])


def test_an_entropy_from_draws_teaches_the_policy_to_spread():
    """Where tanh bends nothing, doubling the scale adds log 2 to each of three entropies: a slope of 3."""
    scale = nn.Parameter(torch.tensor(-4.0))
    head = TensorDictModule(
        lambda seen: (0.0 * seen[..., :ACTION], scale.exp().expand(*seen.shape[:-1], ACTION)),
        in_keys=["observation"], out_keys=["loc", "scale"],
    )  # fmt: skip
    head.register_parameter("log_scale", scale)
    policy = ProbabilisticActor(head, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)
    loss = SplitClipPPOLoss(policy, samples_mc_entropy=2000, entropy_coeff=1.0, functional=False)
    found = torch.autograd.grad(loss.loss_actor(collected(policy, 4))["loss_entropy"], scale)[0]
    assert float(found) == pytest.approx(-3.0, rel=0.05)


@pytest.mark.parametrize("size", [1e-2, 1.0, 1e4])
def test_standardised_advantages_and_explained_variance_know_no_unit(case, size):
    policy, value, batch = case
    batch["value_target"] = batch["state_value"] + 0.3 * batch["advantage"]
    expected = explained_variance(batch["state_value"], batch["value_target"])
    found = explained_variance(size * batch["state_value"], size * batch["value_target"])
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    loss = SplitClipPPOLoss(policy, value, normalize_advantage=True)
    expected = loss.loss_actor(batch)["loss_objective"]
    batch["advantage"] = size * batch["advantage"]
    torch.testing.assert_close(loss.loss_actor(batch)["loss_objective"], expected, rtol=1e-3, atol=1e-5)


def test_a_batch_that_remembers_half_of_the_policy_has_its_divergence_estimated(case):
    policy, value, batch = case
    whole, half = (SplitClipPPOLoss(policy, value).loss_actor(b)["kl"] for b in (batch, batch.exclude("scale")))
    log_ratio = (policy.get_dist(batch.clone()).log_prob(batch["action"]) - batch["action_log_prob"]).unsqueeze(-1)
    torch.testing.assert_close(half, sampled_kl(log_ratio).mean().detach())
    assert half != whole


@pytest.mark.parametrize("separate", [False, True])
def test_what_made_the_critics_input_learns_from_the_critic_unless_losses_are_kept_apart(case, separate):
    """As with the stock loss: an encoder before both networks, whose features the batch carries."""
    policy, value, batch = case
    learnt = []
    for make in (SplitClipPPOLoss, ClipPPOLoss):
        seen = batch["observation"].clone().requires_grad_()
        loss = make(policy, value, separate_losses=separate)
        (gradient,) = torch.autograd.grad(
            loss(batch.copy().set("observation", seen))["loss_critic"], seen, allow_unused=True
        )
        learnt.append(torch.zeros_like(seen) if gradient is None else gradient)
    torch.testing.assert_close(*learnt)
    assert bool(learnt[0].any()) is not separate


def test_a_policy_of_choices_has_its_divergence_estimated():
    torch.manual_seed(0)
    head = TensorDictModule(nn.Linear(STATE, 4), in_keys=["observation"], out_keys=["logits"])
    policy = ProbabilisticActor(head, in_keys=["logits"], distribution_class=OneHotCategorical, return_log_prob=True)
    batch = collected(policy, 64)
    move(policy)
    out = SplitClipPPOLoss(policy)(batch)
    log_ratio = policy.get_dist(batch.clone()).log_prob(batch["action"]) - batch["action_log_prob"]
    torch.testing.assert_close(out["kl"], sampled_kl(log_ratio).mean().detach())
    assert out["kl"] > 0


@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("trailing", [True, False])
@pytest.mark.parametrize("options", [{}, {"normalize_advantage": True, "clip_value": 0.2}], ids=str)
def test_masked_samples_count_nowhere_and_may_hold_anything(case, key, trailing, options):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value, **options)
    counts = torch.arange(64) % 3 > 0
    expected = loss(batch[counts])
    for name in ("advantage", "value_target", "state_value", "action_log_prob"):
        batch[name][~counts] = torch.nan
    batch[key] = counts.unsqueeze(-1) if trailing else counts
    found = loss(batch)
    for name, value_ in expected.items():
        torch.testing.assert_close(found[name], value_)
    for network in (policy, value):
        total = (sum(out[k] for k in ("loss_objective", "loss_entropy", "loss_critic")) for out in (found, expected))
        for ours, theirs in zip(*(gradients(t, network) for t in total), strict=True):
            torch.testing.assert_close(ours, theirs)


def test_both_masks_must_let_a_sample_pass_and_one_can_be_named_or_none(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    even, late = torch.arange(64) % 2 == 0, torch.arange(64) > 30
    whole = loss(batch)["loss_critic"]
    batch["collector", "mask"], batch["shifted_valid"] = even, late
    assert loss.valid(batch).squeeze(-1).equal(even & late)
    loss.loss_mask_key = "shifted_valid"
    assert loss.valid(batch).squeeze(-1).equal(late)
    loss.loss_mask_key = None
    assert loss(batch)["loss_critic"] == whole


def test_keys_can_be_renamed(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    expected = loss(batch)
    names = {"advantage": ("gae", "adv"), "value_target": "returns", "action": "act", "action_log_prob": "log"}
    for name, other in names.items():
        batch.rename_key_(name, other)
    loss = SplitClipPPOLoss(policy, TensorDictModule(value.module, ["observation"], ["worth"]))
    told = {"action": "act", "sample_log_prob": "log", "value": "worth"}
    loss.set_keys(advantage=("gae", "adv"), value_target="returns", **told)
    found = loss(batch)
    assert all(found[key] == expected[key] for key in ("loss_objective", "loss_critic"))


def test_it_can_be_called_without_a_tensordict(case):
    policy, value, batch = case
    loss = SplitClipPPOLoss(policy, value)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95)
    batch = with_next(batch).select("observation", "action", "action_log_prob", "next")
    expected = loss(batch)
    found = loss(**{"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in batch.keys(True, True)})
    assert dict(zip(loss.out_keys, found, strict=True)) == {key: expected[key] for key in loss.out_keys}


def test_a_flat_advantage_is_refused(case):
    policy, value, batch = case
    batch["advantage"] = batch["advantage"].squeeze(-1)
    with pytest.raises(ValueError, match="last dimension of 1, as GAE does"):
        SplitClipPPOLoss(policy, value)(batch)


@pytest.mark.parametrize(("key", "advice"), [("advantage", "GAE"), ("action_log_prob", "return_log_prob=True")])
def test_a_missing_key_is_named_with_where_it_comes_from(case, key, advice):
    policy, value, batch = case
    with pytest.raises(KeyError, match=rf"no '{key}', only .*{advice}"):
        SplitClipPPOLoss(policy, value).loss_actor(batch.exclude(key))


def test_data_that_carries_a_gradient_is_refused(case):
    policy, value, batch = case
    batch["action_log_prob"].requires_grad_()
    with pytest.raises(RuntimeError, match="Detach the batch"):
        SplitClipPPOLoss(policy, value)(batch)


def test_several_advantages_are_refused(case):
    policy, value, batch = case
    batch["advantage"] = TensorDict({"one": torch.zeros(64, 1)}, [64])
    with pytest.raises(TypeError, match="take ClipPPOLoss"):
        SplitClipPPOLoss(policy, value)(batch)


def test_an_unknown_reduction_is_refused(case):
    policy, value, _ = case
    with pytest.raises(ValueError, match="'mean', 'sum' or 'none'"):
        SplitClipPPOLoss(policy, value, reduction="max")


def test_a_mean_of_no_sample_is_zero_and_alike_advantages_say_nothing():
    nothing = torch.zeros(3, 1, dtype=torch.bool)
    assert masked_mean(torch.full((3, 1), torch.nan), nothing) == 0
    assert standardized(torch.full((4, 1), 5.0), None).tolist() == [[0.0]] * 4
    kept = torch.tensor([[True], [True], [False]])
    found = standardized(torch.tensor([[1.0], [3.0], [torch.nan]]), kept)
    torch.testing.assert_close(found, torch.tensor([[-1.0], [1.0], [0.0]]) / 2**0.5)


def test_the_greatest_ratio_is_of_samples_that_count_and_may_be_less_than_one():
    log_ratio = torch.tensor([[0.5], [0.25], [1.0]]).log()
    found = movement(log_ratio.masked_fill(log_ratio == 0, 0.0), log_ratio < 0, torch.tensor(-0.2), torch.tensor(0.2))
    torch.testing.assert_close(found["max_ratio"], torch.tensor(0.5))
    torch.testing.assert_close(found["clip_fraction"], torch.tensor(1.0))


def test_a_perfect_critic_explains_returns_that_are_all_alike():
    alike = torch.full((4, 1), 3.0)
    assert explained_variance(alike, alike) == 1


def test_the_entropy_that_is_reported_is_of_samples_that_count():
    """The policy is unsure where it counts and sure elsewhere."""
    wide = nn.Sequential(nn.Linear(STATE, 2 * ACTION), NormalParamExtractor())
    net = TensorDictModule(wide, in_keys=["observation"], out_keys=["loc", "scale"])
    policy = ProbabilisticActor(
        net, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )
    _, value = networks()
    batch = collected(policy, 40)
    loss = SplitClipPPOLoss(policy, value)
    batch["shifted_valid"] = counts = batch["scale"].sum(-1) > batch["scale"].sum(-1).median()
    torch.testing.assert_close(loss(batch)["entropy"], loss(batch[counts])["entropy"])


@pytest.mark.parametrize("kinds", [(Laplace, Normal), (Normal, Laplace), (Laplace, Laplace), (None, Normal)])
def test_a_divergence_is_exact_only_if_both_policies_are_gaussian(kinds: tuple) -> None:
    """The divergence of any other pair is estimated from the actions, which is what the ratios tell."""
    zero, one, log_ratio = torch.zeros(2, 3), torch.ones(2, 3), torch.tensor([[0.5], [-0.5]])
    old, new = (None if kind is None else kind(zero, one) for kind in kinds)
    assert torch.equal(divergence(old, new, log_ratio), sampled_kl(log_ratio))
    assert torch.equal(divergence(Normal(zero, one), Normal(zero, one), log_ratio), torch.zeros(2, 1))


def test_a_mask_of_samples_counts_for_every_agent_of_a_sample():
    """Two of four samples count, each with three agents: as those two alone."""
    policy, value = networks()
    loss = SplitClipPPOLoss(policy, value, log_explained_variance=False)
    batch = collected(policy, 12).reshape(4, 3)
    batch.batch_size = [4]
    batch["advantage"], batch["value_target"] = torch.randn(4, 3, 1), torch.randn(4, 3, 1)
    alone = batch[:2].clone()
    batch["shifted_valid"] = torch.tensor([True, True, False, False])
    for part, key in ((loss.loss_actor, "loss_objective"), (loss.loss_critic, "loss_critic")):
        torch.testing.assert_close(part(batch)[key], part(alone)[key])


def test_a_batch_without_advantage_says_so_where_nobody_can_estimate_one():
    policy, _ = networks()
    with pytest.raises(KeyError, match="advantage"):
        SplitClipPPOLoss(policy)(collected(policy, 4).exclude("advantage", "value_target"))
