"""The arm as a velocity-controlled one behind the safety gate, for every servo loop of the cell.

A loop sends desired joint velocities and the age of the image that they rest on; the gate
(`envs.robot_safety.SafetyGate`) limits or refuses them. This module knows neither a control law nor
an image.
"""

from __future__ import annotations

import numpy as np

from envs.cell import Cell
from envs.robot_safety import ArmStoppedError, SafetyGate
from utils.config_schema import SafetyConfig

_MAX_LAG = 0.05  # rad by which the commanded joint positions may be ahead of the true ones
_REST_SECONDS = 0.1  # for the arm to come to rest after the last command


def image_period(cell: Cell) -> int:
    """Physics steps from one image of a servo loop to the next."""
    return max(1, round(cell.config.sim.frequency / cell.config.servo.rate))


class ServoArm:
    """Sends joint velocities to the cell's arm, one physics step at a time, through the gate."""

    def __init__(self, cell: Cell, safety: SafetyConfig | None = None):
        """safety: the gate's limits; None takes those of the cell's config."""
        self.cell, self.robot = cell, cell.robot
        self.gate = SafetyGate(safety or cell.config.safety, cell.config.robot, cell.dt)
        self._reference, self._velocity = cell.robot.q, np.zeros(7)  # of the last command

    def move(self, desired: np.ndarray, perception_age: float) -> None:
        """Send the part of the desired joint velocities (7,), rad/s, that the gate allows, and do
        one physics step.

        perception_age: seconds since the image was taken that the velocities rest on. Where the
        gate allows nothing, the motors hold the arm and ArmStoppedError is raised.
        """
        q = self.robot.q
        verdict = self.gate.check(
            desired, q, self.robot.external_force(), perception_age, self._velocity
        )
        if verdict.reason is not None:
            self._hold()
            raise ArmStoppedError(verdict.reason, verdict.contact)
        self._velocity = verdict.velocity
        ahead = self._reference + verdict.velocity * self.cell.dt
        # The reference of a blocked arm must not run away: the arm would jump when it comes free.
        ahead = np.clip(ahead, q - _MAX_LAG, q + _MAX_LAG)
        self._reference = self.robot.command_arm(ahead, verdict.velocity)
        self.cell.step()

    def wait(self) -> None:
        """Stand still for one physics step; this needs no image."""
        self._hold()
        self.cell.step()

    def stop(self) -> None:
        """Come to rest where the arm is now."""
        self._hold()
        self.cell.step(round(_REST_SECONDS / self.cell.dt))

    def _hold(self) -> None:
        self._reference, self._velocity = self.robot.q, np.zeros(7)
        self.robot.hold()
