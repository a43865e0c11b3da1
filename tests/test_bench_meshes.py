"""The benchmark of convex parts measures what is known of two boxes."""

import json

import pytest
import trimesh

from benchmarks.bench_meshes import hausdorff, main
from envs.object_parts import from_trimesh


def test_distance_and_volume_of_what_is_known(tmp_path, capsys):
    box, longer = (
        trimesh.creation.box((1, 1, 1)),
        trimesh.creation.box(bounds=[[-0.5] * 3, [0.5, 0.5, 0.8]]),
    )
    assert hausdorff(from_trimesh(box), from_trimesh(longer)) == pytest.approx(0.3, abs=0.02)
    assert hausdorff(from_trimesh(box), from_trimesh(box)) == 0.0
    (tmp_path / "set").mkdir()
    longer.export(tmp_path / "set" / "longer.stl")
    main([str(tmp_path / "set"), "--json", str(tmp_path / "out.json")])
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["here: volume ratio, largest"]["value"] == pytest.approx(1.0, abs=1e-5)
    assert found["here: parts, median"]["value"] == 1
    assert "longer" in capsys.readouterr().out
