"""Visual servoing beside a peer: python -m benchmarks.bench_servo [--json FILE]

Image-based servoing by this repository and by machinevision-toolbox-python from the same starts to
the same goal, until the image error is under 1e-5: images needed, final pose error, and time for
one step (look, control, move, record) on one core. Then every law of ours on 200 starts.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from time import process_time

import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, median_ratio, positive_int, report
from utils.runs import run_script
from utils.servo_reference import (
    CAMERA,
    FOCAL,
    GOAL,
    NEAR_GOAL,
    SQUARE,
    START,
    TOLERANCE,
    random_start,
)
from utils.visual_servo import (
    HybridVisualServo,
    ImageBasedVisualServo,
    PositionBasedVisualServo,
    ServoError,
)

HOW_TO_INSTALL = (
    "machinevision-toolbox-python is not installed: it would bring opencv-python, which overwrites "
    "opencv-python-headless, so install it without what it depends on: pip install --no-deps "
    "machinevision-toolbox-python spatialmath-python ansitable colored pgraph-python"
)
GAIN, DT = 0.5, 0.04
MAX_ITERATIONS = 1500


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument(
        "--starts", type=positive_int, default=200, help="random starts for our laws"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    options = parser.parse_args(argv)
    try:
        import machinevisiontoolbox  # noqa: F401
    except ImportError as error:
        raise SystemExit(f"{HOW_TO_INSTALL} ({error})") from None
    rng = np.random.default_rng(options.seed)
    starts = [random_start(rng) for _ in range(10 if options.quick else options.starts)]
    repeats = 3 if options.quick else 11
    metrics = peer_metrics([START, *starts[: 4 if options.quick else 20]])
    metrics += time_metrics(repeats)
    report(metrics + law_metrics(starts), options.json)


def peer_run(T_CO: np.ndarray, T_GO: np.ndarray, max_iterations: int = MAX_ITERATIONS):
    """The toolbox's history from start to goal; (iterations, T_CO at the end, seconds a step)."""
    from machinevisiontoolbox import IBVS, CentralCamera
    from spatialmath import SE3

    camera = CentralCamera(f=FOCAL, rho=1, pp=(320, 240), imagesize=(640, 480))
    servo = IBVS(
        camera, P=SQUARE.T, pose_0=SE3(np.linalg.inv(T_CO)), pose_d=SE3(np.linalg.inv(T_GO)),
        eterm=TOLERANCE * FOCAL, lmbda=GAIN * DT, graphics=False, niter=max_iterations,
    )  # fmt: skip
    with redirect_stdout(io.StringIO()):
        begin = process_time()
        servo.run()
        seconds = process_time() - begin
    steps = len(servo.history)
    # The recorded pose is the one after the step; undo it, to compare what was last looked at.
    pose = servo.history[-2].pose.A if steps > 1 else np.linalg.inv(T_CO)
    return steps, np.linalg.inv(pose), seconds / steps


def our_run(T_CO: np.ndarray, T_GO: np.ndarray, max_iterations: int = MAX_ITERATIONS):
    """The same of ours."""
    servo = ImageBasedVisualServo(CAMERA, GAIN, dt=DT)
    begin = process_time()
    history = servo.simulate(SQUARE, T_CO, T_GO, max_iterations=max_iterations)
    seconds = process_time() - begin
    return history.iterations, history.poses[-1], seconds / history.iterations


def peer_metrics(starts: Sequence[np.ndarray]) -> list[Metric]:
    """Iterations and final error, ours and the toolbox's; starts on which either fails apart."""
    differences, errors, ours_failed, theirs_failed = [], [], 0, 0
    for i, T_CO in enumerate(starts):
        goal = GOAL if i == 0 else NEAR_GOAL
        ours, theirs = attempt(our_run, T_CO, goal), attempt(peer_run, T_CO, goal)
        ours_failed += ours is None
        theirs_failed += theirs is None
        if ours and theirs:
            differences.append(abs(ours[0] - theirs[0]))
            errors.append([np.linalg.norm(run[1][:3, 3] - goal[:3, 3]) for run in (ours, theirs)])
        if i == 0:
            first = ours, theirs
    worst = (np.max(errors, axis=0) * 1e6).tolist()
    return [
        Metric("iterations_A_ours", first[0][0], ""),
        Metric("iterations_A_toolbox", first[1][0], ""),
        Metric(f"iterations_difference_largest_of_{len(differences)}", max(differences), ""),
        Metric("final_position_error_largest_ours", worst[0], "um"),
        Metric("final_position_error_largest_toolbox", worst[1], "um"),
        Metric("image_based_failures_ours", ours_failed, ""),
        Metric("image_based_failures_toolbox", theirs_failed, ""),
    ]


def attempt(run, T_CO: np.ndarray, T_GO: np.ndarray):
    """run's result, or None where it raised or did not come within 1 mm."""
    try:
        result = run(T_CO, T_GO)
    except (ServoError, np.linalg.LinAlgError, ValueError):
        return None
    off = np.linalg.norm(result[1][:3, 3] - T_GO[:3, 3])
    return result if result[0] < MAX_ITERATIONS and off < 1e-3 else None


def time_metrics(repeats: int) -> list[Metric]:
    ours, theirs = [], []

    def timed(run, found: list) -> float:
        found.append(run(START, GOAL)[2] * 1e6)
        return found[-1]

    ratio = median_ratio(lambda: timed(peer_run, theirs), lambda: timed(our_run, ours), repeats)
    return [
        Metric("step_time_ours", float(np.median(ours)), "us"),
        Metric("step_time_toolbox", float(np.median(theirs)), "us"),
        Metric("step_time_toolbox_over_ours", ratio, "x", at_least=5),
    ]


def law_metrics(starts: Sequence[np.ndarray]) -> list[Metric]:
    """Share of starts from which each law arrives, how far it strays, and its time for a step."""
    metrics = []
    for name, servo, promised in (
        ("image_based", ImageBasedVisualServo(CAMERA), False),
        ("image_based_mean", ImageBasedVisualServo(CAMERA, interaction="mean"), False),
        ("position_based", PositionBasedVisualServo(CAMERA), False),
        ("hybrid_blend", HybridVisualServo(CAMERA), True),
        ("hybrid_2.5d", HybridVisualServo(CAMERA, scheme="2.5d"), True),
    ):
        arrived, steps, farthest = 0, 0, 0.0
        begin = process_time()
        for T_CO in starts:
            try:
                history = servo.simulate(SQUARE, T_CO, NEAR_GOAL, max_iterations=MAX_ITERATIONS)
            except ServoError:
                continue
            arrived += history.converged
            steps += history.iterations
            farthest = max(farthest, float(history.distances.max() / history.distances[0]))
        microseconds = (process_time() - begin) / steps * 1e6
        share = arrived / len(starts)
        metrics += [
            Metric(f"converged_{name}", share, "", at_least=1.0 if promised else None),
            Metric(f"farthest_{name}", farthest, "x start", at_most=1.5 if promised else None),
            Metric(f"step_time_{name}", microseconds, "us"),
        ]
    return metrics


if __name__ == "__main__":
    run_script(main)
