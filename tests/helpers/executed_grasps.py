"""Executed grasps that are made up, so that what there is to learn of them is known."""

from __future__ import annotations

import numpy as np

from envs.critic_examples import PLANNERS, Examples
from models.grasp_critic import INPUTS, CriticInputs


def column(inputs: CriticInputs, name: str) -> np.ndarray:
    return inputs.facts[:, INPUTS.index(name)]


def made_up(scenes: int, seed: int, by_patch: bool = False) -> Examples:
    """Candidates that succeed where their cover, one of the inputs, is over a half, or where the
    middle of their patch is high; the search's score says the opposite."""
    rng = np.random.default_rng(seed)
    count = 12 * scenes
    facts = rng.random((count, len(INPUTS))).astype(np.float32)
    high = rng.random(count)
    patches = np.zeros((count, 3, 24, 48), np.int8)
    patches[:, :2, 8:16, 20:28] = np.rint(60 * high).astype(np.int8)[:, None, None, None]
    merit = high if by_patch else facts[:, INPUTS.index("cover")]
    number = np.repeat(np.arange(scenes), 12)
    plan = len(PLANNERS) * number + np.tile(np.arange(12) % len(PLANNERS), scenes)
    drawn = np.ones(count, bool)
    return Examples(
        CriticInputs(facts, patches), merit > 0.5, (1 - merit) ** 4, number, plan, drawn
    )
