"""The adaptation module learns to feel what the encoder is told, and any loss behind the latent brings that along."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_athletic.losses import SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import RunningNormalizer, actor, critic, deploy, roa_actor
from torchrl_athletic.networks.roa import RegularizedAdaptation, adaptation_loss


def seen(rows: int, seed: int = 0) -> TensorDict:
    """A history that shows what was randomised, and noise."""
    torch.manual_seed(seed)
    drawn = torch.rand(rows, 3) * 2 - 1
    history = torch.cat([drawn, 0.01 * torch.randn(rows, 3)], -1)
    return TensorDict(observation=torch.randn(rows, 4), randomization=drawn, history=history, batch_size=[rows])


def test_the_gradient_through_the_latent_includes_the_terms_own() -> None:
    """A finite difference of the sum of both, parameter by parameter, with the parts that are held kept."""
    torch.manual_seed(0)
    adaptation = RegularizedAdaptation(3, 6, latent=2, hidden=(4,), ramp=1)
    data = seen(5)
    loss = adaptation(data["randomization"], data["history"]).square().mean()
    loss.backward()
    told, felt = adaptation.encoder(data["randomization"]), adaptation.adapter(data["history"])
    whole = told.square().mean() + adaptation_loss(told, felt, 1.0)
    expected = torch.autograd.grad(whole, list(adaptation.parameters()))
    for parameter, gradient in zip(adaptation.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_the_encoder_is_pulled_more_and_more() -> None:
    told, felt = torch.zeros(1, 2, requires_grad=True), torch.tensor([[3.0, 4.0]])
    for weight in (0.0, 0.5, 1.0):
        (gradient,) = torch.autograd.grad(adaptation_loss(told, felt, weight), told)
        torch.testing.assert_close(gradient, -weight * torch.tensor([[0.6, 0.8]]))
    adaptation = RegularizedAdaptation(3, 6, ramp=4)
    data = seen(5)
    for k in range(1, 7):
        adaptation(data["randomization"], data["history"])
        assert adaptation.passes == k
    with torch.no_grad():
        adaptation(data["randomization"], data["history"])
    assert adaptation.passes == 6  # acting is not learning


def test_ppo_teaches_the_adaptation_module_and_a_deployed_policy_needs_nothing_privileged() -> None:
    torch.manual_seed(0)
    policy = roa_actor(4, 2, 3, 6, hidden=(16,), ramp=100, latent=2)
    stepper = SplitOptimizationStepper(SplitClipPPOLoss(policy, critic(4, hidden=(8,))), epochs=5)

    def apart(rows: TensorDict) -> float:
        with torch.no_grad():
            told = policy(rows.clone())["loc"]
            felt = deploy(policy)(rows.clone().set("randomization", torch.full((len(rows), 3), torch.nan)))["loc"]
        deploy(policy, False)
        return float((told - felt).abs().mean())

    others = seen(256, seed=9)
    before = apart(others)
    for seed in range(20):
        batch = seen(512, seed)
        with torch.no_grad():
            batch = policy(batch)
        batch["advantage"], batch["value_target"] = torch.randn(512, 1), torch.randn(512, 1)
        stepper.update(batch)
    assert apart(others) < before / 2


def test_a_policy_that_cannot_adapt_is_not_deployed() -> None:
    with pytest.raises(ValueError, match="Make it with roa_actor"):
        deploy(actor(3, 2))


def test_the_pull_on_the_encoder_grows_with_its_passes_and_no_further_than_told() -> None:
    """The gradient of what is brought along alone, at each pass, since the latent itself is not used."""
    torch.manual_seed(0)
    adaptation, data = RegularizedAdaptation(3, 6, latent=2, hidden=(4,), ramp=2), seen(5)
    told, felt = adaptation.encoder(data["randomization"]), adaptation.adapter(data["history"])
    full = torch.autograd.grad(adaptation_loss(told, felt, 1.0), list(adaptation.encoder.parameters()))
    for weight in (0.5, 1.0, 1.0, 1.0):
        adaptation.zero_grad()
        (0.0 * adaptation(data["randomization"], data["history"])).sum().backward()
        for parameter, gradient in zip(adaptation.encoder.parameters(), full, strict=True):
            torch.testing.assert_close(parameter.grad, weight * gradient)


def test_a_policy_has_the_sizes_that_were_asked_for_and_only_what_it_observes_is_normalised() -> None:
    normalizer = RunningNormalizer(4)
    normalizer.update(3.0 + 5.0 * torch.randn(100, 4))
    policy = roa_actor(4, 2, 3, 6, hidden=(16, 8), ramp=77, latent=5, scale=0.3, normalizer=normalizer)
    (adaptation,) = (module for module in policy.modules() if isinstance(module, RegularizedAdaptation))
    assert (adaptation.ramp, adaptation.encoder[-1].out_features) == (77, 5)
    data = seen(6)
    with torch.no_grad():
        whole = policy(data.clone())
        plain = policy.get_submodule("module.0.module.network")
        latent = adaptation.encoder(data["randomization"])
        expected = plain.trunk(normalizer(data["observation"]), latent)
    torch.testing.assert_close(whole["loc"], expected)
    torch.testing.assert_close(whole["scale"], torch.full((6, 2), 0.3))
    widths = [layer.out_features for layer in plain.trunk.modules() if isinstance(layer, torch.nn.Linear)]
    assert widths == [16, 8, 2]
