"""Configuration of a training run: frozen dataclasses in groups. Field names are unique across groups and are the options of
the command line. A field's annotation gives its bounds and scope, the docstring below it its help text.

Imports no JAX, so that the command line can print its help without delay.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, TypeVar

from jaxrl_vis.config import fields
from jaxrl_vis.config.fields import Bounds
from jaxrl_vis.config.marks import (
    DIVIDED,
    FALSE_REWARD,
    HOST,
    NEEDS_STATES,
    OL_AUX,
    RESUMABLE,
    UNMEASURED,
    Mark,
    OfAlgorithm,
    OfMethod,
    OfWeighting,
)
from jaxrl_vis.config.methods import (
    EPS_WEIGHTINGS,
    HEAD_WEIGHTINGS,
    LIMITED_WEIGHTINGS,
    LOG_WEIGHTINGS,
    AlgorithmName,
    AuxTaskName,
    MethodName,
    WeightingName,
)
from jaxrl_vis.errors import RequestError, nearest

# Allowed values of fields, for validation, the command line and its help.
Pixels = Literal["rgbd", "rgb", "depth"]
Randomized = Literal["camera", "lights", "colours", "dynamics"]
BestBy = Literal["success", "goal_distance", "goal_distance_median"]
ComputeDtype = Literal["auto", "float32", "bfloat16"]

MAX_COUNT = 2**31 - 1  # arrays are indexed by int32; environment steps are counted on the host, without bound
Count = Annotated[int, Bounds(1, MAX_COUNT)]
Fraction = Annotated[float, Bounds(0.0, 1.0)]
Positive = Annotated[float, Bounds(0.0, exclusive=True)]
T = TypeVar("T")
NotNegative = Annotated[float, Bounds(0.0)]


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Seeds, devices and schedule. Counts of environments, steps, transitions and episodes are per seed."""

    preset: Annotated[str, RESUMABLE, UNMEASURED] = "fast"
    """Preset that this configuration was derived from; for the record only."""
    algorithm: AlgorithmName = "ddpg"
    """Learning algorithm; module:Name for your own."""
    seed: Annotated[int, Bounds(0, None)] = 0
    """First seed."""
    seeds: Count = 1
    """Number of seeds trained in parallel in one program: seed, seed + 1, ..."""
    devices: Annotated[Count, RESUMABLE] = 1
    """Number of devices. Multiple seeds are distributed over them; a single seed has its batches and environments
    distributed."""
    data_devices: Annotated[Count | None, RESUMABLE] = None
    """Number of devices that share one learner: its environments, replay and batches. None: 1 with several seeds, all devices
    with a single seed."""
    num_envs: Annotated[Count, DIVIDED] = 100
    """Number of environments in a rollout; each runs one episode per iteration."""
    env_steps: Annotated[int, Bounds(1, None), HOST, RESUMABLE, UNMEASURED] = 200_000
    """Number of environment steps to train for, rounded up to whole iterations of num_envs * horizon."""
    updates_per_iteration: Count = 200
    """Number of gradient steps after each rollout."""
    batch_size: Annotated[Count, DIVIDED] = 512
    """Transitions in a gradient step."""
    replay_transitions: Count = 200_000
    """Replay capacity in transitions; rounded up to whole rollouts."""
    eval_interval: Annotated[Count, HOST, RESUMABLE] = 2
    """Iterations between evaluations; a last one runs at the end of training."""
    eval_episodes: Annotated[Count, RESUMABLE, DIVIDED] = 1000
    """Number of episodes in an evaluation; they are the same every time."""
    checkpoint_interval: Annotated[Count, HOST, RESUMABLE, UNMEASURED] = 5
    """Iterations between light checkpoints (networks and optimisers; enough for eval and play)."""
    full_checkpoint_interval: Annotated[int, Bounds(0, MAX_COUNT), HOST, RESUMABLE, UNMEASURED] = 0
    """Iterations between full checkpoints (with the replay, for an exact resume). 0: only when a run is interrupted."""
    best_by: Annotated[BestBy | None, HOST, RESUMABLE, UNMEASURED] = None
    """Evaluation metric (mean over seeds) by which the best learner is kept as an additional checkpoint, for
    `--checkpoint best`. None: no such checkpoint."""
    stop_at: Annotated[NotNegative | None, HOST, RESUMABLE, UNMEASURED] = None
    """Threshold for early stopping: training ends after the first evaluation where the metric of best_by (success if that is
    None) is at least this or, for a distance, at most this."""


@dataclasses.dataclass(frozen=True)
class EnvironmentOptions:
    """Task, its observations, and properties that vary between episodes."""

    env: str = "VisualFetchReach"
    """Environment: a name that `jaxrl-vis envs` lists, or module:Name for your own."""
    env_folder: Annotated[str | None, RESUMABLE, UNMEASURED] = None
    """Folder from which module:Name is imported; stored with the run. None: the current folder, or Python's module search
    path."""
    env_options: tuple[str, ...] = ()
    """Further options of the environment, as name=value; docs/tasks.md lists those that restore a release's behaviour."""
    pixels: Pixels = "rgbd"
    """Channels of the image; unused by state tasks."""
    image_size: Count = 64
    """Height and width of the image, in pixels; unused by state tasks."""
    frame_stack: Count | None = None
    """Number of most recent images stacked in an observation. None: the environment's default."""
    randomize: tuple[Randomized, ...] = ()
    """Properties randomised between episodes, in training and in evaluation."""
    randomize_strength: Positive = 1.0
    """Strength of the randomisation, in multiples of the typical ranges (`jaxrl_vis_envs.randomization.KINDS`)."""
    observation_noise: NotNegative = 0.0
    """Standard deviation of the camera noise, in the observation's unit (grey levels for images); sampled independently for
    every frame."""


@dataclasses.dataclass(frozen=True)
class GoalOptions:
    """Goal relabelling, balancing and filtering (thesis, section 5.1.4)."""

    relabel_probability: Fraction = 0.9
    """p1: fraction of samples whose goal is replaced by an observation from the same episode."""
    balance_probability: Fraction | None = None
    """p2: fraction of relabelled samples whose goal is the next observation, a certain positive. None: 0.5 for balancing
    methods, else 0."""
    filter_threshold: float | None = None
    """q0: negatives with Q above this are dropped as false. None: the middle of the valid range, for filtering methods."""
    future_goals: Literal["even", "geometric"] = "even"
    """Distribution of relabelled goals over the rest of the episode: uniform (even), or proportional to gamma^k after k further
    steps (geometric)."""
    trivial_goals: Fraction = 1.0
    """Fraction of the relabelled goals already reached before the action, as the oracle or an indicator judges, that is kept;
    the rest are replaced by observations from other episodes."""


@dataclasses.dataclass(frozen=True)
class RewardOptions:
    """Source and values of rewards."""

    method: MethodName = "oracle"
    """Source of the rewards (docs/indicator_rewards.md): the true state (oracle), an autoencoder or a success classifier
    trained alongside, a frozen encoder (features), or equality of observations (indicator); module:Name for your own."""
    reward_positive: float | None = None
    """R+. None: that of the method, 0 for the oracle and 1 for other built-in ones."""
    reward_negative: float | None = None
    """R-. None: that of the method, 0 for autoencoder, classifier and features and -1 for other built-in ones."""
    tolerance: Annotated[NotNegative, OfMethod("indicator_tolerance")] = 8.0
    """Maximum difference of elements that count as equal, in the observation's unit (grey levels for images), for method
    indicator_tolerance."""
    tolerance_share: Annotated[Fraction, OfMethod("indicator_tolerance")] = 0.99
    """Fraction of the elements that must be equal, for method indicator_tolerance."""
    reward_encoder: Annotated[str | None, OfMethod("features")] = None
    """File with the frozen encoder, from `jaxrl-vis encoder`, for method features."""


@dataclasses.dataclass(frozen=True)
class DDPGOptions:
    """Losses, targets and exploration. Contrastive RL has no targets, and does not read their options."""

    discount: float | None = None
    """gamma. None: 1 - 1/horizon."""
    actor_learning_rate: Positive = 1e-3
    """Adam step size of the actor."""
    critic_learning_rate: Positive = 1e-3
    """Adam step size of the critic, and of a reward model trained alongside."""
    target_decay: Fraction = 0.99
    """Decay rate of the target networks (ddpg, td3): weight of the old target parameters in each target update."""
    target_update_interval: Count = 1
    """Gradient steps between target updates (ddpg, td3)."""
    actor_interval: Count = 1
    """Critic gradient steps per actor gradient step (ddpg, td3); divides updates_per_iteration."""
    action_penalty: NotNegative = 1.0
    """Weight of the mean squared action in the actor's loss."""
    actor_log: Annotated[Literal["value", "loss"], OfWeighting()] = "value"
    """Quantity whose logarithm the actor minimises, with log weightings. value: log(Q_max - Q) plus the action penalty, as in
    the authors' release, so the penalty's relative weight grows with Q_max - Q. loss: log(Q_max - Q + penalty), which keeps
    their ratio. With critic_states always loss."""
    critic_states: Annotated[bool, OfAlgorithm(("ddpg", "td3"))] = False
    """The critic observes the true state and goal state instead of the images, which makes it easier and faster to train; the
    policy sees images only. Its own encoder is then that of the auxiliary losses (asymmetric actor-critic, Pinto et al.,
    2018)."""
    clip_targets_above: bool = True
    """Clip critic targets (ddpg, td3) at R+/(1-gamma) too; they are always clipped at R-/(1-gamma) below."""
    random_action_probability: Fraction = 0.3
    """Exploration: fraction of actions sampled uniformly."""
    action_noise: NotNegative = 0.2
    """Exploration: standard deviation of the Gaussian noise added to the other actions."""


@dataclasses.dataclass(frozen=True)
class ContrastiveOptions:
    """Contrastive RL (docs/algorithms.md)."""

    contrastive_form: Annotated[Literal["nce", "stable"], OfAlgorithm(("contrastive",))] = "stable"
    """Form of the critic and its loss. nce: binary cross-entropy (Eysenbach et al., 2022). stable: symmetric InfoNCE with a
    penalty on log-sum-exp, layer normalisation, and outputs near 0 at initialisation."""
    representation_size: Annotated[Count, OfAlgorithm(("contrastive",))] = 64
    """Size of the representations whose inner product is the critic."""


@dataclasses.dataclass(frozen=True)
class AuxiliaryOptions:
    """Auxiliary losses and their weighting (thesis, section 5.2; docs/auxiliary_losses.md)."""

    aux_tasks: tuple[AuxTaskName, ...] = ()
    """Auxiliary tasks that the encoders are also trained on; module:Name for your own."""
    weighting: WeightingName = "none"
    """Weighting of the auxiliary losses; module:Name for your own."""
    weighting_interval: Annotated[Count, OL_AUX] = 5
    """N of OL-AUX: gradient steps between updates of the weights; divides updates_per_iteration."""
    weighting_beta: Annotated[NotNegative | None, OL_AUX] = None
    """beta of OL-AUX: step size of the weights, in multiples of critic_learning_rate. None: 5 N."""
    weighting_fixed: Annotated[float, OfWeighting(("fixed",))] = 1.0
    """Weight of every auxiliary loss, for weighting fixed."""


@dataclasses.dataclass(frozen=True)
class NetworkOptions:
    """Sizes, encoders and precision of the networks, and normalisation of their inputs."""

    encoder_filters: tuple[Count, ...] = (16, 32, 64, 64)
    """Output channels of the 2x2 stride-2 convolutions."""
    latent_size: Count = 512
    """Size of an encoded image."""
    hidden_sizes: tuple[Count, ...] = (256, 256, 256)
    """Hidden layers of the actor's and the critic's heads."""
    encoders: Literal["separate", "shared"] = "separate"
    """Encoder of the actor: its own (separate; always with critic_states), or the critic's, which the actor's loss does not
    update (shared)."""
    target_encoder: bool = True
    """Use slowly updated target encoders (ddpg, td3); if false, the target heads read the latents of the online encoders."""
    random_shift: Annotated[int, Bounds(0, MAX_COUNT)] = 0
    """Random shift augmentation: maximum shift in pixels per axis, the same for the three images of a transition (Kostrikov et
    al., 2020)."""
    compute_dtype: ComputeDtype = "auto"
    """Precision of the networks' arithmetic; parameters and losses are float32. auto: bfloat16 on accelerators."""
    normalizer_floor: Positive = 0.01
    """Minimum standard deviation by which observations are divided, in the observation's unit (grey levels for images)."""
    normalizer_clip: Positive = 5.0
    """Maximum magnitude to which normalised observations are clipped."""


@dataclasses.dataclass(frozen=True)
class StudyOptions:
    """Options used only in studies: behaviour of the authors' release, variants of replay and targets, and reward errors."""

    replay_mean_age: Count | None = None
    """Mean age of sampled transitions, in transitions: older ones are sampled less often, as if new episodes replaced random
    ones. None: uniform sampling."""
    n_step: Annotated[Count, NEEDS_STATES] = 1
    """Number of rewards summed in a target before it bootstraps. More than 1 needs method oracle, and excludes aux_tasks."""
    reward_noise: Annotated[NotNegative, NEEDS_STATES] = 0.0
    """Standard deviation of the noise on the state from which the oracle's reward is computed, in the unit of the state."""
    reward_false_positives: Annotated[Fraction, NEEDS_STATES, FALSE_REWARD] = 0.0
    """Fraction of the oracle's negatives that are turned into positives."""
    reward_false_negatives: Annotated[Fraction, NEEDS_STATES, FALSE_REWARD] = 0.0
    """Fraction of the oracle's positives that are turned into negatives."""
    reward_clutter: Fraction = 1.0
    """Fraction of the workspace, from the low end of the state's first coordinate, to which the false rewards are confined."""
    normalizers: Literal["shared", "separate"] = "shared"
    """Statistics for normalising goals: those of all observations (shared) or, as in the authors' release, separate ones."""
    normalizer_source: Literal["rollouts", "relabelled"] = "rollouts"
    """Source of the normalisation statistics: all observations of a rollout, or, as in the authors' release, relabelled
    transitions."""
    weighting_main_grad: Annotated[Literal["main", "total"], OL_AUX] = "main"
    """Gradient with which OL-AUX compares the auxiliary gradients: that of the main loss or, as in the authors' release, of the
    total loss."""
    weighting_window: Annotated[Count, OfWeighting(("ol_aux",))] = 1
    """Number of gradient steps over which OL-AUX averages gradients before comparing them; 4 in the authors' release."""
    weighting_log: Annotated[bool, OfWeighting(LOG_WEIGHTINGS)] = False
    """Minimise the logarithms of the losses, with a weighting that does not do so by default."""
    weighting_heads: Annotated[Literal["weighted", "always"] | None, OfWeighting(HEAD_WEIGHTINGS)] = None
    """Loss weights in the auxiliary tasks' heads: those of the encoder (weighted), or 1 (always). None: weighted with OL-AUX
    and GradNorm; always otherwise, as in the thesis for cosine."""
    weighting_eps: Annotated[Positive | None, OfWeighting(EPS_WEIGHTINGS)] = None
    """Constant added to auxiliary losses before taking their logarithm. None: 0.02, or 1e-8 with db_mtl."""
    weighting_task_eps: Annotated[tuple[Positive, ...], OfWeighting(EPS_WEIGHTINGS)] = ()
    """Constants for the individual auxiliary losses, in the order of aux_tasks, instead of weighting_eps."""
    weighting_maximum: Annotated[Positive | None, OfWeighting(LIMITED_WEIGHTINGS)] = None
    """Maximum weight of a loss, except of a main loss whose weight is always 1. None: unbounded."""
    weighting_total: Annotated[Positive | None, OfWeighting(LIMITED_WEIGHTINGS)] = None
    """Sum to which the weights are scaled, excluding a main loss whose weight is always 1. None: not scaled."""
    weighting_cosines: Annotated[bool, OfWeighting()] = False
    """Log the cosines between the losses' gradients in the critic's encoder (the actor's with critic_states); this computes
    the dot products of all pairs."""
    aux_form: Annotated[Literal["thesis", "release"], OfWeighting()] = "thesis"
    """Form of the auxiliary tasks' targets, where the thesis and the authors' release differ (`auxtasks.Options`)."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Configuration of one training run. The defaults are the general values of the preset ``fast`` (`presets.preset`)."""

    run: RunOptions = RunOptions()
    environment: EnvironmentOptions = EnvironmentOptions()
    goals: GoalOptions = GoalOptions()
    reward: RewardOptions = RewardOptions()
    ddpg: DDPGOptions = DDPGOptions()
    contrastive: ContrastiveOptions = ContrastiveOptions()
    auxiliary: AuxiliaryOptions = AuxiliaryOptions()
    network: NetworkOptions = NetworkOptions()
    study: StudyOptions = StudyOptions()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some options changed.

        Args:
            **changes: New values by field name, regardless of the group.

        Raises:
            RequestError: A name is not a field of any group.
        """
        by_group: dict[str, dict[str, Any]] = {}
        for name, value in check_names(changes).items():
            by_group.setdefault(OPTIONS[name].group, {})[name] = value
        groups = {group: dataclasses.replace(getattr(self, group), **values) for group, values in by_group.items()}
        return dataclasses.replace(self, **groups)

    def flat(self) -> dict[str, Any]:
        """Return the values of all groups, by field name."""
        return {name: self.value(name) for name in OPTIONS}

    def value(self, name: str) -> Any:
        """Return the value of the field ``name``, regardless of its group."""
        return getattr(getattr(self, OPTIONS[name].group), name)


OPTIONS: Mapping[str, fields.Field] = {field.name: field for field in fields.describe(Config)}
"""Fields of all groups, by name."""


def marked(mark: Mark) -> tuple[str, ...]:
    """Return the names of the fields annotated with ``mark``."""
    return tuple(name for name, field in OPTIONS.items() if mark in field.extras)


def weighting_options() -> dict[str, tuple[str, ...]]:
    """Map each field that is read only if losses are weighted to its weightings; an empty tuple stands for any weighting."""
    marks = {name: extra for name, field in OPTIONS.items() for extra in field.extras if isinstance(extra, OfWeighting)}
    return {name: mark.names for name, mark in marks.items()}


def options_read_by(owner: type[T]) -> dict[str, T]:
    """Map each field annotated with an instance of ``owner``, `OfAlgorithm` or `OfMethod`, to that instance."""
    return {name: extra for name, field in OPTIONS.items() for extra in field.extras if isinstance(extra, owner)}


def check_names(changes: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return ``changes`` unmodified if every key is the name of a field.

    Raises:
        RequestError: A key is not.
    """
    for name in changes:
        if name not in OPTIONS:
            raise RequestError(f"unknown option {str(name)[:60]!r}{nearest(str(name), OPTIONS, 'see jaxrl-vis train --help')}")
    return changes


def changes(**values: Any) -> dict[str, Any]:
    """Return values for `Config.replace` as a dictionary, checking their names immediately.

    Raises:
        RequestError: A name is not a field of any group.
    """
    return dict(check_names(values))


def data_devices(config: Config) -> int:
    """Return the number of devices that share one learner, with the default of ``data_devices`` filled in."""
    if config.run.data_devices is not None:
        return config.run.data_devices
    return config.run.devices if config.run.seeds == 1 else 1


def config_from_dict(values: Any) -> Config:
    """Read a saved configuration: `dataclasses.asdict` after a round trip through JSON, which turns tuples into lists.

    Missing groups and fields take their defaults.

    Raises:
        RequestError: ``values`` is not a dictionary of groups, or a field is unknown or of the wrong type. The message names
            it.
    """
    if not isinstance(values, Mapping):
        raise RequestError(f"a configuration must be a dictionary of groups, not {type(values).__name__}")
    groups = [field.name for field in dataclasses.fields(Config)]
    options: dict[str, Any] = {}
    for group, saved in values.items():
        if group not in groups:
            raise RequestError(f"unknown group of options {str(group)[:60]!r}{nearest(str(group), groups)}")
        if not isinstance(saved, Mapping):
            raise RequestError(f"{group} must be a dictionary of options, not {type(saved).__name__}")
        for name, value in saved.items():
            if name not in OPTIONS or OPTIONS[name].group != group:
                known = [option for option, field in OPTIONS.items() if field.group == group]
                raise RequestError(f"unknown option {str(name)[:60]!r} in {group}{nearest(str(name), known)}")
            options[name] = fields.check(name, OPTIONS[name].hint, value)
    return Config().replace(**options)
