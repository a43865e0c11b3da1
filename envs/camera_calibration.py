"""The calibration of the cell's cameras, and its errors.

Images come from the cameras' true poses; planners and loops know the poses of a `CameraCalibration`
only. In a miscalibrated cell both cameras are off, each in a direction of its own. What a camera
has seen itself is free of that error: `teach` lets the wrist camera look at a board on a jig at a
known place before the fingers (teaching by showing), from which goals follow as views of that very
camera.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from envs.board import Board
from envs.camera import Intrinsics, wrist_mount
from envs.cell import Cell
from envs.robot_kinematics import forward_kinematics
from utils.table_plane import fit_table_plane
from utils.transforms import RGBDFrame, inverse_pose

_BOARD_DEPTH = 0.25  # m from the camera to the board on the jig
_BOARD_TURN = np.diag([1.0, -1.0, -1.0])  # its face towards the camera


@dataclass(frozen=True)
class CameraCalibration:
    """The poses of the cameras that the program assumes.

    T_WC: (4, 4) overhead camera. T_EC: (4, 4) wrist camera in the gripper. levelled: whether frames
    are turned and lifted until their table lies at its known height.
    """

    T_WC: np.ndarray
    T_EC: np.ndarray
    levelled: bool = False

    def frame(self, frame: RGBDFrame, mount: str, T_WE: np.ndarray) -> RGBDFrame:
        """A frame with the assumed camera pose. mount: overhead or wrist. T_WE: (4, 4) the gripper
        by its encoders."""
        T_WC = self.T_WC if mount == "overhead" else T_WE @ self.T_EC
        frame = replace(frame, T_WC=T_WC)
        return level(frame) if self.levelled else frame


def true_calibration(cell: Cell) -> CameraCalibration:
    return CameraCalibration(cell.camera_pose("overhead"), wrist_mount(cell.config.camera))


def wrong_calibration(
    cell: Cell, rng: np.random.Generator, distance: float, angle: float
) -> CameraCalibration:
    """A calibration in which both cameras are `distance` metres and `angle` radians off, each in
    random directions."""
    true = true_calibration(cell)
    T_WC, T_EC = (displaced(T, rng, distance, angle) for T in (true.T_WC, true.T_EC))
    return CameraCalibration(T_WC, T_EC, levelled=True)


def displaced(T: np.ndarray, rng: np.random.Generator, distance: float, angle: float) -> np.ndarray:
    """A pose (4, 4) shifted and turned on the spot, each in a direction uniform on the sphere."""
    shift, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    wrong = T.copy()
    wrong[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix() @ T[:3, :3]
    wrong[:3, 3] += distance * shift
    return wrong


def level(frame: RGBDFrame, table: float = 0.0) -> RGBDFrame:
    """The frame with its camera turned in place and lifted, so that its table is level at z =
    `table`. Horizontal position and heading keep their errors. Without this a planner finds the
    table two centimetres in the air and plans nothing."""
    normal, offset = fit_table_plane(frame.depth, frame.K, inverse_pose(frame.T_WC), table)
    up = frame.T_WC[:3, :3] @ normal
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    T_WC = frame.T_WC.copy()
    T_WC[:3, :3] = turn.as_matrix() @ T_WC[:3, :3]
    T_WC[2, 3] = table + offset
    return replace(frame, T_WC=T_WC)


@functools.lru_cache(maxsize=2)
def teach(cell: Cell) -> np.ndarray:
    """(4, 4) T_CE as the wrist camera itself shows it: from the board's pose in one image, taken
    while the jig holds the board at a known pose in E. The first call empties the cell; later calls
    return the same pose."""
    servo, camera = cell.config.servo, cell.config.camera
    intrinsics = Intrinsics(
        servo.width, servo.height, camera.wrist_fov_deg, camera.near, camera.far
    )
    T_EB = np.eye(4)  # the jig: the board's middle lies before the camera's nominal place
    T_EB[:3, :3] = wrist_mount(camera)[:3, :3] @ _BOARD_TURN
    T_EB[:3, 3] = np.add(camera.wrist_position, [0.0, 0.0, _BOARD_DEPTH])
    board = Board(cell=0.009)
    cell.show_board(board, forward_kinematics(cell.home) @ T_EB)
    rgb = cell.look(intrinsics, cell.camera_pose("wrist")).rgb
    T_CB = board.pose(board.find(rgb), intrinsics.K)
    return T_CB @ inverse_pose(T_EB)
