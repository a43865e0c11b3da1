"""The schema of the configuration: types and ranges of every key, as frozen typed objects.

`configs/default.yaml` holds defaults, units and meanings. A new key is a field of a section here
and a line there; a new section is a `Section` here, a field of `Config`, and its keys there. Types
that several sections share and the section of randomisation are in `utils.config_types`. Keys that
name an entry of a registry or a plug-in are plain names here; `envs.registries` checks them. This
module reads no files and writes no error messages (`utils.config` does).
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from utils.config_types import (
    Count,
    File,
    JointVector,
    KeywordArguments,
    Mount,
    Name,
    Names,
    Pixels,
    Positive,
    PositiveWait,
    RandomizationConfig,
    RunName,
    Section,
    Several,
    Share,
    SimulatorName,
    TermScales,
    TestSets,
    Timeout,
    TrainingSets,
    Vector2,
    Vector3,
    Wait,
    changed,
    no_repeats,
)
from utils.depth import DepthNoise, make_depth_noise
from utils.errors import UserError
from utils.geometry import TRAY_CENTRE, TRAY_HALF_SIZE, TRAY_WALL, GripperGeometry, Workspace
from utils.transforms import look_at


class ComputeConfig(Section):
    scheduler: Name | None
    timeout: Timeout


class SimConfig(Section):
    frequency: Annotated[int, Field(ge=60, le=2000)]
    solver_iterations: Annotated[int, Field(ge=1, le=1000)]
    renderer: Literal["auto", "tiny", "egl"]


class RobotConfig(Section):
    arm: Literal["panda", "none"]
    home: JointVector
    grip_force: Annotated[float, Field(gt=0, le=70)]  # the Franka Hand's own limit
    velocity_scale: Annotated[float, Field(ge=0.01, le=1)]  # slower, an attempt takes minutes
    acceleration_scale: Annotated[float, Field(ge=0.01, le=1)]


class GripperConfig(Section):
    max_opening: Annotated[float, Field(ge=0.02, le=0.2)]
    opens_fully: bool
    least_held: Annotated[float, Field(ge=0, le=0.02)]

    @model_validator(mode="after")
    def _opens_wider_than_empty(self) -> GripperConfig:
        if self.least_held >= self.max_opening:
            raise ValueError(
                f"least_held ({self.least_held}) must be smaller than max_opening "
                f"({self.max_opening}): a hand that is wide open would count as empty"
            )
        return self

    @property
    def geometry(self) -> GripperGeometry:
        """The hand: the shapes of its fingers and palm are the Panda's, the rest is its own."""
        return GripperGeometry(**self.model_dump())


class CameraConfig(Section):
    mount: Mount
    width: Pixels
    height: Pixels
    fov_deg: Annotated[float, Field(ge=1, le=170)]
    position: Vector3
    target: Vector3
    up: Vector3
    view: Literal["fixed", "side"]
    side_tilt_deg: Vector2
    side_distance: Vector2
    side_azimuth_deg: Vector2
    near: Positive
    far: Positive
    depth_noise: Name
    depth_noise_args: Annotated[
        KeywordArguments, Field(description="the noise's parameters, such as {noise: 0.3}")
    ]
    wrist_position: Vector3
    wrist_fov_deg: Annotated[float, Field(ge=1, le=170)]

    @model_validator(mode="after")
    def _near_before_far(self) -> CameraConfig:
        if self.near >= self.far:
            raise ValueError(f"near ({self.near}) must be smaller than far ({self.far})")
        look_at(self.position, self.target, self.up)  # raises ValueError where that is undefined
        return self

    @model_validator(mode="after")
    def _side_view_is_overhead(self) -> CameraConfig:
        if self.view == "side" and self.mount == "wrist":
            raise ValueError(
                "view=side places the overhead camera, but camera.mount=wrist is set; set "
                "camera.view=fixed or camera.mount=overhead"
            )
        return self

    @model_validator(mode="after")
    def _ranges_of_side_views(self) -> CameraConfig:
        for name, least, most in (
            ("side_tilt_deg", 1, 89), ("side_distance", 0.05, 5), ("side_azimuth_deg", -360, 360),
        ):  # fmt: skip
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name} must be a range [low, high] within [{least}, {most}], got "
                    f"[{low:g}, {high:g}]"
                )
        return self

    @model_validator(mode="after")
    def _arguments_of_a_noise(self) -> CameraConfig:
        if self.depth_noise_args and self.depth_noise == "none":
            raise ValueError(
                "depth_noise_args would be ignored: they are the parameters of camera.depth_noise, "
                "which is none; set that, too"
            )
        return self

    def make_noise(self, image_focal: float) -> DepthNoise | None:
        """The depth noise of a camera whose focal length is image_focal pixels; None for none."""
        return make_depth_noise(self.depth_noise, image_focal, self.depth_noise_args)


class WorkspaceConfig(Section):
    center: Vector2
    size: Annotated[float, Field(gt=0, le=0.5)]

    @model_validator(mode="after")
    def _within_reach(self) -> WorkspaceConfig:
        x, y = (abs(c) + self.size / 2 for c in self.center)
        if np.hypot(x, y) > 0.8 or self.center[0] - self.size / 2 < 0.2:
            raise ValueError(
                "the workspace must lie within 0.8 m of the robot and at least 0.2 m in front of it"
            )
        return self

    @model_validator(mode="after")
    def _beside_the_tray(self) -> WorkspaceConfig:
        half = TRAY_HALF_SIZE + TRAY_WALL
        if (abs(self.center - TRAY_CENTRE) < half + self.size / 2).all():
            (x, y), (far_x, far_y) = TRAY_CENTRE - half, TRAY_CENTRE + half
            raise ValueError(
                f"the workspace must not overlap the tray, which takes x from {x:g} to {far_x:g} m "
                f"and y from {y:g} to {far_y:g} m: move workspace.center or make workspace.size "
                "smaller"
            )
        return self

    @property
    def geometry(self) -> Workspace:
        """The square on the table, which is at z = 0."""
        return Workspace(self.center, self.size)


class ObjectsConfig(Section):
    split: Literal["test", "train", "sealed", "unseen_families"]
    scale: Positive | None
    fit: Positive | None
    density: Annotated[float, Field(ge=1, le=25_000)]
    skip_broken: bool


class SceneConfig(Section):
    simulator: SimulatorName
    count: Annotated[int, Field(ge=1, le=50)]
    settle_seconds: PositiveWait


class ExecutionConfig(Section):
    pregrasp_height: Annotated[float, Field(gt=0, le=0.3)]
    approach_speed: Annotated[float, Field(ge=0.005, le=1.7)]
    lift_height: Annotated[float, Field(gt=0, le=0.3)]
    hold_seconds: Wait
    contact_stop: Positive
    strict: bool
    on_contact: Literal["fail", "grip"]


class SafetyConfig(Section):
    box_lower: Vector3
    box_upper: Vector3
    joint_margin: Annotated[float, Field(ge=0, le=0.3)]
    linear_speed: Annotated[float, Field(gt=0, le=1.7)]
    angular_speed: Annotated[float, Field(gt=0, le=2.5)]
    contact_stop: Positive
    watchdog: Positive

    @model_validator(mode="after")
    def _box_has_an_inside(self) -> SafetyConfig:
        if not all(low < high for low, high in zip(self.box_lower, self.box_upper)):
            raise ValueError("box_lower must be below box_upper in x, y and z")
        return self


class ServoConfig(Section):
    rate: Annotated[int, Field(ge=1, le=1000)]
    width: Pixels
    height: Pixels


class ClosedLoopConfig(Section):
    controller: Name
    width: Pixels
    height: Pixels
    fov_deg: Annotated[float, Field(ge=1, le=170)]
    gain: Positive
    look_height: Annotated[float, Field(gt=0, le=0.3)]
    commit_height: Annotated[float, Field(gt=0, le=0.3)]
    descend_speed: Annotated[float, Field(gt=0, le=1.0)]
    aligned_distance: Positive
    aligned_angle: Positive
    floor: Annotated[float, Field(ge=0)]
    compute_seconds: Wait
    lost_seconds: PositiveWait
    final_seconds: PositiveWait
    seconds: PositiveWait
    camera_shift: Annotated[float, Field(ge=0)]
    camera_turn_deg: Annotated[float, Field(ge=0, le=45)]

    @model_validator(mode="after")
    def _commits_below_the_look(self) -> ClosedLoopConfig:
        if self.commit_height > self.look_height:
            raise ValueError("commit_height must not be above look_height")
        return self


class EvaluateConfig(Section):
    policies: Names
    controllers: Names | None
    scenarios: Names
    object_sets: TestSets
    depth_noises: Names | None
    rounds: Count
    randomise: bool
    workers: Count | None
    max_failures: Count
    abstain: Annotated[float, Field(ge=0, le=1)] | None
    second_look: Annotated[float, Field(ge=0)]
    videos: Annotated[int, Field(ge=0)]
    film_format: Literal["mp4", "gif"]
    gallery: Annotated[int, Field(ge=0)]
    name: RunName | None


class TransferPolicy(NamedTuple):
    """A row of the transfer report. policy, training: as the report shows them. planner: as in
    evaluate.policies. scenes: scenario and object set that it is scored on, None for those of the
    section evaluate. train_with: the command that makes the planner's file."""

    policy: str
    training: str
    planner: str
    scenes: tuple[str, str] | None
    train_with: str | None


TransferScenes = Annotated[tuple[Name, Name], Field(strict=False)]
TransferRow = Annotated[
    tuple[Name, Name, Name, TransferScenes | None, Name | None],
    Field(
        strict=False,
        description="a list of policy, training, planner, [one of evaluate.scenarios, one of "
        "evaluate.object_sets] or null, command or null",
    ),
    AfterValidator(lambda values: TransferPolicy(*values)),
]


class TransferConfig(Section):
    policies: Annotated[tuple[TransferRow, ...], Several, AfterValidator(no_repeats)] | None
    columns: Names
    cornell: File | None


class DataConfig(Section):
    kind: Name
    root: File | None
    split: Literal["object", "image"]
    folds: Annotated[int, Field(ge=2)]
    fold: Annotated[int, Field(ge=0)] | None
    repeats: Count
    frames: Count
    validation_frames: Count
    object_sets: TrainingSets
    max_objects: Annotated[int, Field(ge=2, le=12)]
    randomise: bool
    randomise_physics: bool
    executed_share: Annotated[float, Field(ge=0, le=1)]
    workers: Count | None

    @model_validator(mode="after")
    def _fold_exists(self) -> DataConfig:
        if self.fold is not None and self.fold >= self.folds:
            raise ValueError(f"fold {self.fold} is not below folds ({self.folds})")
        if self.fold is not None and self.kind == "simulated":
            raise ValueError("fold is one of photographs, and kind is simulated; set fold to null")
        return self


class TrainConfig(Section):
    backbone: Name
    max_width: Annotated[float, Field(gt=0, le=0.5)] | None
    initial: File | None
    epochs: Count
    batch_size: Count
    lr: Positive
    weight_decay: Annotated[float, Field(ge=0)]
    warmup_share: Annotated[float, Field(ge=0, lt=1)]
    quality_weight: Annotated[float, Field(ge=0)]
    angle_weight: Annotated[float, Field(ge=0)]
    width_weight: Annotated[float, Field(ge=0)]
    centre_weight: Annotated[float, Field(ge=0)]
    graspable_from: Share
    depth_noise_share: Annotated[float, Field(ge=0, le=1)]
    depth_noises: Names
    precision: Literal["auto", "float32", "bfloat16", "float16"]
    device: Name
    workers: Annotated[int, Field(ge=0)] | None
    name: RunName | None


class AdaptationConfig(Section):
    target: File | None
    weight: Annotated[float, Field(ge=0)]
    held_out: Annotated[float, Field(gt=0, lt=1)]


class EnvConfig(Section):
    observations: Names
    control: Name
    frame: Literal["world", "hand"]
    gripper: Literal["opening", "change"]
    resolution: Pixels
    camera: Mount
    objects: Name
    scenario: Name
    reward: Annotated[
        Name | TermScales,
        Field(
            description="one of dense, sparse, an import path module:function, or scales of terms "
            "such as {success: 1, progress: 0.5}"
        ),
    ]
    goal: Literal["object", "grasp"]
    max_steps: Count
    substeps: Annotated[int, Field(ge=1, le=1000)]
    lift_height: Annotated[float, Field(gt=0, le=0.4)]
    hold_seconds: Wait
    position_step: Positive
    rotation_step: Positive
    joint_step: Positive
    gripper_step: Positive
    near_share: Annotated[float, Field(ge=0, le=1)]

    @model_validator(mode="after")
    def _goals_of_one_object(self) -> EnvConfig:
        if self.goal == "grasp" and self.scenario != "isolated":
            raise ValueError("goal 'grasp' is for one object: it needs scenario 'isolated'")
        return self

    def hold_steps(self, frequency: int) -> int:
        """How many observations in a row span hold_seconds: n of them, n - 1 actions. frequency:
        Hz, of the physics steps."""
        return math.ceil(self.hold_seconds * frequency / self.substeps - 1e-9) + 1


EnvArgument = Annotated[
    str, Field(pattern=r"^[A-Za-z_]\w*=", description="NAME=VALUE, the value as YAML")
]


class RLConfig(Section):
    env_id: Name
    env_kwargs: Annotated[tuple[EnvArgument, ...], Several] | None
    policy_observations: Names | None
    privileged_observations: Names | None
    estimated_observations: Names | None
    envs: Count
    parallel: bool
    worker_timeout: Timeout
    total_steps: Count
    rollout_steps: Count
    epochs: Count
    batch_size: Count
    lr: Positive
    anneal_lr: bool
    gamma: Share
    gae_lambda: Annotated[float, Field(ge=0, le=1)]
    clip_epsilon: Annotated[float, Field(gt=0, lt=1)]
    target_kl: Positive | None
    value_coef: Annotated[float, Field(ge=0)]
    entropy_coef: Annotated[float, Field(ge=0)]
    max_gradient_norm: Positive
    estimate_epochs: Count
    estimate_lr: Positive
    estimate_memory: Annotated[int, Field(ge=0)]
    estimate_recall: Count
    pretraining_images: Annotated[int, Field(ge=0)]
    pretraining_lr: Positive
    normalise_observations: bool
    normalise_rewards: bool
    squash: bool
    initial_log_std: Annotated[float, Field(ge=-5, le=2)]
    conv_channels: Annotated[tuple[Count, ...], Several]
    image_feature_dim: Count
    relief: bool
    hidden_dim: Count
    hidden_layers: Count
    activation: Name
    initial: File | None
    evaluate_every: Count
    evaluation_episodes: Count
    films: Annotated[int, Field(ge=0)]
    target_success: Share | None
    target_return: float | None
    device: Name
    name: RunName | None

    @model_validator(mode="after")
    def _one_role_each(self) -> RLConfig:
        for name in self.estimated_observations or ():
            if name in (self.policy_observations or ()):
                raise ValueError(f"estimated_observations: the policy sees {name!r} already")
            if name in (self.privileged_observations or ()):
                raise ValueError(f"{name!r} is both in estimated_ and privileged_observations")
        return self

    @model_validator(mode="after")
    def _pretraining_teaches_something(self) -> RLConfig:
        if self.pretraining_images and not self.estimated_observations:
            raise ValueError("pretraining_images teach the estimates: name estimated_observations")
        return self

    @model_validator(mode="after")
    def _whole_minibatches(self) -> RLConfig:
        steps, batch = self.envs * self.rollout_steps, self.batch_size
        if steps % batch:
            small = [n for n in range(1, math.isqrt(steps) + 1) if steps % n == 0]
            sizes = sorted({*small, *(steps // n for n in small)})
            beside = [*[n for n in sizes if n < batch][-1:], *[n for n in sizes if n > batch][:1]]
            raise ValueError(
                f"batch_size ({batch}) must divide envs x rollout_steps ({steps}); use "
                f"rl.batch_size={' or '.join(map(str, beside))}"
            )
        return self


class Config(Section):
    """Everything that a run depends on; units and meanings stand in configs/default.yaml."""

    seed: Annotated[int, Field(ge=0, lt=2**32)]
    cache_dir: File | None
    simulator: SimulatorName
    compute: ComputeConfig
    sim: SimConfig
    robot: RobotConfig
    gripper: GripperConfig
    camera: CameraConfig
    workspace: WorkspaceConfig
    objects: ObjectsConfig
    scene: SceneConfig
    execution: ExecutionConfig
    safety: SafetyConfig
    servo: ServoConfig
    closed_loop: ClosedLoopConfig
    data: DataConfig
    train: TrainConfig
    adaptation: AdaptationConfig
    evaluate: EvaluateConfig
    transfer: TransferConfig
    env: EnvConfig
    rl: RLConfig
    randomization: RandomizationConfig

    @model_validator(mode="after")
    def _possible_fields_of_view(self) -> Config:
        widened = self.randomization.vision.camera_fov
        factor = changed(widened.operation, 1.0, widened.high)
        for key, degrees in (
            ("camera.fov_deg", self.camera.fov_deg),
            ("camera.wrist_fov_deg", self.camera.wrist_fov_deg),
            ("closed_loop.fov_deg", self.closed_loop.fov_deg),
        ):
            widest = factor * degrees
            if "vision" in self.randomization.parts and widest >= 180:
                raise ValueError(
                    f"randomization.vision.camera_fov: high ({widened.high}) makes a field of view "
                    f"of {widest:g} degrees out of {key}; expected less than 180"
                )
        return self

    @property
    def cache_folder(self) -> Path:
        """`cache_dir`, else $ROBOT_GRASPING_CACHE, else ~/.cache/robot_grasping. May not exist.
        Raises UserError for the home folder of a user whom this machine does not know."""
        chosen = self.cache_dir or os.environ.get("ROBOT_GRASPING_CACHE")
        folder = Path(chosen or "~/.cache/robot_grasping")
        try:
            return folder.expanduser()
        except RuntimeError:
            raise UserError(
                f"cache_dir {folder}: this machine knows no such home folder; set cache_dir or "
                "$ROBOT_GRASPING_CACHE to a whole path"
            ) from None

    def make_cache_folder(self) -> None:
        """Make the cache folder, or raise UserError where that cannot be done."""
        try:
            self.cache_folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"cache_dir {self.cache_folder}: cannot make this folder ({error.strerror}); set "
                "cache_dir or $ROBOT_GRASPING_CACHE to one that can be written"
            ) from error
