"""GraspNet: sizes against closed forms, targets, and the loss against a hand computation."""

import numpy as np
import pytest
import torch

from models.graspnet import (
    GraspLoss,
    GraspNet,
    create_model,
    main,
    targets_from_labels,
    to_input,
)
from models.graspnet_backbones import BACKBONES, GGCNNBackbone, GRConvNetBackbone
from utils.checkpoint import load_checkpoint, load_weights, save_checkpoint
from utils.depth_holes import fill_holes
from utils.errors import UserError

BINS = 18


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


# --- The network ---------------------------------------------------------------------------


def conv(inputs: int, outputs: int, kernel: int) -> int:
    """Weights and biases of a convolution, transposed or not."""
    return inputs * outputs * kernel**2 + outputs


def conv_norm(inputs: int, outputs: int, kernel: int) -> int:
    """The same with batch normalisation's scale and shift."""
    return conv(inputs, outputs, kernel) + 2 * outputs


def test_the_tutorials_parameter_count_layer_by_layer() -> None:
    encoder = sum(
        conv_norm(a, b, 3) + 3 * conv_norm(b, b, 3)
        for a, b in ((4, 32), (32, 64), (64, 128), (128, 256))
    )
    decoder = sum(conv_norm(a, b, 4) for a, b in ((256, 128), (128, 64), (64, 32), (32, 32)))
    heads = conv(32, 1, 1) + conv(32, 18, 1) + conv(32, 1, 1)
    for name in ("tutorial", "tutorial_skip"):
        assert parameters(create_model(4, 18, name=name)) == encoder + decoder + heads


@pytest.mark.parametrize(
    ("backbone", "inputs", "published"),
    [(GGCNNBackbone, 1, 62_420), (GRConvNetBackbone, 4, 1_900_900)],
)
def test_published_counts_of_the_peers(backbone, inputs: int, published: int) -> None:
    # The papers' networks end in four heads (quality, cos, sin, width) of 2x2 pixels.
    assert parameters(backbone(inputs)) + 4 * conv(32, 1, 2) == published


@pytest.mark.parametrize("name", BACKBONES)
@pytest.mark.parametrize("size", [(64, 64), (37, 50), (16, 95), (1, 1)])
def test_maps_have_the_images_size_and_range(name: str, size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    model = create_model(name=name, max_width=0.08).eval()
    with torch.no_grad():
        quality, angle, width = model(3 * torch.randn(2, 4, *size))
    assert quality.shape == width.shape == (2, 1, *size) and angle.shape == (2, 18, *size)
    assert quality.min() >= 0 and quality.max() <= 1
    assert width.min() >= 0 and width.max() <= 0.08


@pytest.mark.parametrize("name", BACKBONES)
def test_the_part_inside_does_not_depend_on_the_padding(name: str) -> None:
    torch.manual_seed(0)
    model = create_model(name=name).eval()
    side = 2 * model.backbone.stride
    x = torch.randn(1, 4, side - 3, side - 1)
    padded = torch.nn.functional.pad(x, (0, 1, 0, 3), mode="replicate")
    with torch.no_grad():
        for small, large in zip(model(x), model(padded)):
            torch.testing.assert_close(small, large[..., : side - 3, : side - 1])


@pytest.mark.parametrize("name", BACKBONES)
def test_a_map_answers_where_the_image_changes(name: str) -> None:
    # Untrained maps shift with the image by whole strides: pixels stay where they are.
    torch.manual_seed(0)
    model = create_model(name=name).eval()
    stride = model.backbone.stride
    middle = max(120 // stride, 8) * stride  # far enough from the image's edge
    x = torch.zeros(1, 4, 2 * middle, 2 * middle)
    x[..., middle - stride : middle, middle - stride : middle] = 1
    moved = x.roll((stride, 2 * stride), dims=(2, 3))
    inner = slice(middle - 2 * stride, middle + 2 * stride)
    with torch.no_grad():
        first = model(x, logits=True)[0].roll((stride, 2 * stride), dims=(2, 3))
        second = model(moved, logits=True)[0]
        # And the answer lies where the change is: padding on one side alone would move it.
        change = (model(x, logits=True)[0] - model(0 * x, logits=True)[0])[0, 0].abs()
    torch.testing.assert_close(first[..., inner, inner], second[..., inner, inner])
    rows, columns = torch.meshgrid(*[torch.arange(2.0 * middle) + 0.5] * 2, indexing="ij")
    for place in (rows, columns):
        assert abs((change * place).sum() / change.sum() - (middle - stride / 2)) <= stride


def test_logits_are_the_quality_before_its_sigmoid() -> None:
    torch.manual_seed(0)
    model, x = create_model().eval(), torch.randn(1, 4, 32, 32)
    torch.testing.assert_close(torch.sigmoid(model(x, logits=True)[0]), model(x)[0])


def test_evaluation_is_deterministic_and_batches_do_not_mix() -> None:
    torch.manual_seed(0)
    model, x = create_model().eval(), torch.randn(3, 4, 48, 48)
    with torch.no_grad():
        together, again, alone = model(x), model(x), model(x[1:2])
    for a, b, c in zip(together, again, alone):
        assert torch.equal(a, b)
        torch.testing.assert_close(a[1:2], c)


def test_unknown_backbone_and_wrong_channels_are_the_users_error() -> None:
    with pytest.raises(UserError, match="'gg-cnn'.*ggcnn.*did you mean ggcnn"):
        create_model(name="gg-cnn")
    with pytest.raises(UserError, match=r"\(1, 3, 32, 32\).*\(B, 4, H, W\)"):
        create_model()(torch.zeros(1, 3, 32, 32))


def test_a_checkpoint_rebuilds_the_network(tmp_path) -> None:
    torch.manual_seed(0)
    model, path = create_model(name="ggcnn", max_width=0.08).eval(), tmp_path / "net.pt"
    save_checkpoint(path, kind="graspnet", model_args=model.model_args, model=model)
    stored = load_checkpoint(path, "graspnet")
    rebuilt = GraspNet(**stored["model_args"]).eval()
    load_weights(rebuilt, stored, path)
    x = torch.randn(1, 4, 30, 40)
    assert all(torch.equal(a, b) for a, b in zip(model(x), rebuilt(x)))
    with pytest.raises(UserError, match="net.pt.*backbone is 'ggcnn', expected 'tutorial'"):
        load_checkpoint(path, "graspnet", model_args=create_model(max_width=0.08).model_args)


def test_the_module_prints_every_backbone(capsys) -> None:
    main()
    printed = capsys.readouterr().out
    assert all(f"{name}\n" in printed for name in BACKBONES)
    assert "3,450,004" in printed and "(2, 18, 224, 224)" in printed


# --- Targets and loss ----------------------------------------------------------------------


def random_labels(seed: int = 0, batch: int = 2, size: tuple[int, int] = (5, 7)):
    random = np.random.default_rng(seed)
    quality = random.uniform(size=(batch, BINS, *size)).astype(np.float32) ** 8
    width = random.uniform(0, 0.08, size=quality.shape).astype(np.float32)
    valid = random.integers(0, 2, size=(batch, 1, *size)).astype(np.float32)
    return torch.from_numpy(quality), torch.from_numpy(width), torch.from_numpy(valid)


def test_targets_of_a_pixel_with_two_good_angles() -> None:
    quality, width = torch.zeros(1, BINS, 1, 2), torch.full((1, BINS, 1, 2), torch.nan)
    quality[0, 0, 0, 0], quality[0, 9, 0, 0] = 0.9, 0.6
    width[0, 0, 0, 0], width[0, 9, 0, 0] = 0.02, 0.05
    targets = targets_from_labels(quality, width)
    assert targets.quality[0, 0, 0, 0] == pytest.approx(0.9)
    assert targets.angle[0, 0, 0, 0] == pytest.approx(27 / 35)  # 0.9^3 to 0.6^3 as 27 to 8
    assert targets.angle[0, 9, 0, 0] == pytest.approx(8 / 35)
    assert targets.width[0, 0, 0, 0] == pytest.approx(0.02)
    assert targets.graspable.flatten().tolist() == [1, 0]
    # The pixel without a grasp: nothing undefined, and a distribution all the same.
    torch.testing.assert_close(targets.angle.sum(1), torch.ones(1, 1, 2))
    assert all(torch.isfinite(target).all() for target in targets)


def test_loss_against_numpy() -> None:
    quality, width, valid = random_labels()
    targets = targets_from_labels(quality, width, valid, graspable_from=0.5)
    torch.manual_seed(1)
    q, a, w = torch.randn(2, 1, 5, 7), torch.randn(2, BINS, 5, 7), 0.08 * torch.rand(2, 1, 5, 7)
    loss = GraspLoss(quality_weight=2.0, angle_weight=3.0, width_weight=5.0)
    total, parts = loss(q, a, w, targets)

    sums = np.zeros(3)
    for image in range(2):
        found = [[], [], []]
        for row, column in np.ndindex(5, 7):
            at = image, slice(None), row, column
            label, best = quality[at].double().numpy(), int(quality[at].argmax())
            if not valid[image, 0, row, column]:
                continue
            p = 1 / (1 + np.exp(-float(q[image, 0, row, column])))
            found[0].append(-label[best] * np.log(p) - (1 - label[best]) * np.log(1 - p))
            if label[best] >= 0.5:
                share = np.exp(a[at].double().numpy())
                share /= share.sum()
                target = label**3 / (label**3).sum()
                found[1].append(-(target * np.log(share)).sum())
                found[2].append(abs(float(w[image, 0, row, column]) - float(width[at][best])))
        sums += [np.mean(part) / 2 for part in found]
    assert [float(parts[f"{n}_loss"]) for n in ("quality", "angle", "width")] == pytest.approx(
        sums.tolist(), rel=1e-5
    )
    assert float(total) == pytest.approx(2 * sums[0] + 3 * sums[1] + 5 * sums[2], rel=1e-5)


def test_centres_cost_what_leads_wrong_on_objects_alone() -> None:
    """By hand: 3 + 4 pixels off at one pixel of two, nothing at the other: 3.5 on average."""
    quality, width, _ = random_labels(batch=1, size=(1, 3))
    offset = torch.tensor([[10.0, -2.0, torch.nan], [0.0, 5.0, torch.nan]]).reshape(1, 2, 1, 3)
    targets = targets_from_labels(quality, width, offset=offset)
    assert targets.on_object.flatten().tolist() == [1, 1, 0]
    said = offset.nan_to_num(99.0) + torch.tensor([[3.0, 0, 0], [-4.0, 0, 0]]).reshape(1, 2, 1, 3)
    maps = torch.zeros(1, 1, 1, 3), torch.zeros(1, BINS, 1, 3), targets.width
    without, _ = GraspLoss(centre_weight=0.2)(*maps, targets)
    total, parts = GraspLoss(centre_weight=0.2)(*maps, targets, said)
    assert float(parts["centre_loss"]) == pytest.approx(3.5)
    assert float(total - without) == pytest.approx(0.7, rel=1e-5)
    # Images of which no centre is known teach the head nothing.
    _, parts = GraspLoss()(*maps, targets_from_labels(quality, width), said)
    assert float(parts["centre_loss"]) == 0


def test_the_centre_head_is_a_fourth_map_when_asked_for() -> None:
    model = create_model(name="ggcnn", centre_head=True)
    assert GraspNet(**model.model_args).centre_head is not None
    x = torch.randn(2, 4, 24, 36)
    assert [tuple(m.shape) for m in model(x, centres=True)][3:] == [(2, 2, 24, 36)]
    assert len(model(x)) == 3
    assert create_model(name="ggcnn").centre_head is None


def test_logits_that_say_nothing_cost_ln_18_and_ln_2() -> None:
    targets = targets_from_labels(*random_labels())
    _, parts = GraspLoss()(
        torch.zeros(2, 1, 5, 7), torch.zeros(2, 18, 5, 7), targets.width, targets
    )
    assert float(parts["angle_loss"]) == pytest.approx(np.log(18), rel=1e-6)
    assert float(parts["quality_loss"]) == pytest.approx(np.log(2), rel=1e-6)
    assert float(parts["width_loss"]) == 0


def test_masked_pixels_do_not_count_and_an_image_without_grasps_is_fine() -> None:
    quality, width, _ = random_labels()
    valid = torch.ones(2, 1, 5, 7)
    valid[:, :, :, 3:] = 0
    targets = targets_from_labels(quality, width, valid)
    torch.manual_seed(1)
    maps = [torch.randn(2, channels, 5, 7) for channels in (1, BINS, 1)]
    first, _ = GraspLoss()(*maps, targets)
    for values in maps:
        values[..., 3:] += 100
    assert GraspLoss()(*maps, targets)[0] == first

    empty = targets_from_labels(torch.zeros(2, BINS, 5, 7), width)
    total, parts = GraspLoss()(*maps, empty)
    assert torch.isfinite(total)
    assert parts["angle_loss"] == 0 and parts["width_loss"] == 0


def test_two_halves_average_to_the_joint_batch() -> None:
    # What data-parallel training relies on.
    targets = targets_from_labels(*random_labels(batch=4))
    torch.manual_seed(1)
    maps = [torch.randn(4, channels, 5, 7) for channels in (1, BINS, 1)]
    whole, _ = GraspLoss()(*maps, targets)
    halves = [
        GraspLoss()(*(m[part] for m in maps), type(targets)(*(t[part] for t in targets)))[0]
        for part in (slice(0, 2), slice(2, 4))
    ]
    torch.testing.assert_close(sum(halves) / 2, whole)


def test_extreme_logits_stay_finite_in_half_precision() -> None:
    targets = targets_from_labels(*random_labels())
    q = torch.full((2, 1, 5, 7), 6e4, dtype=torch.float16, requires_grad=True)
    a = torch.full((2, BINS, 5, 7), -6e4, dtype=torch.float16, requires_grad=True)
    total, _ = GraspLoss()(q, a, targets.width.half(), targets)
    total.backward()
    assert torch.isfinite(total) and torch.isfinite(q.grad).all() and torch.isfinite(a.grad).all()


@pytest.mark.parametrize("name", BACKBONES)
def test_the_gradient_reaches_every_parameter(name: str) -> None:
    torch.manual_seed(0)
    model = create_model(name=name)
    targets = targets_from_labels(*random_labels(size=(32, 32)))
    GraspLoss()(*model(torch.randn(2, 4, 32, 32), logits=True), targets)[0].backward()
    for part, parameter in model.named_parameters():
        assert parameter.grad is not None, part
        # A bias before a normalisation shifts what is taken off again.
        assert parameter.grad.abs().max() > 0 or part.endswith("bias"), part
    for head in (model.quality_head, model.angle_head, model.width_head):
        assert head.weight.grad.abs().max() > 0


def test_a_few_steps_learn_one_image() -> None:
    torch.manual_seed(0)
    model, loss = create_model(name="tutorial_skip"), GraspLoss()
    targets, x = targets_from_labels(*random_labels(size=(16, 16))), torch.randn(2, 4, 16, 16)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    values = []
    for _ in range(12):
        optimizer.zero_grad()
        total, _ = loss(*model(x, logits=True), targets)
        total.backward()
        optimizer.step()
        values.append(total.item())
    assert values[-1] < 0.8 * values[0]


# --- From an image to the input ------------------------------------------------------------


def picture(height: int = 20, width: int = 30) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return rgb, np.full((height, width), 0.8, np.float32)


def test_input_is_centred_scaled_and_cut_off() -> None:
    rgb, depth = picture()
    depth[0, :3] = 0.75, 0.1, 5.0  # 5 cm nearer, then beyond both limits
    rgb[0, 0] = 0, 51, 255
    x = to_input(rgb, depth)
    assert x.shape == (4, 20, 30) and x.dtype == torch.float32
    assert x[:3, 0, 0].tolist() == pytest.approx([-0.5, -0.3, 0.5])
    assert x[3, 0, :4].tolist() == pytest.approx([-0.5, -3, 3, 0], abs=1e-5)
    torch.testing.assert_close(to_input(rgb, depth + 0.3)[3, 5:], x[3, 5:])


@pytest.mark.parametrize("unknown", [0.0, -1.0, np.nan, np.inf])
def test_holes_take_the_nearest_depth(unknown: float) -> None:
    rgb, depth = picture()
    depth[:, 15:] = 0.7
    whole = depth.copy()
    depth[5:9, 3:6] = depth[2:5, 22:25] = unknown
    assert np.array_equal(fill_holes(depth), whole)
    assert torch.equal(to_input(rgb, depth), to_input(rgb, whole))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rgb, depth: (rgb, depth[:-1]), "30x20 and 30x19"),
        (lambda rgb, depth: (rgb, depth * 1000), "800 m.*millimetres"),
        (lambda rgb, depth: (rgb, (depth * 1000).astype(np.uint16)), "millimetres"),
        (lambda rgb, depth: (rgb, depth / 1000), "0.0008 m, expected 0.05 to 10 m"),
        (lambda rgb, depth: (rgb, depth * 0), "no pixel is known"),
        (lambda rgb, depth: (rgb, depth * np.nan), "no pixel is known"),
        (lambda rgb, depth: (rgb, np.stack([depth] * 3, axis=-1)), "one channel"),
        (lambda rgb, depth: (rgb[..., 0], depth), r"rgb.*\(20, 30\)"),
        (lambda rgb, depth: (np.dstack([rgb, rgb[..., :1]]), depth), r"rgb.*\(20, 30, 4\)"),
        (lambda rgb, depth: (rgb / np.float32(255), depth), "uint8"),
    ],
)
def test_an_image_that_cannot_be_meant_is_one_clear_error(change, message: str) -> None:
    with pytest.raises(UserError, match=message):
        to_input(*change(*picture()))
