"""What a visual servo did, image by image, and pictures of it.

This module knows no control law: a history holds what each step recorded.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from utils.atomic_files import write_atomic
from utils.transforms import rotation_log

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FRAME_COLOURS = ("tab:red", "tab:green", "tab:blue")  # x, y, z


@dataclass(frozen=True)
class ServoHistory:
    """One row for each of the k images of a run, the first and the last included.

    poses: (k, 4, 4) T_CO of the object in the camera; NaN where it is unknown.
    goal_pose: (4, 4) desired T_CO; NaN where the goal has none.
    points: (k, n, 2) pixels, or (k, 0, 2) where the views hold poses only, or differ in how many
        points they hold. goal_points: (n, 2).
    errors: (k, m), in the law's own units. velocities: (k, 6) commanded v_C, m/s and rad/s.
    condition_numbers: (k,). gains: (k,) 1/s. dt: seconds between images.
    converged: whether the error's norm came under the tolerance. reason: why the run ended.
    """

    poses: np.ndarray
    goal_pose: np.ndarray
    points: np.ndarray
    goal_points: np.ndarray
    errors: np.ndarray
    velocities: np.ndarray
    condition_numbers: np.ndarray
    gains: np.ndarray
    dt: float
    converged: bool
    reason: str

    @property
    def iterations(self) -> int:
        """Number of images, the one at the goal included."""
        return len(self.errors)

    @property
    def times(self) -> np.ndarray:
        """(k,) seconds since the first image."""
        return np.arange(self.iterations) * self.dt

    @property
    def error_norms(self) -> np.ndarray:
        """(k,) Euclidean norms of the errors."""
        return np.linalg.norm(self.errors, axis=1)

    @property
    def camera_poses(self) -> np.ndarray:
        """(k, 4, 4) T_OC of the camera in the object's frame."""
        return np.linalg.inv(self.poses)

    @property
    def distances(self) -> np.ndarray:
        """(k,) metres between camera and object origin."""
        return np.linalg.norm(self.poses[:, :3, 3], axis=1)

    def pose_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """(k,) metres and (k,) radians between the camera's pose and its goal."""
        T = self.goal_pose @ self.camera_poses  # T_GC, the camera relative to its goal
        turns = [np.linalg.norm(rotation_log(R)) for R in T[:, :3, :3]]
        return np.linalg.norm(T[:, :3, 3], axis=1), np.array(turns)

    def plot(self, path: Path | str | None = None, title: str = "") -> Figure:
        """A figure of errors, velocities, condition number, image trajectories and the camera's
        path in 3-D; also written to `path`, unless that is None."""
        from matplotlib.figure import Figure  # slow to import, and few callers need it

        figure = Figure(figsize=(13, 7.5), layout="constrained")
        figure.suptitle(f"{title}: {self.reason}" if title else self.reason)
        panels = [figure.add_subplot(2, 3, i) for i in (1, 2, 3, 4)]
        self._plot_errors(panels[0])
        self._plot_velocities(panels[1], slice(0, 3), "linear velocity (m/s)", "v")
        self._plot_velocities(panels[3], slice(3, 6), "angular velocity (rad/s)", "ω")
        self._plot_condition(panels[2])
        self._plot_image(figure.add_subplot(2, 3, 5))
        self._plot_path(figure.add_subplot(2, 3, 6, projection="3d"))
        return _saved(figure, path)

    def _plot_errors(self, axes: Axes) -> None:
        axes.plot(self.times, self.errors, linewidth=0.8)
        axes.set(xlabel="time (s)", ylabel="error, each component")
        log = axes.twinx()
        log.semilogy(self.times, self.error_norms, "k--", linewidth=1.5)
        log.set_ylabel("norm of the error (dashed)")
        axes.grid(True, alpha=0.3)

    def _plot_velocities(self, axes: Axes, part: slice, label: str, letter: str) -> None:
        for values, axis, colour in zip(self.velocities.T[part], "xyz", FRAME_COLOURS):
            axes.plot(self.times, values, color=colour, label=f"{letter}{axis}")
        axes.set(xlabel="time (s)", ylabel=label)
        axes.grid(True, alpha=0.3)
        axes.legend(loc="best", fontsize="small")

    def _plot_condition(self, axes: Axes) -> None:
        axes.semilogy(self.times, self.condition_numbers, color="tab:purple")
        axes.set(xlabel="time (s)", ylabel="condition number")
        axes.grid(True, alpha=0.3)

    def _plot_image(self, axes: Axes) -> None:
        axes.set(xlabel="u (px)", ylabel="v (px)", title="points in the image")
        if not self.points.size:
            axes.text(0.5, 0.5, "the views hold no points", ha="center", transform=axes.transAxes)
            return
        for i in range(self.points.shape[1]):
            axes.plot(*self.points[:, i].T, linewidth=1)
        for corners, style, label in (
            (self.points[0], "ko--", "start"),
            (self.points[-1], "ks-", "end"),
            (self.goal_points, "r*", "goal"),
        ):
            outline = np.vstack([corners, corners[:1]])
            axes.plot(*outline.T, style, linewidth=0.6, markersize=5, fillstyle="none", label=label)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()  # v grows downwards
        axes.grid(True, alpha=0.3)
        axes.legend(loc="best", fontsize="small")

    def _plot_path(self, axes) -> None:
        axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="camera, object at 0")
        T = self.camera_poses
        if not len(T) or not np.isfinite(T).all():
            axes.set_title("camera path unknown: no poses")
            return
        positions = T[:, :3, 3]
        axes.plot(*positions.T, color="black", linewidth=1)
        length = 0.12 * float(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0).max())
        for i in np.unique(np.linspace(0, len(T) - 1, 8).astype(int)):
            for axis, colour in enumerate(FRAME_COLOURS):
                tip = positions[i] + length * T[i, :3, axis]
                axes.plot(*np.column_stack([positions[i], tip]), color=colour, linewidth=1)
        axes.scatter(0, 0, 0, color="tab:orange", marker="s", label="object")
        if np.isfinite(self.goal_pose).all():
            goal = np.linalg.inv(self.goal_pose)[:3, 3]
            axes.scatter(*goal, color="tab:red", marker="*", s=60, label="goal")
        axes.invert_zaxis()  # the camera looks along +z, so a camera above the object has z < 0
        half = 0.25 * float(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0).max())
        for axis, values in (("x", positions[:, 0]), ("y", positions[:, 1])):
            # A straight path would make the box so thin that its labels overlap.
            getattr(axes, f"set_{axis}lim")(min(values.min(), -half), max(values.max(), half))
        axes.locator_params(nbins=4)
        axes.set_aspect("equal")
        axes.legend(loc="upper left", fontsize="small")


def plot_histories(histories: Mapping[str, ServoHistory], path: Path | str | None = None) -> Figure:
    """A figure that compares runs to one goal, each under its name: the distance and the angle
    between camera and goal, and both speeds, over time. Also written to `path`, unless None."""
    from matplotlib.figure import Figure  # slow to import, and few callers need it

    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for name, history in histories.items():
        metres, radians = history.pose_errors()
        speeds = (np.linalg.norm(history.velocities[:, part], axis=1) for part in _HALVES)
        label = f"{name}: {history.iterations * history.dt:.1f} s"
        for panel, values in zip(axes.flat, (1e3 * metres, np.degrees(radians), *speeds)):
            panel.plot(history.times, values, label=label)
    for panel, label in zip(axes.flat, _COMPARED):
        panel.set(ylabel=label, yscale="log" if panel in axes[0] else "linear")
        panel.grid(True, alpha=0.3)
    for panel in axes[1]:
        panel.set_xlabel("time (s)")
    axes[0, 1].legend(loc="best", fontsize="small")
    return _saved(figure, path)


_HALVES = (slice(0, 3), slice(3, 6))  # linear and angular part of a twist
_COMPARED = (
    "distance to the goal (mm)", "angle to the goal (degrees)",
    "linear speed (m/s)", "angular speed (rad/s)",
)  # fmt: skip


def _saved(figure: Figure, path: Path | str | None) -> Figure:
    if path is not None:
        path, picture = Path(path), io.BytesIO()
        path = path if path.suffix else path.with_name(f"{path.name}.png")
        figure.savefig(picture, format=path.suffix[1:], dpi=90)
        write_atomic(path, picture.getvalue())
    return figure
