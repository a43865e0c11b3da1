"""Visual servoing in the cell: python -m benchmarks.bench_servo_cell [--json FILE]

Every law, with the camera in the hand and with the camera above the table, servoes the arm to a
board that it sees in rendered images, from random starts to random goals. How far from the goal it
really ends is read from the simulator, which the loop itself never does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from benchmarks.metrics import Metric, benchmark_parser, report
from envs.board import Board
from envs.board_servo import BoardCamera, servo_settings, servo_to_goal, view_of
from envs.cell import wrist_mount
from envs.cell_layout import Scene
from envs.pybullet_bodies import PybulletCarriedBoard, add_board
from envs.pybullet_cell import PybulletCell
from envs.pybullet_panda import ARM
from envs.robot_kinematics import TOOL_LENGTH, inverse_kinematics, rotation_vector
from utils.config import load_config
from utils.servo_features import MOUNTINGS
from utils.servo_history import ServoHistory
from utils.servo_loop import ServoView, VisualServo
from utils.transforms import inverse_pose, pose_matrix, top_down_pose
from utils.visual_servo import (
    AdaptiveGain,
    HybridVisualServo,
    ImageBasedVisualServo,
    PositionBasedVisualServo,
)

LAWS = {
    "image_based": (ImageBasedVisualServo, {}),
    "position_based": (PositionBasedVisualServo, {}),
    "hybrid_blend": (HybridVisualServo, {}),
    "hybrid_2.5d": (HybridVisualServo, {"scheme": "2.5d"}),
}
GAIN = AdaptiveGain(at_zero=4.0, at_infinity=1.5, slope_at_zero=30.0)
POSITION_TARGET, ANGLE_TARGET = 0.5, 0.5  # mm, degrees

_FACING = np.diag([1.0, -1.0, -1.0])  # a board's axes in a camera that looks straight at it
_TURNED_RIGHT = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # its y axis along W's x axis


@dataclass(frozen=True)
class Task:
    """A board in the cell, the arm at the start, and the pose to be reached.

    T_GO: (4, 4) the board in the camera at the goal. body: PyBullet's number of the board.
    """

    cell: PybulletCell
    mounting: str
    board: Board
    body: int
    carried: PybulletCarriedBoard | None
    T_GO: np.ndarray

    def servo(self, law: str, **options) -> VisualServo:
        make, settings = LAWS[law]
        return make(**servo_settings(self.cell, self.mounting), lambda_=GAIN, **settings, **options)

    def goal(self, servo: VisualServo) -> ServoView:
        return view_of(self.board, servo.camera, self.T_GO)

    def camera(self) -> BoardCamera:
        return BoardCamera(self.cell, self.board, self.mounting)

    def run(self, law: str) -> ServoHistory:
        servo = self.servo(law)
        return servo_to_goal(self.cell, servo, self.goal(servo), self.camera(), self.carried)

    def true_pose(self) -> np.ndarray:
        """(4, 4) T_CO as it is in the simulator."""
        client = self.cell.client
        T_WO = pose_matrix(
            *pybullet.getBasePositionAndOrientation(self.body, physicsClientId=client)
        )
        if self.mounting == "eye_to_hand":
            return inverse_pose(self.cell.camera_pose("overhead")) @ T_WO
        link = pybullet.getLinkState(
            self.cell.robot.body, ARM[-1], computeForwardKinematics=True, physicsClientId=client
        )
        T_WE = pose_matrix(*link[4:6]) @ pose([0, 0, TOOL_LENGTH], [0, 0, -45])
        return inverse_pose(T_WE @ wrist_mount(self.cell.config.camera)) @ T_WO

    def errors(self) -> tuple[float, float]:
        """Millimetres and degrees between goal and truth, of what moved: of the camera in the
        hand, or of the board that the hand carries."""
        T_CO = self.true_pose()
        T_GC = self.T_GO @ inverse_pose(T_CO)
        in_hand = self.mounting == "eye_in_hand"
        off = T_GC[:3, 3] if in_hand else T_CO[:3, 3] - self.T_GO[:3, 3]
        angle = np.linalg.norm(rotation_vector(T_GC[:3, :3]))
        return 1e3 * float(np.linalg.norm(off)), float(np.degrees(angle))


def pose(position, degrees, R: np.ndarray | None = None) -> np.ndarray:
    """(4, 4) pose at a position (3,), turned from R (3, 3) about its own x, y and z in turn."""
    T = np.eye(4)
    turn = Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()
    T[:3, :3], T[:3, 3] = turn if R is None else R @ turn, position
    return T


def make_task(cell: PybulletCell, mounting: str, seed: int, straight: bool = False) -> Task:
    """A start and a goal drawn from a seed, about 5 to 15 cm and 5 to 20 degrees apart.

    straight: at the goal the camera looks straight at the board and their axes are parallel. The
    renderer does not blend at edges, so this is where an image tells least about a small motion.
    """
    cell.build(Scene("isolated", seed, ()))
    rng = np.random.default_rng([seed, MOUNTINGS.index(mounting)])
    board = Board()

    def around(*reach: float) -> np.ndarray:
        return rng.uniform(-1, 1, 3) * reach

    if mounting == "eye_in_hand":
        T_WO = pose([0.5, 0, 0.04] + around(0.03, 0.03, 0.01), around(5, 5, 5), _TURNED_RIGHT)
        T_GO = pose([0, 0, 0.22] + around(0.01, 0.01, 0.01), around(6, 6, 10), _FACING)
        if straight:
            T_GO = pose([0, 0, 0.22], [0, 0, 0], _FACING)
        T_GC = pose([0, 0, -0.08] + around(0.02, 0.02, 0.02), around(5, 5, 20))
        T_WE = T_WO @ inverse_pose(T_GO) @ T_GC @ inverse_pose(wrist_mount(cell.config.camera))
        cell.robot.place(inverse_kinematics(T_WE, cell.home))
        return Task(cell, mounting, board, add_board(cell.client, board, T_WO), None, T_GO)
    # The board lies beyond the fingers, face up, where the arm does not hide it from above.
    T_EO = pose([0.14, 0, 0] + around(0.01, 0.01, 0.01), around(3, 3, 3), np.diag([1.0, -1, -1]))
    T_EO[:3, :3] = T_EO[:3, :3] @ _TURNED_RIGHT
    start = pose([0.36, 0, 0.2] + around(0.02, 0.03, 0.03), around(4, 4, 10))
    start[:3, :3] = top_down_pose([0, 0, 0], -np.pi / 2)[:3, :3] @ start[:3, :3]
    cell.robot.place(inverse_kinematics(start, cell.home))
    carried = cell.attach_board(board, T_EO)
    T_WO = pose([0.5, 0, 0.26] + around(0.015, 0.015, 0.02), around(6, 6, 12), _TURNED_RIGHT)
    if straight:
        T_WO = pose([0.5, 0, 0.26], [0, 0, 0], _TURNED_RIGHT)
    T_GO = inverse_pose(cell.camera_pose("overhead")) @ T_WO
    return Task(cell, mounting, board, carried.body, carried, T_GO)


def accuracy_metrics(cell: PybulletCell, seeds: Sequence[int], straight: bool) -> list[Metric]:
    """For each mounting and law the largest errors at the end, the time, and who did not settle."""
    metrics = []
    for mounting in MOUNTINGS:
        for law in LAWS:
            errors, seconds, failures = [], [], 0
            for seed in seeds:
                task = make_task(cell, mounting, seed, straight)
                history = task.run(law)
                errors.append(task.errors())
                seconds.append(history.times[-1])
                failures += not history.converged
            name = f"{mounting}_{law}" + ("_straight" if straight else "")
            position, angle = np.max(errors, axis=0).tolist()
            metrics += [
                Metric(f"{name}_position_error", position, "mm", at_most=POSITION_TARGET),
                Metric(f"{name}_angle_error", angle, "degrees", at_most=ANGLE_TARGET),
                Metric(f"{name}_seconds", float(np.median(seconds)), "s simulated"),
                Metric(f"{name}_not_settled", failures, "", at_most=0),
            ]
    return metrics


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=5, help="random starts for each law")
    parser.add_argument("--seed", type=int, default=0, help="of the first start")
    options = parser.parse_args(argv)
    count = 1 if options.quick else options.starts
    with PybulletCell(load_config()) as cell:
        seeds = range(options.seed, options.seed + count)
        metrics = accuracy_metrics(cell, seeds, straight=False)
        if not options.quick:
            metrics += accuracy_metrics(cell, seeds, straight=True)
    report(metrics, options.json)


if __name__ == "__main__":
    main()
