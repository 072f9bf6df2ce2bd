"""The configuration of a training run: one frozen dataclass and four presets. What follows for an environment: `resolved`.

Imports no JAX, so that the command line can print its help at once.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, Self

from jaxrl_vis import fields
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.methods import METHODS, AlgorithmName, AuxTaskName, MethodName, WeightingName

# Values that a field allows, for everything that asks: checks, the command line and its help.
Pixels = Literal["rgbd", "rgb", "depth"]
Randomized = Literal["camera", "lights", "colours", "dynamics"]
ComputeDtype = Literal["auto", "float32", "bfloat16"]


@dataclasses.dataclass(frozen=True)
class Config:
    """One training run. Counts are per seed; lengths of time are in control steps unless a unit is given.

    The defaults are the preset ``fast``'s; `preset` also has what that has otherwise for some tasks.
    """

    env: str = "VisualFetchReach"
    """The environment; `jaxrl-vis envs` lists them, and module:Name is one of your own."""
    env_folder: str | None = None
    """Folder from which module:Name is imported; a run keeps it. None: the current one, or wherever Python finds the module."""
    preset: str = "fast"
    """The preset that this configuration started from; kept for the record."""
    method: MethodName = "oracle"
    """Where rewards come from: the true state (oracle), similarity in the latent space of an autoencoder that is trained along,
    or equality of observations (indicator), without or with balancing and filtering; module:Name is one of your own."""
    algorithm: AlgorithmName = "ddpg"
    """What learns; module:Name is one of your own."""
    seed: int = 0
    """First seed."""
    seeds: int = 1
    """How many seeds to train side by side in one program: seed, seed + 1, ..."""

    # -- Where it runs (docs/scaling.md)
    devices: int = 1
    """How many devices to use. Several seeds are divided among them; of one seed, each batch and the environments are."""
    data_devices: int | None = None
    """How many devices share each learner: its environments, replay and batches. None: one, or all of them if there is one
    seed."""

    # -- The environment
    pixels: Pixels = "rgbd"
    """Channels of the image."""
    image_size: int = 64
    """Height and width of the image, in pixels."""
    frame_stack: int | None = None
    """Images of the latest control steps that an observation stacks. None: the environment's own number."""
    env_options: tuple[str, ...] = ()
    """Further options of the environment, as name=value; docs/tasks.md has those that undo a departure from a release."""
    randomize: tuple[Randomized, ...] = ()
    """What varies between episodes, in training and in evaluation."""
    randomize_strength: float = 1.0
    """How far it varies, in multiples of the typical ranges (`jaxrl_vis_envs.randomization.KINDS`)."""
    observation_noise: float = 0.0
    """Standard deviation of the camera's noise, in the observation's unit (grey levels for images); new in every frame."""
    num_envs: int = 100
    """Environments in a rollout; each plays one episode per iteration."""

    # -- How long, and how often to learn
    env_steps: int = 200_000
    """Environment steps to train for; rounded up to whole iterations of num_envs * horizon."""
    updates_per_iteration: int = 200
    """Gradient steps after each rollout."""
    batch_size: int = 512
    """Transitions in a gradient step."""
    replay_transitions: int = 200_000
    """Replay capacity; rounded up to whole rollouts."""
    replay_mean_age: int | None = None
    """Mean age of samples, in transitions: the older, the rarer, as if new episodes replaced random ones. None: all alike."""

    # -- Goal relabelling and reward (thesis, section 5.1.4)
    relabel_probability: float = 0.9
    """p1: share of samples whose goal is replaced by an observation of the same episode."""
    balance_probability: float | None = None
    """p2: share of those whose goal is the very next observation, a sure positive. None: 0.5 for balancing methods, else 0."""
    filter_threshold: float | None = None
    """q0: negatives with Q above it are dropped as false. None: the middle of its band, for filtering methods."""
    trivial_goals: float = 1.0
    """Share kept of relabelled goals that are reached already before the action; the others give way to what another episode
    observed."""
    reward_positive: float | None = None
    """R+. None: 0 for the oracle, 1 for other methods."""
    reward_negative: float | None = None
    """R-. None: 0 for the autoencoder, -1 for other methods."""
    reward_noise: float = 0.0
    """Standard deviation of the noise on the state that the oracle's reward is computed from, in the unit of the state."""
    reward_false_positives: float = 0.0
    """Share of the oracle's negatives that are rewarded as positives."""
    reward_false_negatives: float = 0.0
    """Share of the oracle's positives that are rewarded as negatives."""
    reward_clutter: float = 1.0
    """Share of the workspace, from the low end of the state's first coordinate, where all those false rewards occur."""

    # -- DDPG
    discount: float | None = None
    """gamma. None: 1 - 1/horizon."""
    actor_learning_rate: float = 1e-3
    """Adam step size of the actor."""
    critic_learning_rate: float = 1e-3
    """Adam step size of the critic."""
    target_decay: float = 0.99
    """Share of a target network that stays at each update of it."""
    target_update_interval: int = 1
    """Gradient steps between target updates."""
    actor_interval: int = 1
    """Gradient steps of the critic for each one of the actor; divides updates_per_iteration."""
    n_step: int = 1
    """Rewards that a target sums before it trusts the critic. More than 1 needs true states, and a method without a filter."""
    action_penalty: float = 1.0
    """Weight of the mean squared action in the actor's loss."""
    actor_log: Literal["value", "loss"] = "value"
    """Of what an actor learns the logarithm, with weightings that take logarithms. value: of its value's distance from the best
    there can be, as in the authors' release, with the action penalty added afterwards, which weighs as many times more as that
    distance is large. loss: of the distance and the penalty together, which keeps their proportion."""
    clip_targets_above: bool = True
    """Clip critic targets at R+/(1-gamma) too (they are always clipped at R-/(1-gamma) below)."""
    random_action_probability: float = 0.3
    """Exploration: share of actions drawn uniformly."""
    action_noise: float = 0.2
    """Exploration: standard deviation of the Gaussian noise on the other actions."""

    # -- Auxiliary losses (thesis, section 5.2; docs/auxiliary_losses.md)
    aux_tasks: tuple[AuxTaskName, ...] = ()
    """What the encoders also learn to predict; module:Name is one of your own."""
    weighting: WeightingName = "none"
    """How much each auxiliary loss counts; module:Name is one of your own."""
    weighting_interval: int = 5
    """N of OL-AUX: gradient steps from one change of the weights to the next; divides updates_per_iteration."""
    weighting_beta: float | None = None
    """beta of OL-AUX: step size of the weights, in multiples of critic_learning_rate. None: 5 N."""
    weighting_main_grad: Literal["main", "total"] = "main"
    """Whose gradient OL-AUX compares others with: the main loss's, or, as in the authors' release, that of all losses."""
    weighting_window: int = 1
    """Gradient steps over which OL-AUX averages gradients before it compares them; 4 in the authors' release."""
    weighting_fixed: float = 1.0
    """Weight of every auxiliary loss, for weighting fixed."""
    weighting_log: bool = False
    """Whether weighting cosine learns logarithms of the losses."""
    aux_form: Literal["thesis", "release"] = "thesis"
    """Whose targets the auxiliary tasks have, where the thesis and the authors' release differ (`auxtasks.Options`)."""

    # -- Networks
    encoder_filters: tuple[int, ...] = (16, 32, 64, 64)
    """Output channels of the 2x2 stride-2 convolutions."""
    latent_size: int = 512
    """Size of an encoded image."""
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Hidden layers of the actor's and the critic's heads."""
    encoders: Literal["separate", "shared"] = "separate"
    """Whether the actor has an encoder of its own, or acts on the latents of the critic's, which it cannot change."""
    target_encoder: bool = True
    """Whether target networks have encoders of their own, which follow slowly; if not, the targets' heads read the online
    encoders' latents."""
    random_shift: int = 0
    """Images of a batch move by up to so many pixels each way, the three of a transition alike (Kostrikov et al., 2020)."""
    compute_dtype: ComputeDtype = "auto"
    """Arithmetic of the networks; parameters and losses are float32. auto: bfloat16 on accelerators."""
    normalizer_floor: float = 0.01
    """Smallest standard deviation that an observation is divided by, in the observation's unit (grey levels for images)."""
    normalizers: Literal["shared", "separate"] = "shared"
    """Whether goals are normalised with the statistics of all observations, or, as in the authors' release, with their own."""
    normalizer_source: Literal["rollouts", "relabelled"] = "rollouts"
    """What statistics are of: every observation of a rollout, or, as in the authors' release, its relabelled transitions."""
    normalizer_clip: float = 5.0
    """Normalised observations are clipped to plus and minus this."""

    # -- Evaluating and saving
    eval_interval: int = 2
    """Iterations between evaluations; one more comes at the end."""
    eval_episodes: int = 1000
    """Episodes of an evaluation, always the same ones."""
    checkpoint_interval: int = 5
    """Iterations between light checkpoints (networks and optimisers; enough for eval and play)."""
    full_checkpoint_interval: int = 0
    """Iterations between full checkpoints (with the replay; resume is exact). 0: only at the end of an interrupted run."""

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed.

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
"""``paper``: the authors' release. ``fast``: ours. ``cpu``: what two cores do in minutes. ``debug``: seconds, no learning."""

# A rollout of the hand waits for the GPU's latency: with 500 environments it takes hardly longer than with 100. FetchReach is
# learned in so few steps that it pays to look more often at what they taught; a checkpoint takes two of its iterations.
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
"""(preset, task) -> fields that this preset has otherwise for this task, from images or states; see docs/learner.md."""
# Of those, what goes with the oracle's rewards: other methods read no true states, and have a balance of their own.
OF_ORACLE = ("trivial_goals", "balance_probability")
# And what goes with images: left out from states, and where images are compared to give rewards.
OF_IMAGES = ("random_shift", "relabel_probability", "balance_probability")


def preset(name: str, **overrides: Any) -> Config:
    """A named configuration with some fields changed.

    Args:
        name: ``paper``, ``fast``, ``cpu`` or ``debug`` (`PRESETS`). Some have settings of their own for some tasks.
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
    """How many devices share each learner, where ``data_devices`` leaves that open, too."""
    if config.data_devices is not None:
        return config.data_devices
    return config.devices if config.seeds == 1 else 1


_OLD_NAMES = {"frames": "frame_stack"}
_REMOVED = ("aux_gradients",)  # gradients are the same up to rounding, however they were found


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """The configuration that a run saved: what JSON makes of `dataclasses.asdict`, which has lists in the place of tuples.

    Fields that had another name when it was saved are known by that, too; fields that are missing have their defaults.

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
