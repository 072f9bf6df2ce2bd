"""Configuration of a training run: one frozen dataclass and four presets. `resolved` derives what depends on the environment.

Imports no JAX, so that the command line can print its help at once.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, Self

from jaxrl_vis import fields
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.methods import METHODS, AlgorithmName, AuxTaskName, MethodName, WeightingName

# Values that a field allows, for checks, the command line and its help.
Pixels = Literal["rgbd", "rgb", "depth"]
Randomized = Literal["camera", "lights", "colours", "dynamics"]
ComputeDtype = Literal["auto", "float32", "bfloat16"]


@dataclasses.dataclass(frozen=True)
class Config:
    """One training run. Counts are per seed; durations are in control steps unless a unit is given.

    The defaults are those of the preset ``fast``; `preset` also applies its task-specific values.
    """

    env: str = "VisualFetchReach"
    """Environment: a name that `jaxrl-vis envs` lists, or module:Name for your own."""
    env_folder: str | None = None
    """Folder from which module:Name is imported; stored with the run. None: the current folder, or Python's module search
    path."""
    preset: str = "fast"
    """Preset that this configuration was derived from; for the record only."""
    method: MethodName = "oracle"
    """Source of the rewards: the true state (oracle), similarity in the latent space of an autoencoder trained alongside, or
    equality of observations (indicator), without or with balancing and filtering; module:Name for your own."""
    algorithm: AlgorithmName = "ddpg"
    """Learning algorithm; module:Name for your own."""
    seed: int = 0
    """First seed."""
    seeds: int = 1
    """Number of seeds trained in parallel in one program: seed, seed + 1, ..."""

    # -- Devices (docs/scaling.md)
    devices: int = 1
    """Number of devices. Multiple seeds are spread over them; with a single seed, its batches and environments are."""
    data_devices: int | None = None
    """Number of devices that share one learner: its environments, replay and batches. None: 1 with several seeds, all devices
    with a single seed."""

    # -- The environment
    pixels: Pixels = "rgbd"
    """Channels of the image."""
    image_size: int = 64
    """Height and width of the image, in pixels."""
    frame_stack: int | None = None
    """Number of latest images stacked in an observation. None: the environment's own number."""
    env_options: tuple[str, ...] = ()
    """Further options of the environment, as name=value; docs/tasks.md lists those that restore a release's behaviour."""
    randomize: tuple[Randomized, ...] = ()
    """Properties randomised between episodes, in training and in evaluation."""
    randomize_strength: float = 1.0
    """Strength of the randomisation, in multiples of the typical ranges (`jaxrl_vis_envs.randomization.KINDS`)."""
    observation_noise: float = 0.0
    """Standard deviation of the camera noise, in the observation's unit (grey levels for images); drawn anew for every
    frame."""
    num_envs: int = 100
    """Environments in a rollout; each plays one episode per iteration."""

    # -- Training length and update schedule
    env_steps: int = 200_000
    """Environment steps to train for; rounded up to whole iterations of num_envs * horizon."""
    updates_per_iteration: int = 200
    """Gradient steps after each rollout."""
    batch_size: int = 512
    """Transitions in a gradient step."""
    replay_transitions: int = 200_000
    """Replay capacity in transitions; rounded up to whole rollouts."""
    replay_mean_age: int | None = None
    """Mean age of sampled transitions, in transitions: older ones become rarer, as if new episodes replaced random ones. None:
    uniform sampling."""

    # -- Goal relabelling and reward (thesis, section 5.1.4)
    relabel_probability: float = 0.9
    """p1: fraction of samples whose goal is replaced by an observation from the same episode."""
    balance_probability: float | None = None
    """p2: fraction of those whose goal is the next observation, a certain positive. None: 0.5 for balancing methods, else 0."""
    filter_threshold: float | None = None
    """q0: negatives with Q above it are dropped as false. None: the middle of its valid range, for filtering methods."""
    trivial_goals: float = 1.0
    """Fraction kept of relabelled goals that are already reached before the action; the rest are replaced by observations from
    other episodes."""
    reward_positive: float | None = None
    """R+. None: 0 for the oracle, 1 for other methods."""
    reward_negative: float | None = None
    """R-. None: 0 for the autoencoder, -1 for other methods."""
    reward_noise: float = 0.0
    """Standard deviation of the noise on the state from which the oracle's reward is computed, in the unit of the state."""
    reward_false_positives: float = 0.0
    """Fraction of the oracle's negatives that are rewarded as positives."""
    reward_false_negatives: float = 0.0
    """Fraction of the oracle's positives that are rewarded as negatives."""
    reward_clutter: float = 1.0
    """Fraction of the workspace, from the low end of the state's first coordinate, to which these false rewards are
    confined."""

    # -- DDPG
    discount: float | None = None
    """gamma. None: 1 - 1/horizon."""
    actor_learning_rate: float = 1e-3
    """Adam step size of the actor."""
    critic_learning_rate: float = 1e-3
    """Adam step size of the critic."""
    target_decay: float = 0.99
    """Decay of a target network: the fraction of its parameters kept at each of its updates."""
    target_update_interval: int = 1
    """Gradient steps between target updates."""
    actor_interval: int = 1
    """Critic gradient steps per actor gradient step; divides updates_per_iteration."""
    n_step: int = 1
    """Number of rewards summed in a target before it bootstraps. More than 1 needs true states and a method without a
    filter."""
    action_penalty: float = 1.0
    """Weight of the mean squared action in the actor's loss."""
    actor_log: Literal["value", "loss"] = "value"
    """Quantity whose logarithm the actor minimises, with log weightings. value: log(Q_max - Q) plus the action penalty, as in
    the authors' release, so the penalty's relative weight grows with Q_max - Q. loss: log(Q_max - Q + penalty), which keeps
    their ratio."""
    clip_targets_above: bool = True
    """Clip critic targets at R+/(1-gamma) too (they are always clipped at R-/(1-gamma) below)."""
    random_action_probability: float = 0.3
    """Exploration: fraction of actions drawn uniformly."""
    action_noise: float = 0.2
    """Exploration: standard deviation of the Gaussian noise added to the other actions."""

    # -- Auxiliary losses (thesis, section 5.2; docs/auxiliary_losses.md)
    aux_tasks: tuple[AuxTaskName, ...] = ()
    """Auxiliary tasks that the encoders are also trained on; module:Name for your own."""
    weighting: WeightingName = "none"
    """Weighting of the auxiliary losses; module:Name for your own."""
    weighting_interval: int = 5
    """N of OL-AUX: gradient steps between updates of the weights; divides updates_per_iteration."""
    weighting_beta: float | None = None
    """beta of OL-AUX: step size of the weights, in multiples of critic_learning_rate. None: 5 N."""
    weighting_main_grad: Literal["main", "total"] = "main"
    """Gradient with which OL-AUX compares those of the auxiliary losses: that of the main loss, or, as in the authors' release,
    that of the total loss."""
    weighting_window: int = 1
    """Gradient steps over which OL-AUX averages gradients before it compares them; 4 in the authors' release."""
    weighting_fixed: float = 1.0
    """Weight of every auxiliary loss, for weighting fixed."""
    weighting_log: bool = False
    """Minimise the logarithms of the losses, with weighting cosine."""
    aux_form: Literal["thesis", "release"] = "thesis"
    """Form of the auxiliary tasks' targets, where the thesis and the authors' release differ (`auxtasks.Options`)."""

    # -- Networks
    encoder_filters: tuple[int, ...] = (16, 32, 64, 64)
    """Output channels of the 2x2 stride-2 convolutions."""
    latent_size: int = 512
    """Size of an encoded image."""
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Hidden layers of the actor's and the critic's heads."""
    encoders: Literal["separate", "shared"] = "separate"
    """Give the actor a separate encoder, or let it act on the latents of the critic's encoder, which it cannot change."""
    target_encoder: bool = True
    """Give target networks slowly updated encoders of their own; if false, the target heads read the latents of the online
    encoders."""
    random_shift: int = 0
    """Random shift augmentation: largest shift in pixels per axis, the same for the three images of a transition (Kostrikov et
    al., 2020)."""
    compute_dtype: ComputeDtype = "auto"
    """Precision of the networks' arithmetic; parameters and losses are float32. auto: bfloat16 on accelerators."""
    normalizer_floor: float = 0.01
    """Smallest standard deviation that an observation is divided by, in the observation's unit (grey levels for images)."""
    normalizers: Literal["shared", "separate"] = "shared"
    """Statistics that normalise goals: those of all observations (shared), or, as in the authors' release, their own
    (separate)."""
    normalizer_source: Literal["rollouts", "relabelled"] = "rollouts"
    """Source of the normalisation statistics: all observations of a rollout, or, as in the authors' release, relabelled
    transitions."""
    normalizer_clip: float = 5.0
    """Bound to which normalised observations are clipped: plus and minus this."""

    # -- Evaluating and saving
    eval_interval: int = 2
    """Iterations between evaluations; a last one runs at the end of training."""
    eval_episodes: int = 1000
    """Number of episodes of an evaluation, always the same ones."""
    checkpoint_interval: int = 5
    """Iterations between light checkpoints (networks and optimisers; enough for eval and play)."""
    full_checkpoint_interval: int = 0
    """Iterations between full checkpoints (with the replay, for an exact resume). 0: only when a run is interrupted."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Raises:
            RequestError: A name is not a field.
        """
        names = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            if name not in names:
                raise RequestError(f"unknown option {name!r}{nearest(name, names)}")
        return dataclasses.replace(self, **changes)


_PAPER = Config(
    preset="paper",
    image_size=100,
    num_envs=80,
    env_steps=800_000,
    updates_per_iteration=40,
    batch_size=512,
    replay_transitions=40_000,
    target_decay=0.98,
    target_update_interval=40,
    clip_targets_above=False,
    eval_interval=5,
)

_FAST = Config()

_CPU = _FAST.replace(
    preset="cpu",
    pixels="depth",
    image_size=32,
    num_envs=64,
    env_steps=64_000,
    updates_per_iteration=200,
    batch_size=128,
    replay_transitions=64_000,
    latent_size=128,
    hidden_sizes=(256, 256),
    eval_interval=2,
    eval_episodes=256,
)

_DEBUG = _CPU.replace(
    preset="debug",
    image_size=16,
    num_envs=4,
    env_steps=800,
    updates_per_iteration=4,
    batch_size=16,
    replay_transitions=800,
    encoder_filters=(8, 8),
    latent_size=16,
    hidden_sizes=(32,),
    eval_interval=2,
    eval_episodes=8,
    checkpoint_interval=2,
)

PRESETS: dict[str, Config] = {config.preset: config for config in (_PAPER, _FAST, _CPU, _DEBUG)}
"""``paper``: the authors' release. ``fast``: ours. ``cpu``: minutes on two cores. ``debug``: seconds, too short to learn."""

# A rollout of the hand is bound by GPU latency: with 500 environments it takes hardly longer than with 100. FetchReach is
# learned in so few steps that more frequent evaluations are worthwhile; a checkpoint takes as long as two of its iterations.
OF_TASK: dict[tuple[str, str], dict[str, Any]] = {
    ("fast", "HandReach"): {
        "num_envs": 500,
        "updates_per_iteration": 1000,
        "replay_transitions": 700_000,
        "random_action_probability": 0.1,
        "encoders": "shared",
        "target_encoder": False,
        "actor_interval": 2,
        "random_shift": 2,
    },
    ("fast", "FetchReach"): {
        "num_envs": 25,
        "updates_per_iteration": 50,
        "eval_interval": 4,
        "checkpoint_interval": 20,
        "encoders": "shared",
        "target_encoder": False,
        "random_shift": 6,
        "relabel_probability": 0.8,
        "balance_probability": 0.3,
    },
    ("cpu", "FetchReach"): {
        "num_envs": 16,
        "updates_per_iteration": 50,
        "eval_interval": 8,
        "encoders": "shared",
        "target_encoder": False,
        "random_shift": 1,
        "relabel_probability": 0.8,
        "balance_probability": 0.3,
    },
    ("cpu", "Reacher"): {"relabel_probability": 0.8, "balance_probability": 0.3},
    ("fast", "FingerTurn"): {"trivial_goals": 0.2, "actor_log": "loss"},
    ("cpu", "FingerTurn"): {"trivial_goals": 0.2, "actor_log": "loss"},
}
"""(preset, task) -> fields with task-specific values in this preset, for images or states; see docs/learner.md."""
# Fields that apply only with the oracle's rewards: other methods read no true states and have their own balance.
OF_ORACLE = ("trivial_goals", "balance_probability")
# Fields that apply only to images; also left out where rewards come from comparing images.
OF_IMAGES = ("random_shift", "relabel_probability", "balance_probability")


def preset(name: str, **overrides: Any) -> Config:
    """Return a preset with some fields changed.

    Args:
        name: ``paper``, ``fast``, ``cpu`` or ``debug`` (`PRESETS`). Some have task-specific values.
        **overrides: Fields of `Config` and their values.

    Raises:
        RequestError: There is no such preset, or no such field.
    """
    if name not in PRESETS:
        raise RequestError(f"unknown preset {name!r}{nearest(name, list(PRESETS))}")
    config = PRESETS[name]
    env = str(overrides.get("env", config.env))
    of_task = OF_TASK.get((name, env.removeprefix("Visual")), {})
    method_name = overrides.get("method", config.method)
    method = METHODS.get(method_name)
    left_out: tuple[str, ...] = ()
    if ":" in str(method_name) or (method is not None and method.reward != "oracle"):
        left_out += OF_ORACLE
    if not env.startswith("Visual") or (method is not None and method.reward == "autoencoder"):
        left_out += OF_IMAGES
    of_task = {field: value for field, value in of_task.items() if field not in left_out}
    return config.replace(**{**of_task, **overrides})


def data_devices_of(config: Config) -> int:
    """Return the number of devices that share one learner, with the default of ``data_devices`` filled in."""
    if config.data_devices is not None:
        return config.data_devices
    return config.devices if config.seeds == 1 else 1


_OLD_NAMES = {"frames": "frame_stack"}
_REMOVED = ("aux_gradients",)  # gradients are the same up to rounding, however they were found


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """Read a saved configuration: `dataclasses.asdict` after a round trip through JSON, which turns tuples into lists.

    Fields saved under an earlier name are recognised; missing fields take their defaults.

    Raises:
        RequestError: ``values`` is no dictionary, or a field is unknown or of the wrong type. The message names the field.
    """
    if not isinstance(values, Mapping):
        raise RequestError(f"a configuration must be a dictionary of options, not {type(values).__name__}")
    hints = fields.hints(Config)
    found: dict[str, Any] = {}
    for saved_name, value in values.items():
        name = _OLD_NAMES.get(saved_name, saved_name)
        if name in _REMOVED:
            continue
        if name not in hints:
            raise RequestError(f"unknown option {name!r}{nearest(str(name), hints)}")
        if name in found:
            raise RequestError(f"{name} is given twice, once by its old name")
        found[name] = fields.check(name, hints[name], value)
    return Config(**found)
