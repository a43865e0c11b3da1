"""Shared tools that know neither the simulated cell (`envs`) nor the networks (`models`)."""
