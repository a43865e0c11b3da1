"""The simulated robot cell. Importing it registers the Gymnasium envs `RobotGrasping-v0` and
`RandomizedGrasping-v0`."""

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

# isort: split
import gymnasium

gymnasium.register(id="RobotGrasping-v0", entry_point="envs.grasping_env:RobotGraspingEnv")
gymnasium.register(
    id="RandomizedGrasping-v0", entry_point="envs.randomized_env:RandomizedGraspingEnv"
)
