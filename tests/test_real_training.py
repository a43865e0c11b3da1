"""Training and cross-validation on real data, on tiny Cornell and Jacquard folders made here."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import train_graspnet
from models.graspnet import create_model
from models.graspnet_io import SHIPPED, load_graspnet, save_graspnet
from models.rectangle_examples import (
    RectangleExamples,
    RectangleImages,
    View,
    best_rectangle,
    judge,
    median_plate_length,
)
from models.rectangle_folds import AUGMENTATION, VIEWS, folds_of, real_folds
from utils.augmentation import Similarity
from utils.config import load_config
from utils.errors import UserError
from utils.real_data import RealSample, image_folds, object_folds
from utils.rectangles import GraspRectangle, rectangle_match

QUICK = ("train.backbone=ggcnn", "train.epochs=1", "train.workers=0", "train.precision=float32")
SHAPE = (120, 160)  # rows, columns
VIEW = View(side=100, size=50, metres_per_pixel=0.004)


def sample(rectangle: GraspRectangle, shape=SHAPE, name="pcd0100") -> RealSample:
    """A dark bar through the rectangle, 5 cm high, on a bright table 1.2 m away."""
    rgb, depth = np.full((*shape, 3), 230, np.uint8), np.full(shape, 1.2, np.float32)
    bar = GraspRectangle(
        rectangle.centre, rectangle.angle, rectangle.width / 2, 3 * rectangle.height
    )
    corners = [np.rint(bar.corners()).astype(np.int32)]
    cv2.fillPoly(rgb, corners, (60, 40, 30))
    cv2.fillPoly(depth, corners, 1.15)
    return RealSample(name, "bar", rgb, depth, (rectangle,))


def write_cornell(folder: Path, count: int, first: int = 100, shape=SHAPE) -> Path:
    """Bars around the middle of each image, in different directions, in Cornell's format."""
    folder.mkdir(parents=True, exist_ok=True)
    middle = np.array([shape[1] / 2, shape[0] / 2])
    for number in range(count):
        centre = middle + (2.0 * number - 10, 0)
        rectangle = GraspRectangle(centre, 0.3 * number, 24.0, 12.0)
        one, stem = sample(rectangle, shape), folder / f"pcd{first + number:04d}"
        Image.fromarray(one.rgb).save(f"{stem}r.png")
        Image.fromarray(one.depth).save(f"{stem}d.tiff")
        corners = "\n".join(f"{u:.3f} {v:.3f}" for u, v in rectangle.corners())
        Path(f"{stem}cpos.txt").write_text(corners + "\n")
        Path(f"{stem}cneg.txt").write_text("")
    return folder


def write_jacquard(folder: Path, objects: int = 3, views: int = 2, side: int = 128) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for view in range(views):
        for number in range(objects):
            rectangle = GraspRectangle(np.array([50.0 + 10 * view, 60.0]), 0.5 * number, 30, 14)
            one, stem = sample(rectangle, (side, side)), folder / f"{view}_object{number}"
            Image.fromarray(one.rgb).save(f"{stem}_RGB.png")
            Image.fromarray(one.depth).save(f"{stem}_perfect_depth.tiff")
            Image.fromarray((one.rgb[..., 0] < 100).astype(np.uint8) * 255).save(f"{stem}_mask.png")
            degrees = np.degrees(rectangle.angle)
            (folder / f"{stem.name}_grasps.txt").write_text(
                f"{rectangle.centre[0]};{rectangle.centre[1]};{degrees};30;14\n"
            )
    return folder


class OneGrasp(torch.nn.Module):
    """A network that says the same grasp of every image: pixel (u, v), angle bin, metres."""

    def __init__(self, pixel, angle_bin, metres):
        super().__init__()
        self.pixel, self.angle_bin, self.metres = pixel, angle_bin, metres
        self.anything = torch.nn.Parameter(torch.zeros(1))

    def forward(self, x):
        height, width = x.shape[-2:]
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        far = (u - self.pixel[0]) ** 2 + (v - self.pixel[1]) ** 2
        quality = torch.exp(-far / 18.0)[None, None]
        angle = torch.zeros(1, 18, height, width)
        bins = torch.arange(18)
        turn = torch.minimum((bins - self.angle_bin) % 18, (self.angle_bin - bins) % 18)
        angle -= (turn**2 / 2.0)[None, :, None, None]
        return quality, angle, torch.full((1, 1, height, width), self.metres)


# --- Views and examples ---------------------------------------------------------------------


def test_a_view_looks_at_the_middle_of_the_image():
    # 100 of 160 x 120 pixels around the centre (79.5, 59.5) become 50: a pixel is two.
    matrix = VIEW.matrix(SHAPE)
    assert matrix @ [79.5, 59.5, 1] == pytest.approx([24.5, 24.5, 1])
    assert matrix @ [89.5, 49.5, 1] == pytest.approx([29.5, 19.5, 1])
    rgb, depth, rectangles = VIEW.warp(sample(GraspRectangle([89.5, 49.5], 0.4, 20, 10)))
    assert rgb.shape == (50, 50, 3) and depth.shape == (50, 50)
    assert rectangles[0].centre == pytest.approx([29.5, 19.5])
    assert (rectangles[0].width, rectangles[0].height) == pytest.approx((10, 5))
    assert rgb[20, 30].tolist() == [60, 40, 30] and rgb[5, 5].tolist() == [230] * 3


def test_views_are_of_their_cameras_scale():
    # Cornell's Kinect: 2.29 mm a pixel at 1.2 m, three fifths as many in the view.
    assert VIEWS["cornell"].metres_per_pixel == pytest.approx(0.0038095, rel=1e-4)


def test_widths_go_from_pixels_to_metres_and_back():
    # 24 px wide in the image are 12 in the view and, at 4 mm a pixel, 48 mm for the network.
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=4, crop=50, max_width=0.2, graspable_from=0.5
    )
    targets = examples._targets(VIEW.warp(one)[2])
    at_centre = targets.width[0, 24, 24]
    assert at_centre == pytest.approx(0.048)
    back, _ = best_rectangle(OneGrasp((24.5, 24.5), 0, float(at_centre)), one, VIEW, 12.0)
    assert (back.width, back.height) == pytest.approx((24, 12), rel=1e-4)
    assert back.centre == pytest.approx([79.5, 59.5], abs=0.05)


def test_wider_labels_than_the_network_can_tell_count_as_its_widest():
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=1, crop=50, max_width=0.03, graspable_from=0.5
    )
    assert examples._targets(VIEW.warp(one)[2]).width.max() == pytest.approx(0.03)


def test_examples_show_what_their_targets_say():
    # Wherever chance turns and shifts it, the label lies on the dark bar, which it labels across.
    one = sample(GraspRectangle([85.0, 55.0], 1.0, 30, 16))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=3, repeats=20, crop=40, max_width=0.3, graspable_from=0.5
    )
    assert len(examples) == 20
    covered = []
    for index in range(20):
        example = examples[0, index]
        assert example.image.shape == (4, 40, 40) and example.targets.angle.shape == (18, 40, 40)
        labelled = example.targets.graspable[0] > 0
        dark = example.image[:3].mean(0) < example.image[:3].mean()
        covered.append(dark[labelled].float().mean())
        again = examples[0, index]
        assert torch.equal(example.image, again.image)
    assert np.nanmean(covered) > 0.95


def test_examples_show_the_corners_of_the_view_too():
    # Crops around the label in the middle alone would start at 6 to 23.
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=1, crop=20, max_width=0.2, graspable_from=0.5
    )
    rng, rectangles = np.random.default_rng(0), VIEW.warp(one)[2]
    starts = {examples._corner(rectangles, rng) for _ in range(400)}
    assert starts >= {(0, 0), (0, 30), (30, 0), (30, 30)}
    assert max(max(start) for start in starts) == 30


def test_labelled_images_have_widths_in_pixels_of_the_view():
    image = RectangleImages([sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))], VIEW)[0]
    assert image.width_in_pixels and image.width.max() == 12
    assert image.quality[0, 24, 24] == 1


def test_the_border_goes_on_beside_the_image():
    wide = View(side=300, size=60, metres_per_pixel=0.004)
    rgb, depth, _ = wide.warp(sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12)))
    assert rgb[0, 0].tolist() == [230] * 3 and depth[0, 0] == pytest.approx(1.2)


def test_turned_rectangles_are_turned_exactly():
    change = Similarity(turn=0.35, scale=1.2).matrix((50, 50))
    one = sample(GraspRectangle([79.5, 59.5], 0.25, 24, 12))
    rectangle = VIEW.warp(one, change)[2][0]
    assert rectangle.angle == pytest.approx(0.6)
    assert rectangle.width == pytest.approx(12 * 1.2)


@pytest.mark.parametrize("ranges", [False, True])
def test_a_slanted_table_is_levelled(ranges):
    # A plane 45 degrees from the image, 1 m away in its middle; a box is 10 % nearer than it.
    v, u = (np.mgrid[:120, :160] - np.reshape([60, 80], (2, 1, 1))) / 260
    table = 1 / (1 + v)
    table = table * np.sqrt(1 + u**2 + v**2) if ranges else table
    depth = table.astype(np.float32)
    depth[50:70, 60:90] *= 0.9
    one = replace(sample(GraspRectangle([80, 60], 0.0, 24, 12)), depth=depth)
    seen = VIEW.levelled(one).depth[10:110, 30:130]
    box = np.zeros((120, 160), bool)
    box[50:70, 60:90] = True
    box = box[10:110, 30:130]
    middle = np.median(seen[~box])
    assert seen.dtype == np.float32 and middle == pytest.approx(1.0, abs=0.05)
    assert np.abs(seen[~box] / middle - 1).max() < 0.01
    assert seen[box] / middle == pytest.approx(0.9, abs=0.005)


def test_only_slanted_views_level_their_samples(tmp_path):
    root = write_cornell(tmp_path / "cornell", 4)
    slope = np.linspace(0.9, 1.4, SHAPE[0], dtype=np.float32)[:, None].repeat(SHAPE[1], 1)
    for file in root.glob("*d.tiff"):
        Image.fromarray(slope).save(file)
    config = load_config(None, ["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    fold = real_folds(config)[0]
    for samples in (fold.test_samples, fold.data.train.samples):
        assert np.ptp(samples[0].depth) < 0.05
    assert VIEWS["cornell"].slanted and not VIEWS["jacquard"].slanted


# --- The metric -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "u, angle_bin, correct, iou",
    [
        (79.5, 0, True, 1.0),
        (87.5, 0, True, 1 / 2),  # 24 wide, 8 off: 16 shared of 32
        (92.5, 0, True, 11 / 37),  # 13 off: 11 shared of 37, over a quarter
        (94.5, 0, False, 9 / 39),  # 15 off: under it
        (79.5, 2, True, None),  # 20 degrees
        (79.5, 4, False, None),  # 40 degrees
        (79.5, 16, True, None),  # -20 degrees, across the seam
    ],
)
def test_metric_from_the_networks_maps(u, angle_bin, correct, iou):
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    model = OneGrasp((24.5 + (u - 79.5) / 2, 24.5), angle_bin, 0.048)
    judged = judge(model, [one], VIEW, 12.0)[0]
    assert judged.correct is correct
    if iou is not None:
        assert judged.iou == pytest.approx(iou, abs=0.01)
    assert np.degrees(judged.angle_error) == pytest.approx(
        10 * min(angle_bin, 18 - angle_bin), abs=1e-3
    )
    assert judged.as_dict()["width_px"] == pytest.approx(24, abs=0.01)


def test_plate_length_is_the_labels_median():
    samples = [sample(GraspRectangle([79.5, 59.5], 0.0, 24, h)) for h in (8, 10, 30)]
    assert median_plate_length(samples) == 10


# --- Folds ----------------------------------------------------------------------------------


@pytest.mark.parametrize("split", ["object", "image"])
def test_folds_are_disjoint_and_cover_everything(split):
    objects = [f"o{number // 4}" for number in range(80)]
    folds = folds_of(objects, split, 5, seed=0)
    assert sorted(i for fold in folds for i in fold.test) == list(range(80))
    for fold in folds:
        assert not set(fold.train) & set(fold.test)
        assert sorted(fold.train + fold.test) == list(range(80))
    shared = [{objects[i] for i in f.train} & {objects[i] for i in f.test} for f in folds]
    assert any(shared) == (split == "image")


def test_objects_that_come_again_stay_in_one_fold():
    # Jacquard's names sort by view: a, b, c, a, b, c.
    folds = object_folds(["a", "b", "c", "a", "b", "c"], 3)
    assert [fold.test for fold in folds] == [(0, 3), (1, 4), (2, 5)]


def test_image_folds_depend_on_the_seed_alone():
    assert image_folds(11, 5, seed=1) == image_folds(11, 5, seed=1) != image_folds(11, 5, seed=2)
    assert sorted(len(fold.test) for fold in image_folds(11, 5, seed=1)) == [2, 2, 2, 2, 3]


def test_a_fold_trains_on_no_test_image(tmp_path):
    root = write_cornell(tmp_path / "cornell", 14)
    config = load_config(None, ["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    for fold in real_folds(config):
        trained = {one.name for one in fold.data.train.samples}
        assert trained == set(fold.train)
        assert {one.name for one in fold.test_samples} == set(fold.test)
        assert not trained & set(fold.test)


# --- The whole pipeline ---------------------------------------------------------------------


def run(monkeypatch, tmp_path, *overrides) -> Path:
    monkeypatch.chdir(tmp_path)
    assert train_graspnet.main([*QUICK, *overrides]) == 0
    return max((tmp_path / "runs" / "train_graspnet").iterdir())


def test_one_epoch_on_cornell(tmp_path, monkeypatch, capsys):
    root = write_cornell(tmp_path / "cornell", 10)
    folder = run(
        monkeypatch, tmp_path, "data.kind=cornell", f"data.root={root}", "data.folds=2",
        "data.repeats=2", "train.batch_size=4",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["complete"] and results["images"] == 10
    names = [one["name"] for fold in results["folds"] for one in fold["predictions"]]
    assert names == [f"pcd{number:04d}" for number in range(100, 110)]
    correct = sum(one["correct"] for fold in results["folds"] for one in fold["predictions"])
    assert correct == results["correct"] == sum(fold["correct"] for fold in results["folds"])
    for fold in results["folds"]:
        assert not set(fold["train"]) & {one["name"] for one in fold["predictions"]}
        for file in ("graspnet.pt", "last.pt", "curves.png", "predictions.png"):
            assert (folder / f"fold{fold['fold']}" / file).is_file()
    saved = load_graspnet(folder / "fold0" / "graspnet.pt")
    assert saved.model.max_width == 0.25
    assert saved.metres_per_pixel == VIEWS["cornell"].metres_per_pixel
    told = capsys.readouterr().out
    assert f"{correct} of 10 correct" in told and "fixed schedule, last weights" in told

    # Everything is there: resuming only tests again, with the same outcome.
    before = (folder / "results.json").read_text()
    assert train_graspnet.main(["--resume", str(folder)]) == 0
    assert (folder / "results.json").read_text() == before


def test_one_fold_of_jacquard_with_weights_and_an_initial_network(tmp_path, monkeypatch):
    root = write_jacquard(tmp_path / "jacquard")
    initial = tmp_path / "simulated.pt"  # its widest opening is another one
    save_graspnet(initial, create_model(name="ggcnn", max_width=0.08), 0.0018)
    weights = tmp_path / "jacquard.pt"
    folder = run(
        monkeypatch, tmp_path, "data.kind=jacquard", f"data.root={root}", "data.folds=3",
        "data.fold=1", "data.repeats=1", "train.batch_size=2", f"train.initial={initial}",
        f"--weights={weights}",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["complete"] and [fold["fold"] for fold in results["folds"]] == [1]
    names = [one["name"] for one in results["folds"][0]["predictions"]]
    assert names == ["0_object1", "1_object1"]
    assert load_graspnet(weights).model.max_width == 0.25


@pytest.mark.slow
def test_bars_are_learned(tmp_path, monkeypatch):
    """A few steps from the shipped weights find the bars of the other fold."""
    root = write_cornell(tmp_path / "cornell", 12, shape=(480, 640))
    folder = run(
        monkeypatch, tmp_path, "data.kind=cornell", f"data.root={root}", "data.folds=2",
        "data.fold=0", "data.repeats=20", "train.batch_size=4", "train.epochs=6",
        "train.backbone=tutorial_skip", f"train.initial={SHIPPED}", "train.lr=0.001",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["accuracy"] >= 0.8


# --- What is told about bad input -----------------------------------------------------------


def test_root_has_to_be_named_and_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="needs root"):
        train_graspnet.main(["data.kind=cornell"])
    with pytest.raises(UserError, match="no folder .*nowhere"):
        train_graspnet.main(["data.kind=cornell", f"data.root={tmp_path / 'nowhere'}"])
    assert not (tmp_path / "runs").exists()


def test_half_a_file_is_told_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = write_cornell(tmp_path / "cornell", 10)
    picture = root / "pcd0103r.png"
    picture.write_bytes(picture.read_bytes()[:200])
    with pytest.raises(UserError, match="pcd0103r.png"):
        train_graspnet.main(["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    picture.unlink()
    with pytest.raises(UserError, match="1 files are missing: pcd0103r.png"):
        train_graspnet.main(["data.kind=cornell", f"data.root={root}", "data.folds=2"])


def test_folds_that_cannot_be_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = write_cornell(tmp_path / "cornell", 4)
    cornell = ["data.kind=cornell", f"data.root={root}"]
    with pytest.raises(UserError, match="expected 2 to 2"):  # two objects: 100..101 and 102..
        train_graspnet.main([*cornell, "data.folds=3"])
    with pytest.raises(UserError, match="fold 5 is not below folds"):
        train_graspnet.main([*cornell, "data.fold=5"])
    with pytest.raises(UserError, match="choose one by data.fold"):
        train_graspnet.main([*cornell, "data.folds=2", f"--weights={tmp_path / 'w.pt'}"])


def test_the_same_rectangle_matches_itself_through_a_view():
    label = GraspRectangle([70.3, 50.2], 2.2, 31, 13)
    there = VIEW.warp(sample(label))[2][0]
    back = there.transformed(np.linalg.inv(VIEW.matrix(SHAPE)))
    assert rectangle_match(back, [label])
    assert back.corners() == pytest.approx(label.corners())
