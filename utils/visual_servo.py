"""Visual servoing: move a camera until it sees what it should see. The tutorial's chapter 4.

This module is the import path of the three servos and of what they need; `python -m
utils.visual_servo` repeats known results and draws them (`utils.servo_reference`).

    servo = ImageBasedVisualServo({"intrinsics": K}, lambda_=0.5)
    step = servo.step(ServoView(pixels, depths), ServoView(goal_pixels))    # one image: a twist
    history = servo.run(see, move, goal)        # a whole run, with any camera and any robot
    history = servo.simulate(points_O, T_CO, T_GO)      # the same with an ideal camera

The laws stand in `utils.servo_laws`, the loop in `utils.servo_loop`, the record of a run and its
pictures in `utils.servo_history`, gains, limits and the arm's Jacobian in `utils.servo_control`,
points, depths and interaction matrices in `utils.servo_features`. None of them knows a simulator;
docs/servo.md explains them.
"""

from __future__ import annotations

from utils.errors import (
    CameraMatrixError,
    CollinearPointsError,
    DepthError,
    FeatureCountError,
    PointError,
    PoseError,
    ServoError,
    SingularMatrixError,
)
from utils.servo_control import (
    AdaptiveGain,
    TwistLimits,
    joint_limit_avoidance,
)
from utils.servo_features import DepthFromMotion
from utils.servo_history import ServoHistory
from utils.servo_laws import HybridVisualServo, ImageBasedVisualServo, PositionBasedVisualServo
from utils.servo_loop import ServoCommand, ServoView

__all__ = [
    "AdaptiveGain",
    "CameraMatrixError",
    "CollinearPointsError",
    "DepthError",
    "DepthFromMotion",
    "FeatureCountError",
    "HybridVisualServo",
    "ImageBasedVisualServo",
    "PointError",
    "PoseError",
    "PositionBasedVisualServo",
    "ServoCommand",
    "ServoError",
    "ServoHistory",
    "ServoView",
    "SingularMatrixError",
    "TwistLimits",
    "joint_limit_avoidance",
]

if __name__ == "__main__":
    from utils.servo_reference import main

    main()
