"""Which simulators the tests of every simulator run in."""

from envs.simulators import SIMULATORS

INSTALLED = [name for name, simulator in SIMULATORS.items() if simulator.installed]
