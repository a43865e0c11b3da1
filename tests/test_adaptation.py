"""Domain-adversarial training: gradients and schedules by hand, and a shift it has to undo."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F

from utils.adaptation import (
    SOURCE,
    TARGET,
    AdaptationSettings,
    Check,
    DomainAdaptationNetwork,
    DomainBatchNorm,
    choose_check,
    mutual_information,
    outputs_of,
    per_domain_norms,
    reversal_weight,
    reverse_gradient,
    select_domain,
    train_domain_adaptation,
)
from utils.errors import UserError


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_the_gradient_is_reversed_and_the_values_are_not(weight):
    torch.manual_seed(0)
    values = torch.randn(4, 3, dtype=torch.double, requires_grad=True)
    classifier = nn.Linear(3, 1).double()

    def gradients(features):
        values.grad = None
        classifier.zero_grad()
        classifier(features).square().sum().backward()
        return values.grad.clone(), classifier.weight.grad.clone()

    plain, plain_classifier = gradients(values)
    reversed_, its_classifier = gradients(reverse_gradient(values, weight))
    torch.testing.assert_close(reversed_, -weight * plain, rtol=1e-12, atol=0)
    # The classifier itself learns forwards, which multiplying its output by -1 would not let it.
    torch.testing.assert_close(its_classifier, plain_classifier, rtol=1e-12, atol=0)
    assert torch.equal(reverse_gradient(values, weight), values)


def test_schedule():
    assert reversal_weight(0.0) == 0
    assert reversal_weight(0.1) == pytest.approx(math.tanh(0.5))  # 2 / (1 + e^-x) - 1 = tanh(x / 2)
    assert reversal_weight(0.5) == pytest.approx(math.tanh(2.5))
    assert reversal_weight(1.0) == pytest.approx(0.99990920)
    with pytest.raises(ValueError, match=r"0\.\.1"):
        reversal_weight(1.5)


def test_the_extractor_is_trained_against_the_classifier():
    """With weight 0 the domain loss moves no feature; otherwise it moves them by -weight."""
    torch.manual_seed(0)
    network = DomainAdaptationNetwork(feature_dim=8)
    images = torch.randn(6, 3, 16, 16)
    network.eval()
    found = {}
    for weight in (0.0, 1.0, 2.0):
        network.zero_grad()
        network(images, SOURCE, weight).domain.sum().backward()
        found[weight] = network.feature_extractor[0].weight.grad.clone()
    assert not found[0.0].any() and found[1.0].any()
    torch.testing.assert_close(found[2.0], 2 * found[1.0])


# --- Batch norm -------------------------------------------------------------------------------


def test_each_domain_has_statistics_of_its_own():
    torch.manual_seed(0)
    norm = DomainBatchNorm(2, momentum=1.0)  # running statistics are the last batch's
    batches = {SOURCE: torch.randn(50, 2, 4, 4), TARGET: 3 * torch.randn(50, 2, 4, 4) + 5}
    for domain, batch in batches.items():
        select_domain(norm, domain)
        norm(batch)
    for domain, batch in batches.items():
        values = batch.transpose(0, 1).flatten(1)
        torch.testing.assert_close(norm.running_mean[domain], values.mean(1))
        torch.testing.assert_close(norm.running_var[domain], values.var(1))  # of the sample
        norm.eval()
        select_domain(norm, domain)
        out = norm(batch).transpose(0, 1).flatten(1)
        torch.testing.assert_close(out.mean(1), torch.zeros(2), atol=1e-4, rtol=0)


def test_converted_norms_compute_the_same():
    torch.manual_seed(0)
    plain = nn.Sequential(nn.Conv2d(3, 4, 3), nn.Sequential(nn.BatchNorm2d(4), nn.ReLU()))
    images = torch.randn(5, 3, 8, 8)
    for _ in range(3):
        plain(images)
    state = {name: value.clone() for name, value in plain.state_dict().items()}
    expected = plain.eval()(images)
    converted = per_domain_norms(plain)
    assert isinstance(converted[1][0], DomainBatchNorm)
    torch.testing.assert_close(converted.eval()(images), expected)
    assert torch.equal(converted[1][0].running_var[TARGET], state["1.0.running_var"])
    with pytest.raises(ValueError, match="affine"):
        per_domain_norms(nn.Sequential(nn.BatchNorm1d(3, affine=False)))


# --- Choosing without labels ------------------------------------------------------------------


@pytest.mark.parametrize(
    "p, nats",
    [
        ([[1, 0], [0, 1]], math.log(2)),  # sure, and both classes occur
        ([[1, 0], [1, 0]], 0.0),  # sure, but always the same
        ([[0.5, 0.5], [0.5, 0.5]], 0.0),  # never sure
        # H(1/2) - H(3/4) with H(3/4) = 2 ln 2 - 3/4 ln 3
        ([[0.75, 0.25], [0.25, 0.75]], 0.75 * math.log(3) - math.log(2)),
    ],
)
def test_mutual_information(p, nats):
    logits = torch.log(torch.tensor(p, dtype=torch.double) + 1e-300)
    assert mutual_information(logits) == pytest.approx(nats, abs=1e-9)
    pixels = logits.T[None].reshape(1, 2, 2, 1)  # (B, classes, H, W)
    assert mutual_information(pixels) == pytest.approx(nats, abs=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 200), st.integers(2, 6))
def test_mutual_information_is_within_its_bounds(seed, classes):
    logits = torch.from_numpy(np.random.default_rng(seed).normal(0, 5, (7, classes)))
    assert -1e-12 <= mutual_information(logits) <= math.log(classes) + 1e-12


def test_the_choice_of_a_checkpoint():
    checks = [Check(1, 0.95, 2.0, 0.5), Check(2, 0.99, 1.0, 0.5), Check(3, 0.975, 1.5, 0.5)]
    assert choose_check(checks).step == 3  # the first is not within 0.02 of the best
    assert choose_check(checks, with_information=False).step == 2


# --- Training ---------------------------------------------------------------------------------


def shifted_blobs(rng, count: int, angle: float, offset: float):
    """Three classes in the plane; the target is turned and moved. Images (N, 3, 1, 1)."""
    labels = rng.integers(3, size=count)
    direction = 2 * np.pi * labels / 3 + angle
    points = 3 * np.column_stack([np.cos(direction), np.sin(direction)])
    points += rng.normal(0, 0.5, points.shape) + offset
    values = np.column_stack([points, np.zeros(count)])
    return torch.from_numpy(values).float().reshape(count, 3, 1, 1), torch.from_numpy(labels)


def blob_network() -> DomainAdaptationNetwork:
    torch.manual_seed(0)
    extractor = nn.Sequential(nn.Flatten(), nn.Linear(3, 32), nn.BatchNorm1d(32), nn.ReLU())
    return DomainAdaptationNetwork(32, 3, feature_extractor=extractor)


QUICK = AdaptationSettings(steps=150, batch_size=32, checks=5)


@pytest.fixture(scope="module")
def blobs():
    rng = np.random.default_rng(0)
    # 40 degrees of the 60 that would leave the target half-way to the next class
    return shifted_blobs(rng, 400, 0.0, 0.0), shifted_blobs(rng, 300, np.radians(40), 4.0)


def test_training_undoes_a_shift(blobs):
    """Source-only calls a moved target wrong; adapted, the network has seen no target label."""
    source, (images, labels) = blobs
    network = blob_network()
    history = train_domain_adaptation(source, images, network, QUICK)
    right = float((outputs_of(network, images).task.argmax(1) == labels).double().mean())
    plain = blob_network()
    train_domain_adaptation(
        source, images, plain, AdaptationSettings(steps=150, batch_size=32, adversarial=0)
    )
    alone = float((outputs_of(plain, images, SOURCE).task.argmax(1) == labels).double().mean())
    assert alone < 0.7 and right > alone + 0.2
    assert [check.step for check in history.checks] == [30, 60, 90, 120, 150]
    assert history.chosen in history.checks and not network.training


def test_training_is_repeatable_and_leaves_the_best_weights(blobs):
    source, (images, _) = blobs
    results, histories = [], []
    for _ in range(2):
        network = blob_network()
        histories.append(train_domain_adaptation(source, images, network, QUICK))
        results.append(outputs_of(network, images).task)
    assert torch.equal(results[0], results[1])
    assert len(histories[0].checks) == 5 and histories[0] == histories[1]


def test_target_labels_cannot_be_seen():
    """There is nowhere to give them: the target is images alone, batches of both are equal."""
    sizes = []

    class Spy(nn.Module):
        def forward(self, images):
            if self.training:
                sizes.append(len(images))
            return images.flatten(1)

    network = DomainAdaptationNetwork(3, 2, feature_extractor=Spy())
    source = torch.randn(90, 3, 1, 1), torch.randint(2, (90,))
    short = AdaptationSettings(steps=7, batch_size=16, checks=1)
    train_domain_adaptation(source, torch.randn(40, 3, 1, 1), network, short)
    assert sizes == [16] * 14


def test_dense_tasks_have_their_own_loss():
    extractor = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU())
    classifier = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 1))
    network = DomainAdaptationNetwork(
        feature_extractor=extractor, task_head=nn.Conv2d(4, 2, 1), domain_classifier=classifier
    )
    images = torch.randn(40, 3, 8, 8)
    labels = (images[:, 0] > 0).long()
    short = AdaptationSettings(steps=20, batch_size=8, checks=2)
    history = train_domain_adaptation(
        (images, labels), torch.randn(40, 3, 8, 8), network, short,
        task_loss=F.cross_entropy, source_score=lambda out, labels: -F.cross_entropy(out, labels),
    )  # fmt: skip
    assert outputs_of(network, images).task.shape == (40, 2, 8, 8)
    assert all(check.source_score < 0 for check in history.checks)


def test_wrong_settings_and_data_are_refused():
    network = blob_network()
    few = torch.randn(20, 3, 1, 1)
    with pytest.raises(UserError, match="the source has 20 images, too few for batches of 64"):
        train_domain_adaptation((few, torch.zeros(20).long()), few, network)
    with pytest.raises(UserError, match="20 images and 3 labels"):
        train_domain_adaptation((few, torch.zeros(3).long()), few, network)
    with pytest.raises(ValueError, match="steps"):
        AdaptationSettings(steps=0)
