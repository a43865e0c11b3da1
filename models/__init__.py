"""Everything that decides where and how to grasp; no module here knows a simulator (`envs`)."""
