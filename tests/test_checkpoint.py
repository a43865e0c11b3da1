"""Checkpoints: what is saved comes back, and every bad file is one clear error."""

import io
import pickle
import zipfile

import numpy as np
import pytest
import torch
from torch import nn

from utils.checkpoint import (
    FORMAT_VERSION,
    MAGIC,
    build_model,
    check_weights_file,
    load_checkpoint,
    load_weights,
    reading,
    restore_rng,
    rng_states,
    save_checkpoint,
)
from utils.errors import UserError

ARGS = {"width": 3}


def training(seed: int = 0):
    """A small model, with momentum and a schedule that have a state worth saving."""
    torch.manual_seed(seed)
    model = nn.Sequential(nn.Linear(4, 3), nn.BatchNorm1d(3), nn.Linear(3, 1))
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.01)
    return model, optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 20)


def steps(count: int, model, optimizer, scheduler, random: np.random.Generator) -> None:
    for _ in range(count):
        x = torch.from_numpy(random.normal(size=(8, 4)).astype(np.float32))
        x = x + 0.1 * torch.randn(8, 4)
        optimizer.zero_grad()
        model(x).square().mean().backward()
        optimizer.step()
        scheduler.step()


def save(path, model=None, **changes) -> None:
    content = {"kind": "test", "model_args": ARGS, "model": model or training()[0]}
    save_checkpoint(path, **(content | changes))


def test_a_resumed_run_equals_an_uninterrupted_one_bit_by_bit(tmp_path) -> None:
    path = tmp_path / "half.pt"
    straight, random = training(), np.random.default_rng(5)
    steps(3, *straight, random)
    model, optimizer, scheduler = straight
    save(
        path, model, optimizer=optimizer, scheduler=scheduler, step=3,
        rng=rng_states({"data": random}), config={"train": {"lr": 0.01}}, extra={"best": 0.5},
    )  # fmt: skip
    steps(3, *straight, random)

    resumed, random = training(seed=9), np.random.default_rng(77)
    stored = load_checkpoint(path, "test", model_args=ARGS)
    load_weights(resumed[0], stored, path)
    resumed[1].load_state_dict(stored["optimizer"])
    resumed[2].load_state_dict(stored["scheduler"])
    restore_rng(stored["rng"], {"data": random})
    steps(3, *resumed, random)

    assert stored["step"] == 3 and stored["config"] == {"train": {"lr": 0.01}}
    assert stored["extra"] == {"best": 0.5}
    assert resumed[2].get_last_lr() == scheduler.get_last_lr()
    for name, value in model.state_dict().items():
        assert torch.equal(value, resumed[0].state_dict()[name]), name


def test_half_precision_is_rounded_to_eleven_bits_where_float16_reaches(tmp_path) -> None:
    model = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Linear(2, 1))
    with torch.no_grad():
        model[0].weight.copy_(torch.tensor([[1 + 2**-11, 1 + 3 * 2**-11], [-1 / 3, 1e-9]]))
        model[0].bias.fill_(1 / 3)
        model[1].weight.copy_(torch.tensor([[70_000.0, 1 / 3]]))
    save(tmp_path / "half.pt", model, half_precision=True)
    stored = load_checkpoint(tmp_path / "half.pt", "test")["model"]
    # Halves round to the even last bit: 1 + 2^-11 down, 1 + 3 x 2^-11 up.
    expected = torch.tensor([[1.0, 1 + 2**-9], [-0.333251953125, 0.0]])
    assert torch.equal(stored["0.weight"].float(), expected)
    for name in ("0.bias", "1.weight"):  # a vector, and more than float16 holds
        assert torch.equal(stored[name], model.state_dict()[name])


def test_torch_generators_continue_too(tmp_path) -> None:
    generator = torch.Generator().manual_seed(3)
    save(tmp_path / "g.pt", rng=rng_states({"order": generator}))
    expected = torch.rand(4, generator=generator)
    other = torch.Generator().manual_seed(8)
    restore_rng(load_checkpoint(tmp_path / "g.pt", "test")["rng"], {"order": other})
    assert torch.equal(torch.rand(4, generator=other), expected)


def refused(path, kind: str = "test", **expected) -> str:
    with pytest.raises(UserError) as error:
        load_checkpoint(path, kind, **expected)
    message = str(error.value)
    assert str(path) in message and "\n" not in message
    return message


def test_a_missing_file_and_a_folder(tmp_path) -> None:
    assert "No such file" in refused(tmp_path / "none.pt")
    assert "directory" in refused(tmp_path)


def test_only_a_checkpoint_of_its_kind_is_replaced(tmp_path) -> None:
    config, policy = tmp_path / "mine.yaml", tmp_path / "policy.pt"
    config.write_text("seed: 1\n")
    save(policy)
    check_weights_file("--weights", tmp_path / "new.pt", "test")
    check_weights_file("--weights", policy, "test")
    for kind, path in (("test", config), ("critic", policy)):
        with pytest.raises(UserError, match=f"{path}: would replace a file that holds no {kind}"):
            check_weights_file("--weights", path, kind)
    assert config.read_text() == "seed: 1\n"


def test_another_kind_version_or_architecture(tmp_path) -> None:
    path = tmp_path / "c.pt"
    save(path)
    assert "'test', expected 'ppo'" in refused(path, "ppo")
    assert "width is 3, expected 5" in refused(path, model_args={"width": 5})
    save(path, format_version=FORMAT_VERSION + 1)
    message = refused(path)
    assert f"version {FORMAT_VERSION + 1}" in message and f"version {FORMAT_VERSION}" in message


def test_weights_that_do_not_fit_leave_the_model_as_it_was(tmp_path) -> None:
    path = tmp_path / "c.pt"
    save(path)
    stored = load_checkpoint(path, "test")
    for other in (nn.Linear(4, 3), nn.Sequential(nn.Linear(4, 2), nn.BatchNorm1d(2))):
        before = {name: value.clone() for name, value in other.state_dict().items()}
        with pytest.raises(UserError, match="c.pt: a checkpoint of another architecture"):
            load_weights(other, stored, path)
        assert all(torch.equal(before[n], v) for n, v in other.state_dict().items())


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file(tmp_path, share: float) -> None:
    path = tmp_path / "c.pt"
    save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "truncated or damaged" in refused(path)


def test_a_flipped_byte_in_the_weights_is_noticed(tmp_path) -> None:
    path, model = tmp_path / "c.pt", training()[0]
    save(path, model)
    whole, weights = bytearray(path.read_bytes()), model[0].weight.detach().numpy().tobytes()
    whole[whole.index(weights) + 5] ^= 1
    path.write_bytes(whole)
    assert "truncated or damaged" in refused(path)


class Intruder:
    """A pickle that would run code, if it were let."""

    ran = False

    def __reduce__(self):
        return setattr, (Intruder, "ran", True)


def test_what_is_no_checkpoint(tmp_path) -> None:
    path = tmp_path / "c.pt"
    for content in (b"", b"some text", pickle.dumps({"magic": 1})):
        path.write_bytes(content)
        assert "not a checkpoint" in refused(path)
    for thing in ({"weights": torch.zeros(2)}, torch.zeros(2), Intruder()):
        torch.save(thing, path)
        assert "not a checkpoint" in refused(path)
    assert not Intruder.ran


@pytest.mark.parametrize("value", [np.float64(1), np.zeros(2), Intruder()])
def test_what_could_not_be_loaded_is_not_saved_and_the_old_file_stays(tmp_path, value) -> None:
    path = tmp_path / "c.pt"
    save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError, match=r"checkpoint.extra.a\[1\]"):
        save(path, extra={"a": [0, value]})
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["c.pt"]


# --- Hostile files --------------------------------------------------------------------------------


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    made, path = tmp_path / "made", tmp_path / "bad.pt"

    class Code:
        def __reduce__(self):
            return made.touch, ()

    save(path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, pickle.dumps(Code()) if name.endswith("data.pkl") else content)
    with pytest.raises(UserError, match=r"bad.pt: not a checkpoint of this project \(Unpickling"):
        load_checkpoint(path, "test")
    assert not made.exists()


def test_a_small_file_that_stands_for_much_is_refused(tmp_path):
    path = tmp_path / "bad.pt"
    save(path, extra={"zeros": torch.zeros(1).expand(10**6, 10**6)})
    with pytest.raises(UserError, match="its parts do not fit"):
        load_checkpoint(path, "test")
    laughs = []
    for _ in range(40):
        laughs = [laughs, laughs]
    content = {"magic": MAGIC, "format_version": FORMAT_VERSION, "kind": "test", "model_args": ARGS}
    content |= {"model": {}, "optimizer": None, "scheduler": None, "step": 0, "rng": {}}
    torch.save(content | {"config": {}, "extra": {"laughs": laughs}}, path)
    with pytest.raises(UserError, match="its parts do not fit"):
        load_checkpoint(path, "test")
    endless = {}
    endless["again"] = endless
    torch.save(content | {"config": endless, "extra": {}}, path)
    with pytest.raises(UserError, match="not a checkpoint of this project"):
        load_checkpoint(path, "test")
    torch.save(content | {"config": {}, "extra": {}}, path)
    whole = path.read_bytes()
    with zipfile.ZipFile(io.BytesIO(whole)) as archive, zipfile.ZipFile(path, "w", 8) as packed:
        for name in archive.namelist():
            packed.writestr(name, archive.read(name))
    with pytest.raises(UserError, match="truncated or damaged .it is compressed"):
        load_checkpoint(path, "test")


def test_nothing_is_built_of_a_size_that_the_weights_do_not_have(tmp_path):
    def make(width):
        return nn.Sequential(nn.Linear(4, width), nn.BatchNorm1d(width), nn.Linear(width, 1))

    path = tmp_path / "bad.pt"
    for width, message in (
        (99_999, "do not fit"),
        (10**12, "larger than"),
        ("3", "must be tuple of ints"),
    ):
        save(path, model_args={"width": width})
        with pytest.raises(UserError, match=f"bad.pt: a checkpoint of another.*{message}"):
            build_model(make, load_checkpoint(path, "test"), path)
    model = make(3)
    with torch.no_grad():
        model[0].weight[0, 0] = torch.nan
    save(path, model)
    with pytest.raises(UserError, match="bad.pt: holds weights that are not finite"):
        build_model(make, load_checkpoint(path, "test"), path)


def test_entries_that_do_not_fit_are_one_sentence(tmp_path):
    model, optimizer, _ = training()
    with (
        pytest.raises(UserError, match="last.pt: the checkpoint's entries do not fit .KeyError"),
        reading("last.pt"),
    ):
        {}["rewards"]
    with (
        pytest.raises(UserError, match="last.pt: the checkpoint's entries do not fit .*; start"),
        reading("last.pt"),
    ):
        optimizer.load_state_dict({"state": {}, "param_groups": []})
    with (
        pytest.raises(UserError, match="last.pt: the checkpoint's entries do not fit"),
        reading("last.pt"),
    ):
        restore_rng({"torch": torch.zeros(3)}, {})
