"""Everything that decides where and how to grasp. Knows nothing of the simulator (`envs`)."""
