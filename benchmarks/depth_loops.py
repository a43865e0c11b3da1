"""The depth camera's noise as loops over pixels: slow, easy to check, and what
`utils.depth.KinectNoise` is timed against (`bench_sim2real`) and has to equal (its test).
"""

from __future__ import annotations

import numpy as np

from utils.depth import KinectNoise, dot_pattern

FB = 480 * 0.075  # pixels x metres: disparity x depth


def steps_and_slopes(side: int = 224) -> np.ndarray:
    """A table at 0.8 m with a box, a ramp, a thin wall and a patch of unknown depth."""
    depth, s = np.full((side, side), 0.8, dtype=np.float32), side // 8
    depth[s : 3 * s, s : 3 * s] = 0.74
    depth[4 * s : 7 * s, s : 3 * s] = np.linspace(0.7, 0.79, 3 * s)[:, None]
    depth[s : 7 * s, 4 * s : 4 * s + 2] = 0.65
    depth[5 * s : 7 * s, 5 * s : 7 * s] = 0
    return depth


def by_loops(noise: KinectNoise, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same measurement, one pixel after another, from the same draws."""
    height, width = depth.shape
    shift_u, shift_v, jitter = rng.standard_normal((3, height, width), dtype=np.float32)
    scale = noise.image_focal / noise.focal
    disparity = np.zeros((height, width))
    for v in range(height):
        for u in range(width):
            x = min(max(u + noise.shift * scale * float(shift_u[v, u]), 0), width - 1)
            y = min(max(v + noise.shift * scale * float(shift_v[v, u]), 0), height - 1)
            left, top = min(int(x), width - 2), min(int(y), height - 2)
            corners = [(top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)]
            z = [float(depth[corner]) for corner in corners]
            if min(z) > 0:
                fx, fy = x - left, y - top
                weights = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
                disparity[v, u] = sum(w * FB / depth for w, depth in zip(weights, z))
    half = round(4 * scale)
    pattern = dot_pattern(height, width, round(3 * scale))
    recognised = np.zeros((height, width), dtype=bool)
    for v in range(half, height - half):
        for u in range(half, width - half):
            if not pattern[v, u] or disparity[v, u] == 0:
                continue
            window = [
                (v + j, u + i) for j in range(-half, half + 1) for i in range(-half, half + 1)
            ]
            known = [disparity[p] for p in window if disparity[p] > 0]
            mean = sum(known) / len(known)
            dots = agree = 0
            for p in window:
                if pattern[p]:
                    dots += 1
                    r2 = ((p[0] - v) ** 2 + (p[1] - u) ** 2) / scale**2
                    near = abs(disparity[p] - mean) < 0.1 * max(1, 1.44 * r2)
                    agree += disparity[p] > 0 and near
            recognised[v, u] = agree > dots / 1.2
    reach = round(3 * scale)
    measured = np.zeros((height, width), dtype=np.float32)
    for v in range(height):
        for u in range(width):
            nearest = None
            for j in range(max(v - reach, 0), min(v + reach + 1, height)):
                for i in range(max(u - reach, 0), min(u + reach + 1, width)):
                    r2 = (j - v) ** 2 + (i - u) ** 2
                    if recognised[j, i] and r2 <= reach**2 and (nearest is None or r2 < nearest[0]):
                        nearest = r2, disparity[j, i]
            if nearest is not None:
                measured[v, u] = FB / (round(nearest[1] * 8 + float(jitter[v, u]) / 6) / 8)
    return measured
