"""Who draws random numbers from a scene's seed besides the scene itself.

A generator's key is a list of numbers. NumPy fills it up with zeros, so that [seed], [seed, 0] and
[seed, 0, 0] give the same numbers; a scene is drawn with [seed, i], where i is the place of its
layout in `envs.cell_scenes.LAYOUTS`. No key of another draw may therefore end with 0, and one of
two numbers ends with a stream beyond all layouts.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """The last number of a key."""

    # [seed, number of the frame, stream]
    PLANNING_NOISE = 1  # frames that planners see (`envs.cell.Cell.frame`)
    WRIST_NOISE = 3  # images of the closed loop (`envs.closed_loop_tracker.WristCamera`)
    OBSERVATION_NOISE = 5  # images of the environment (`envs.env_observations.Observer`)
    SECOND_NOISE = 9  # second frames (`envs.second_look.SecondLook`)
    # [seed, number of the attempt from 1, stream]
    MOTION = 7  # objects that move (`envs.scenarios`)
    # [seed, stream]
    SIDE_VIEW = 11  # the pose of a camera at the side (`envs.cell_layout.side_view`)
    APPEARANCE = 13  # a randomised scene (`envs.simulators`)
    TRACKED_MOTION = 15  # of an object that is tracked (`benchmarks.bench_tracking`)
    PLANNER = 17  # `planner_seed`
    LABEL_TRIALS = 19  # the pairs that are executed (`benchmarks.bench_labels`)


def planner_seed(scene_seed: int) -> int:
    """The seed that a planner is reset with for a scene: its draws are none of the scene's, and the
    scene, a pure function of its seed, cannot be made again from it."""
    return int(np.random.default_rng([scene_seed, Stream.PLANNER]).integers(2**63))
