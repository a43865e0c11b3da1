"""Commands to the arm, each of which passes its gate, whatever simulates the arm.

`envs.panda` drives PyBullet's motors, `envs.mujoco_panda` MuJoCo's; no other way leads to them.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from envs.motions import MotionPlanner
from envs.safety import ArmGate, ArmStoppedError, contact_reason


class GuardedArm(MotionPlanner):
    """gate: what every command to the arm passes. q: (7,) rad, where its joints are."""

    gate: ArmGate
    q: np.ndarray

    def command_arm(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Motor targets of one control period of a trajectory: q (7,) rad, velocity (7,) rad/s.
        Gives the q that was sent: another one where the gate has slowed the arm. Raises
        ArmStoppedError, the arm being told to stay where it is, where the gate lets nothing pass.
        """
        try:
            q, velocity = self.gate.passed(q, velocity)
        except ArmStoppedError:
            self.hold()
            raise
        self._send_arm(q, velocity)
        return q

    def drive_arm_to(self, q: np.ndarray, speed: float = np.inf) -> None:
        """Motor targets for several periods: the motors go to q (7,) no faster than the limits,
        nor than `speed` rad/s. Raises ArmStoppedError, and sends nothing, where the gate refuses
        q."""
        self.gate.admit(q)
        self._drive_arm(q, [min(limit, speed) for limit in self.gate.speeds])

    def hold(self) -> None:
        """Tell the arm to stay where it is, which is allowed everywhere."""
        self._stay(self.q)

    def stop_on_contact(self, limit: float) -> None:
        """Hold the arm and raise ArmStoppedError if more than `limit` newtons press against it."""
        reason = contact_reason(self.contact_force(), limit)
        if reason is not None:
            self.hold()
            raise ArmStoppedError(reason, contact=True)

    def _stay(self, q: np.ndarray) -> None:
        self.gate.restart(q)
        self._send_arm(q, np.zeros(7))

    @abstractmethod
    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot."""

    @abstractmethod
    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """Give the motors one period's references, rad and rad/s, each (7,)."""

    @abstractmethod
    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        """Let the motors go to q (7,), rad, at up to `speeds`, seven in rad/s."""
