"""The simulated robot cell. Importing it registers the Gymnasium env `RobotGrasping-v0`."""

import gymnasium

gymnasium.register(id="RobotGrasping-v0", entry_point="envs.grasping_env:RobotGraspingEnv")
