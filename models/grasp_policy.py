"""GraspPolicyNetwork: RGB-D image and robot state in, a distribution of actions out.

The network knows nothing about environments: `policy_for` fits one to a Gymnasium environment's
spaces, `make_ppo` makes one with its training (`models.ppo.GraspPPO`), and `load_policy` rebuilds
one from a checkpoint.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from models.ppo import KIND, GraspPPO
from models.ppo_observations import (
    ALL,
    ObservationLayout,
    ObservationNormaliser,
    Observations,
)
from utils.checkpoint import (
    build_model,
    load_checkpoint,
    load_weights,
    reading,
    save_checkpoint,
)
from utils.config_schema import Config, RLConfig
from utils.distributed import ALONE, Team
from utils.errors import UserError, unknown_choice

__all__ = [
    "ActionDistribution",
    "GraspPPO",
    "GraspPolicyNetwork",
    "SavedPolicy",
    "load_policy",
    "make_ppo",
    "policy_for",
    "save_policy",
]

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}
_SHIPPED = ("layout", "history", "rewards")  # of a checkpoint's other entries
BOUNDS = ("action_low", "action_high")  # of an action space, perhaps infinite
# What no shape of a weight tells of the function that weights stand for: of the network's
# arguments, and the keys of section rl that set them.
UNSHAPED = {
    "activation": "activation", "squash": "squash", "normalise": "normalise_observations",
}  # fmt: skip
# Keys of section env that say what an action means; then how far it goes, by control and gripper.
MEANING = ("control", "frame", "gripper", "substeps")
STEPS = {
    "joint": ("joint_step",), "ee": ("position_step", "rotation_step"),
    "ee_planar": ("position_step", "rotation_step"), "change": ("gripper_step",),
}  # fmt: skip
LOWEST_LOG_STD, HIGHEST_LOG_STD = -5.0, 2.0  # beyond them exploration has died or drowned the mean
POOLED = 7  # rows and columns that the last convolution is pooled to
RELIEF_SCALE, RELIEF_LIMIT = 0.03, 5.0  # m to which a relief is scaled, and how far that goes
PIXEL_STEP = 4  # every so many rows and columns a pixel enters the statistics
ESTIMATE_BETA = 0.1  # of the normalised error, from which on the estimates' loss is linear
LOG_2PI = math.log(2 * math.pi)


class ActionDistribution(NamedTuple):
    """A diagonal Gaussian over latent actions; where squashed, the action is the latent's tanh.

    PPO samples, stores and evaluates latents, not actions: an action at the edge of tanh, or
    clipped to the bounds of the action space, no longer determines its latent.

    mean: (B, A). log_std: (A,).
    """

    mean: torch.Tensor
    log_std: torch.Tensor
    squashed: bool

    def sample(self, noise: torch.Tensor) -> torch.Tensor:
        """Latents (B, A) from standard normal noise (B, A)."""
        return self.mean + self.log_std.exp() * noise

    def log_prob(self, latent: torch.Tensor) -> torch.Tensor:
        """(B,) log density of the action that a latent (B, A) stands for; of actions in [-1, 1]
        where squashed, by the change of variables (Haarnoja et al., "Soft actor-critic", ICML 2018,
        appendix C)."""
        z = (latent - self.mean) * (-self.log_std).exp()
        constant = self.log_std.sum() + 0.5 * LOG_2PI * len(self.log_std)
        log_density = -0.5 * z.square().sum(-1) - constant
        return log_density - log_tanh_slope(latent).sum(-1) if self.squashed else log_density

    def entropy(self, noise: torch.Tensor | None = None) -> torch.Tensor:
        """Differential entropy in nats: one number, as it does not depend on the mean. Squashed it
        does, and has no closed form: (B,) estimates without bias, each from one sample that is made
        of standard normal noise (B, A)."""
        gaussian = (0.5 + 0.5 * LOG_2PI + self.log_std).sum()
        return gaussian + log_tanh_slope(self.sample(noise)).sum(-1) if self.squashed else gaussian


def log_tanh_slope(x: torch.Tensor) -> torch.Tensor:
    """log(1 - tanh(x)^2), which does not overflow: 1 - tanh^2 = 4 / (e^x + e^-x)^2."""
    return 2 * (math.log(2) - x - F.softplus(-2 * x))


class GraspPolicyNetwork(nn.Module):
    """Policy and critic: a shared image encoder, and fully connected layers of their own.

    image_feature_dim: size of the vector that an image is encoded to. state_dim, action_dim: sizes
    of the state and action vectors. hidden_dim, hidden_layers: units and number of the policy's and
    of the critic's layers. image_channels: 4 for RGB-D, 0 for a policy without an image.
    privileged_dim: size of the vector that only the critic sees (asymmetric actor-critic, Pinto et
    al., RSS 2018). conv_channels: of the encoder's 3x3 convolutions with stride 2. squash: see
    ActionDistribution. normalise: by running statistics, see `observe`. relief: the encoder gets
    one more channel, how far each pixel stands out of the image's median depth (mostly the
    table's), because a centimetre is little in a depth of half a metre; the last image channel must
    be the depth.

    estimated_dim: so many of the privileged numbers, the first ones, are estimated from image and
    state by the state estimator: the encoder and layers of its own. Policy and critic then see the
    estimates in the image's place, and their loss does not train the estimator; `estimate_loss`
    does, as long as a simulator provides the true numbers. The policy never sees those.

    Weights start orthogonal, with gain sqrt 2, or 0.01 for the mean and 1 for the value, so that a
    new policy acts around 0 (Huang et al., "The 37 implementation details of PPO", 2022).
    The deviation does not depend on the observation.
    """

    def __init__(
        self,
        image_feature_dim: int = 512,
        state_dim: int = 15,
        action_dim: int = 7,
        hidden_dim: int = 256,
        image_channels: int = 4,
        privileged_dim: int = 0,
        conv_channels: Sequence[int] = (32, 64, 128),
        hidden_layers: int = 2,
        activation: str = "relu",
        squash: bool = False,
        normalise: bool = True,
        initial_log_std: float = 0.0,
        estimated_dim: int = 0,
        relief: bool = False,
    ):
        super().__init__()
        self.model_args = {
            "image_feature_dim": image_feature_dim, "state_dim": state_dim,
            "action_dim": action_dim, "hidden_dim": hidden_dim, "image_channels": image_channels,
            "privileged_dim": privileged_dim, "conv_channels": list(conv_channels),
            "hidden_layers": hidden_layers, "activation": activation, "squash": squash,
            "normalise": normalise, "initial_log_std": initial_log_std,
            "estimated_dim": estimated_dim, "relief": relief,
        }  # fmt: skip
        self.squash, self.normalise, self.estimated_dim = squash, normalise, estimated_dim
        self.relief = relief
        self.image_norm = ObservationNormaliser(image_channels)
        self.state_norm = ObservationNormaliser(state_dim)
        self.privileged_norm = ObservationNormaliser(privileged_dim)
        self.encoder = None
        if image_channels:
            self.encoder = encoder(image_channels + relief, conv_channels, image_feature_dim)
        seen = state_dim + (image_feature_dim if image_channels else 0)
        widths, kind = [hidden_dim] * hidden_layers, ACTIVATIONS[activation]
        self.estimator = None
        if estimated_dim:
            last = initialised(nn.Linear(hidden_dim, estimated_dim), 1.0)
            self.estimator = nn.Sequential(*layers([seen, hidden_dim], nn.ReLU), last)
            seen = state_dim + estimated_dim
        self.actor = layers([seen, *widths], kind)
        self.mean_head = initialised(nn.Linear(hidden_dim, action_dim), 0.01)
        self.log_std = nn.Parameter(torch.full((action_dim,), initial_log_std))
        self.critic = layers([seen + privileged_dim, *widths], kind)
        self.value_head = initialised(nn.Linear(hidden_dim, 1), 1.0)
        for name, bound in zip(BOUNDS, (-1.0, 1.0)):
            self.register_buffer(name, torch.full((action_dim,), bound))

    def forward(self, image: torch.Tensor | None, state: torch.Tensor) -> ActionDistribution:
        """The policy. image: (B, C, H, W), colours in 0..1 and depth in metres, or None without
        image channels. state: (B, S). Both as observed: the network normalises them."""
        channels = self.model_args["image_channels"]
        if image is not None and image.shape[1] != channels:
            raise ValueError(f"image: got {image.shape[1]} channels, the network has {channels}")
        return self._distribution(self.features(image, state))

    def value(
        self, image: torch.Tensor | None, state: torch.Tensor, privileged: torch.Tensor
    ) -> torch.Tensor:
        """(B,) the critic's estimate of the return. privileged: (B, P), P may be 0."""
        return self._value(self.features(image, state), privileged)

    def policy_and_value_of(
        self, features: torch.Tensor, privileged: torch.Tensor
    ) -> tuple[ActionDistribution, torch.Tensor]:
        """Policy and value for features (B, F) of `features`."""
        return self._distribution(features), self._value(features, privileged)

    def features(self, image: torch.Tensor | None, state: torch.Tensor) -> torch.Tensor:
        """(B, F) the input of policy and critic: the encoded image, or in its place the estimates
        (without a gradient), and the normalised state."""
        if self.estimator is None:
            return self._encoded(image, state)
        with torch.no_grad():
            return torch.cat([self.estimate(image, state), self._normalised_state(state)], -1)

    def estimate(self, image: torch.Tensor | None, state: torch.Tensor) -> torch.Tensor:
        """(B, E) estimates of the first privileged numbers, scaled as `truth` scales them."""
        return self.estimator(self._encoded(image, state))

    def estimate_loss(
        self, image: torch.Tensor | None, state: torch.Tensor, privileged: torch.Tensor
    ) -> torch.Tensor:
        """Scalar: the Huber loss of the estimates against the privileged numbers (B, P)."""
        truth = self.truth(privileged)
        return F.smooth_l1_loss(self.estimate(image, state), truth, beta=ESTIMATE_BETA)

    def truth(self, privileged: torch.Tensor) -> torch.Tensor:
        """(B, E) the target of `estimate` for privileged numbers (B, P)."""
        scaled = self.privileged_norm(privileged) if self.normalise else privileged
        return scaled[:, : self.estimated_dim]

    def estimator_parameters(self) -> list[nn.Parameter]:
        """The weights of the state estimator; none where nothing is estimated."""
        parts = [self.encoder, self.estimator] if self.estimator is not None else []
        return [p for part in parts if part is not None for p in part.parameters()]

    def action(self, latent: torch.Tensor) -> torch.Tensor:
        """(B, A) actions of latents: squashed and stretched to the bounds of the action space, or
        clipped to them."""
        if self.squash:
            half = (self.action_high - self.action_low) / 2
            latent = self.action_low + half * (latent.tanh() + 1)  # rounding may leave the bounds
        return torch.minimum(torch.maximum(latent, self.action_low), self.action_high)

    @torch.no_grad()
    def limit_exploration(self) -> None:
        """Bring the Gaussian's deviation back within its limits, after a step of the optimiser; a
        limit in the forward pass would have no gradient that leads back."""
        self.log_std.clamp_(LOWEST_LOG_STD, HIGHEST_LOG_STD)

    def observe(self, observations: Observations, team: Team) -> None:
        """Add a rollout's observations to the statistics that normalise them."""
        if not self.normalise:
            return
        if self.encoder is not None:
            some = [i[:, ::PIXEL_STEP, ::PIXEL_STEP] for i in observations.images]
            pixels = observations._replace(images=tuple(some)).image().movedim(1, -1)
            self.image_norm.update(pixels.flatten(0, -2), team)
        if observations.state.shape[-1]:
            self.state_norm.update(observations.state, team)
        if observations.privileged.shape[-1]:
            self.privileged_norm.update(observations.privileged, team)

    def _normalised_state(self, state: torch.Tensor) -> torch.Tensor:
        return self.state_norm(state) if self.normalise else state

    def _encoded(self, image: torch.Tensor | None, state: torch.Tensor) -> torch.Tensor:
        state = self._normalised_state(state)
        if self.encoder is None:
            return state
        parts = [self.image_norm(image.movedim(1, -1)).movedim(-1, 1) if self.normalise else image]
        if self.relief:
            parts.append(relief_of(image[:, -1:]))
        return torch.cat([self.encoder(torch.cat(parts, 1)), state], -1)

    def _distribution(self, features: torch.Tensor) -> ActionDistribution:
        mean = self.mean_head(self.actor(features))
        return ActionDistribution(mean, self.log_std, self.squash)

    def _value(self, features: torch.Tensor, privileged: torch.Tensor) -> torch.Tensor:
        if privileged.shape[-1]:
            if self.normalise:
                privileged = self.privileged_norm(privileged)
            features = torch.cat([features, privileged], -1)
        return self.value_head(self.critic(features)).squeeze(-1)


def relief_of(depth: torch.Tensor) -> torch.Tensor:
    """(B, 1, H, W) how much nearer each pixel is than the image's median depth, scaled and limited;
    depth: (B, 1, H, W) in metres."""
    some = depth[:, :, ::PIXEL_STEP, ::PIXEL_STEP].flatten(1)
    rise = some.median(1).values[:, None, None, None] - depth
    return (rise / RELIEF_SCALE).clamp(-RELIEF_LIMIT, RELIEF_LIMIT)


def encoder(channels: int, conv_channels: Sequence[int], features: int) -> nn.Sequential:
    """(B, channels, H, W) to (B, features), for images of any size that the convolutions leave
    something of (`convolved`)."""
    parts: list[nn.Module] = []
    for before, after in zip([channels, *conv_channels], conv_channels):
        parts += [initialised(nn.Conv2d(before, after, 3, stride=2), math.sqrt(2)), nn.ReLU()]
    parts += [nn.AdaptiveAvgPool2d(POOLED), nn.Flatten()]
    return nn.Sequential(*parts, *layers([conv_channels[-1] * POOLED**2, features], nn.ReLU))


def convolved(side: int, conv_channels: Sequence[int]) -> int:
    """What the encoder's convolutions leave of an image's side, in pixels."""
    for _ in conv_channels:
        side = (side - 3) // 2 + 1
    return side


def layers(widths: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    """Fully connected layers, each with its activation."""
    parts: list[nn.Module] = []
    for before, after in zip(widths, widths[1:]):
        parts += [initialised(nn.Linear(before, after), math.sqrt(2)), activation()]
    return nn.Sequential(*parts)


def initialised(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Linear | nn.Conv2d:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


# --- Fitted to an environment, and from a file --------------------------------------------------


def policy_for(
    layout: ObservationLayout, action_space: spaces.Space, settings: RLConfig
) -> GraspPolicyNetwork:
    """A new network for an environment's observations and actions.

    Raises UserError for actions that are not a vector of real numbers, or without bounds where
    they would have to be squashed, for images of which the convolutions leave nothing, and for a
    relief of what is not depth.
    """
    if (
        not isinstance(action_space, spaces.Box)
        or not np.issubdtype(action_space.dtype, np.floating)
        or len(action_space.shape) != 1
    ):
        raise UserError(
            f"rl.env_id {settings.env_id}: its actions are {action_space}; this PPO has a Gaussian "
            "policy, choose an environment whose action space is a Box of floats with one dimension"
        )
    for part in layout.images:
        if min(convolved(side, settings.conv_channels) for side in part.shape[:2]) < 1:
            raise UserError(
                f"rl.env_id {settings.env_id}: {len(settings.conv_channels)} convolutions leave "
                f"nothing of {part.key!r}, {part.shape[1]}x{part.shape[0]} pixels; shorten "
                "rl.conv_channels or use larger images"
            )
    last = layout.images[-1] if layout.images else None
    if settings.relief and (last is None or (last.shape[2], last.dtype) != (1, "float32")):
        raise UserError(
            f"rl.relief: it needs a depth image in metres, one channel of float32, as the last "
            f"image of the policy, which sees {_listed(layout)}; name one last in "
            "rl.policy_observations, or set rl.relief=false"
        )
    if settings.squash and not action_space.is_bounded():
        raise UserError(
            f"rl.squash: the actions of {settings.env_id} have no bounds to be squashed between; "
            "use rl.squash=false"
        )
    low, high = bounds_within(action_space)
    estimated = layout.privileged[: len(settings.estimated_observations or ())]
    network = GraspPolicyNetwork(
        settings.image_feature_dim,
        layout.state_dim,
        len(low),
        settings.hidden_dim,
        layout.image_channels,
        layout.privileged_dim,
        settings.conv_channels,
        settings.hidden_layers,
        settings.activation,
        settings.squash,
        settings.normalise_observations,
        settings.initial_log_std,
        sum(int(np.prod(part.shape)) for part in estimated),
        settings.relief,
    )
    network.action_low.copy_(low)
    network.action_high.copy_(high)
    return network


def bounds_within(space: spaces.Box) -> tuple[torch.Tensor, torch.Tensor]:
    """(A,) each, float32: the bounds of a space, of any precision, rounded into the space."""
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    low = np.where(low < space.low, np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high > space.high, np.nextafter(high, np.float32(-np.inf)), high)
    return torch.from_numpy(low), torch.from_numpy(high)


def make_ppo(
    observation_space: spaces.Space, action_space: spaces.Space, config: Config, team: Team = ALONE
) -> GraspPPO:
    """A policy in training for the spaces of an environment, with the config's section `rl`: new,
    or with the weights of rl.initial. config.seed determines new weights. Raises UserError."""
    settings = config.rl
    privileged = (
        *(settings.estimated_observations or ()),  # first: the network estimates the first ones
        *(settings.privileged_observations or ()),
    )
    several = isinstance(observation_space, spaces.Dict)
    known = observation_space.spaces if several else {ALL: observation_space}
    for key in settings.estimated_observations or ():
        if key not in known:
            raise unknown_choice("rl.estimated_observations", key, known)
    layout = ObservationLayout.of(observation_space, settings.policy_observations, privileged)
    torch.manual_seed(config.seed)
    network = policy_for(layout, action_space, settings)
    if settings.initial is None:
        return GraspPPO(network, layout, settings, team, config.seed)
    extra = load_initial(network, layout, settings.initial, config)
    ppo = GraspPPO(network, layout, settings, team, config.seed)
    if "rewards" in extra:
        with reading(settings.initial):
            ppo.rewards.continue_from(extra["rewards"], settings.envs * settings.rollout_steps)
    return ppo


def load_initial(
    network: GraspPolicyNetwork, layout: ObservationLayout, path: Path | str, config: Config
) -> dict[str, Any]:
    """Load a checkpoint's weights, the deviation of its actions among them, into a network of this
    config that sees by `layout`, which keeps the bounds of its own actions. Returns the
    checkpoint's other entries. Raises UserError where the checkpoint's policy sees something else
    or computes otherwise, and for weights that are not finite. Warns where its actions meant
    something else."""
    checkpoint = load_checkpoint(path, KIND)
    with reading(path):
        seen = ObservationLayout.from_plain(checkpoint["extra"]["layout"])
        for name, key in UNSHAPED.items():
            both = checkpoint["model_args"], network.model_args
            before, now = (str(args[name]).lower() for args in both)  # as a config has it
            if before != now:
                raise UserError(
                    f"rl.initial {path}: its policy was trained with rl.{key}={before}, and this "
                    f"one has {now}; set rl.{key}={before}, or rl.initial=null"
                )
        trained, env = checkpoint["config"].get("env", {}), config.env.model_dump()
        steps = STEPS.get(env["control"], ()) + STEPS.get(env["gripper"], ())
        others = [key for key in (*MEANING, *steps) if trained.get(key, env[key]) != env[key]]
    if seen.entries() != layout.entries():
        raise UserError(
            f"rl.initial {path}: its policy sees {_listed(seen)}, this one {_listed(layout)}; set "
            "rl.policy_observations and its like as in its training, or rl.initial=null"
        )
    own = {name: getattr(network, name).clone() for name in BOUNDS}
    weights = checkpoint["model"] | own
    if not all(bool(weights[name].isfinite().all()) for name in weights.keys() - own.keys()):
        raise UserError(f"{path}: holds weights that are not finite; its training has diverged")
    load_weights(network, checkpoint | {"model": weights}, path)
    if others:
        warnings.warn(
            f"rl.initial {path}: its policy was trained with "
            f"{', '.join(f'env.{key}={trained[key]}' for key in others)}, and not with "
            f"{', '.join(str(env[key]) for key in others)}, so that its actions mean something "
            "else here",
            stacklevel=2,
        )
    return checkpoint["extra"]


def _listed(layout: ObservationLayout) -> str:
    return ", ".join(f"{part.key} {part.shape}" for part in layout.parts())


class SavedPolicy(NamedTuple):
    """A policy from a checkpoint, which is called like a function.

    network: in evaluation mode. layout: the observations that it sees. extra: the checkpoint's
    other plain entries. config: the training's config, as plain data.
    """

    network: GraspPolicyNetwork
    layout: ObservationLayout
    extra: dict
    config: dict

    @property
    def observations(self) -> list[str]:
        """The keys of what it sees."""
        return [part.key for part in (*self.layout.images, *self.layout.state)]

    def __call__(self, observation: dict[str, np.ndarray] | np.ndarray) -> np.ndarray:
        """(A,) the deterministic action for one observation of one environment."""
        seen = self.layout.read_one(observation)
        with torch.inference_mode():
            latent = self.network(seen.image(), seen.state).mean
            return self.network.action(latent)[0].numpy()


def load_policy(path: Path | str) -> SavedPolicy:
    """The policy of a checkpoint that `GraspPPO.save` wrote, on the CPU. Raises UserError."""
    checkpoint = load_checkpoint(path, KIND)
    network = build_model(GraspPolicyNetwork, checkpoint, path, BOUNDS)
    extra = checkpoint["extra"]
    with reading(path):
        layout = ObservationLayout.from_plain(extra["layout"])
        for name in ("image_channels", "state_dim", "privileged_dim"):
            if getattr(layout, name) != network.model_args[name]:
                raise ValueError(f"{name} of its observations is not the network's")
        return SavedPolicy(network, layout, extra, checkpoint["config"])


def save_policy(path: Path | str, policy: SavedPolicy) -> None:
    """Write what `load_policy` and `rl.initial` read, in half precision and without what only a
    resumed training needs."""
    save_checkpoint(
        path,
        kind=KIND,
        model_args=policy.network.model_args,
        model=policy.network,
        config=policy.config,
        extra={key: policy.extra[key] for key in _SHIPPED if key in policy.extra},
        half_precision=True,
    )
