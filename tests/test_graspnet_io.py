"""A GraspNet on disk gives the same maps again, and says why where it cannot."""

from __future__ import annotations

import json

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from models.graspnet import GraspNet
from models.graspnet_backbones import BACKBONES
from models.graspnet_io import (
    KIND,
    OUTPUTS,
    SHIPPED,
    SavedGraspNet,
    export_onnx,
    fastest_dtype,
    for_inference,
    load_graspnet,
    load_initial,
    save_graspnet,
)
from utils.checkpoint import save_checkpoint
from utils.errors import UserError

PIXEL = 0.8 / 449.21  # m, the default camera: 224 pixels, 28 degrees, 0.8 m


@pytest.fixture
def model():
    torch.manual_seed(0)
    return GraspNet(max_width=0.08, backbone="ggcnn")


def test_a_saved_network_predicts_as_before_and_takes_less_room(tmp_path, model):
    save_graspnet(tmp_path / "net.pt", model, PIXEL, {"seed": 3}, epoch=7)
    saved = load_graspnet(tmp_path / "net.pt")
    assert saved.metres_per_pixel == PIXEL
    assert saved.config == {"seed": 3} and saved.extra == {"epoch": 7}
    assert saved.model.model_args == model.model_args and not saved.model.training
    x = torch.rand(2, 4, 36, 40)
    with torch.no_grad():
        for ours, theirs in zip(saved.model(x), model.eval()(x)):
            torch.testing.assert_close(ours, theirs, rtol=2e-3, atol=2e-3)
    whole = 4 * sum(value.numel() for value in model.state_dict().values())
    assert (tmp_path / "net.pt").stat().st_size < 0.6 * whole
    save_graspnet(tmp_path / "again.pt", saved.model, PIXEL, {"seed": 3}, epoch=7)
    for (name, once), twice in zip(
        saved.model.state_dict().items(),
        load_graspnet(tmp_path / "again.pt").model.state_dict().values(),
    ):
        assert once.dtype == twice.dtype and torch.equal(once, twice), name


def test_a_training_checkpoint_loads_too(tmp_path, model):
    save_checkpoint(
        tmp_path / "last.pt",
        kind=KIND,
        model_args=model.model_args,
        model=model,
        optimizer=torch.optim.Adam(model.parameters()),
        step=5,
        extra={"metres_per_pixel": PIXEL},
    )
    assert load_graspnet(tmp_path / "last.pt").metres_per_pixel == PIXEL


@pytest.mark.parametrize("saved_head", [False, True])
@pytest.mark.parametrize("new_head", [False, True])
def test_a_network_starts_from_another_with_or_without_a_centre_head(
    tmp_path, capsys, saved_head, new_head
):
    torch.manual_seed(0)
    saved = GraspNet(max_width=0.08, backbone="ggcnn", centre_head=saved_head)
    save_graspnet(tmp_path / "net.pt", saved, PIXEL)
    new = GraspNet(max_width=0.2, backbone="ggcnn", centre_head=new_head)
    before = {name: value.clone() for name, value in new.state_dict().items()}
    load_initial(new, tmp_path / "net.pt")
    for name, value in new.state_dict().items():
        shared = name in saved.state_dict()
        expected = saved.state_dict()[name] if shared else before[name]
        torch.testing.assert_close(value, expected, rtol=2**-11 if shared else 0, atol=2**-25)
    assert (new.centre_head is not None) == new_head
    assert "net.pt: its widths end at 0.08 m, the new network's at 0.2 m; they are 2.5 times" in (
        capsys.readouterr().out
    )
    load_initial(new, tmp_path / "net.pt", quiet=True)
    assert capsys.readouterr().out == ""
    with pytest.raises(UserError, match="net.pt.*another architecture"):
        load_initial(GraspNet(backbone="tutorial"), tmp_path / "net.pt")


def test_a_folded_network_says_the_same_of_centres():
    torch.manual_seed(0)
    model = GraspNet(max_width=0.08, backbone="tutorial_skip", centre_head=True).eval()
    x = torch.rand(1, 4, 48, 64)
    with torch.no_grad():
        for ours, theirs in zip(for_inference(model)(x, centres=True), model(x, centres=True)):
            torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_a_backbone_of_bfloat16_says_nearly_the_same():
    """bfloat16 has 8 bits: a layer rounds by 0.2 % at most. The heads' maps stay float32, in which
    neighbours differ."""
    model = load_graspnet(SHIPPED).model
    x = torch.rand(1, 4, 96, 112, generator=torch.Generator().manual_seed(0)) * 0.2
    with torch.no_grad():
        exact = model(x, logits=True, centres=True)
        ours = for_inference(model, torch.bfloat16)(x, logits=True, centres=True)
    for a, b in zip(ours, exact):
        assert a.dtype == torch.float32
        assert 0 < (a - b).abs().max() < 0.1 * b.std()
    assert len(ours[0].unique()) > 0.9 * ours[0].numel()


@pytest.mark.parametrize(
    ("capabilities", "dtype"),
    [
        ({"amx_bf16": True, "avx512_bf16": True}, torch.bfloat16),
        ({"amx_bf16": False, "avx512_bf16": True}, torch.float32),  # slower there, as measured
        ({"architecture": "arm64", "bf16": True}, torch.float32),
    ],
)
def test_bfloat16_is_for_matrix_units_alone(monkeypatch, capabilities, dtype):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert fastest_dtype() == dtype


def spoil_backbone(content):
    content["model_args"]["backbone"] = "transformer"


def spoil_argument(content):
    content["model_args"]["depth"] = 3


def spoil_bins(content):
    content["model_args"]["num_angle_bins"] = 12


def spoil_version(content):
    content["format_version"] = 99


def spoil_kind(content):
    content["kind"] = "policy"


def spoil_pixel(content):
    del content["extra"]["metres_per_pixel"]


def spoil_weights(content):
    content["model"]["width_head.bias"][0] = float("nan")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoil_backbone, "another architecture.*transformer"),
        (spoil_argument, "another architecture"),
        (spoil_bins, "another architecture"),
        (spoil_version, "version 99"),
        (spoil_kind, "kind 'policy'"),
        (spoil_pixel, "metres_per_pixel"),
        (spoil_weights, "not finite"),
    ],
)
def test_what_does_not_fit_is_said(tmp_path, model, spoil, message):
    path = tmp_path / "net.pt"
    save_graspnet(path, model, PIXEL)
    content = torch.load(path, weights_only=True)
    spoil(content)
    torch.save(content, path)
    with pytest.raises(UserError, match=message) as caught:
        load_graspnet(path)
    assert "net.pt" in str(caught.value)


@pytest.mark.parametrize("kept", [0, 1, 1000, -10])
def test_a_truncated_file_is_said(tmp_path, model, kept):
    path = tmp_path / "net.pt"
    save_graspnet(path, model, PIXEL)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(UserError, match="net.pt"):
        load_graspnet(path)


def test_a_pixel_size_of_zero_is_a_bug(tmp_path, model):
    with pytest.raises(ValueError, match="metres_per_pixel"):
        save_graspnet(tmp_path / "net.pt", model, 0.0)
    assert not (tmp_path / "net.pt").exists()


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_faster_copy_gives_the_same_maps(backbone):
    torch.manual_seed(0)
    model = GraspNet(max_width=0.08, backbone=backbone)
    for module in model.modules():  # as after a training, not the identity
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)
            module.running_var.uniform_(0.5, 2)
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, 0, 0.2)
    model.eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fast = for_inference(model)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in fast.modules())
    assert not any(p.requires_grad for p in fast.parameters())
    x = torch.randn(1, 4, 48, 60)
    with torch.inference_mode():
        exact, ours = model(x, logits=True), fast(x, logits=True)
    assert exact[0].std() > 1e-3
    for a, b in zip(ours, exact):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    after = model.state_dict()  # the given network can still be trained and saved
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


# --- ONNX -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["ggcnn", "tutorial_skip"])
def test_onnx_returns_what_pytorch_returns(tmp_path, backbone):
    torch.manual_seed(0)
    model = GraspNet(max_width=0.08, backbone=backbone, centre_head=True).eval()
    for layer in model.modules():  # statistics that are not those of a fresh layer
        if isinstance(layer, nn.BatchNorm2d):
            layer.running_mean.uniform_(-0.2, 0.2)
            layer.running_var.uniform_(0.2, 1.0)
    path = tmp_path / "net.onnx"
    export_onnx(SavedGraspNet(model, PIXEL, {}, {}), path)
    session = onnxruntime.InferenceSession(str(path))
    described = session.get_modelmeta().custom_metadata_map
    stride = model.backbone.stride
    assert json.loads(described["stride"]) == stride
    assert "centre_head" not in described, "the graph leaves it out"
    assert json.loads(described["metres_per_pixel"]) == PIXEL
    assert [output.name for output in session.get_outputs()] == list(OUTPUTS)
    for batch, rows, columns in ((1, 5, 3), (3, 2, 7)):
        x = 3 * torch.randn(batch, 4, rows * stride, columns * stride)
        with torch.no_grad():
            expected = model(x)
        for ours, theirs in zip(session.run(None, {"image": x.numpy()}), expected):
            assert theirs.std() > 1e-6
            np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-4)
