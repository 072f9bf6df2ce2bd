"""Rows of the tables of docs/lab/results.md: records and wording. `lab_results` writes them."""

import dataclasses
from typing import Any

from jaxrl_vis.config import Config, preset

DEVICES = {"H100": "NVIDIA H100 80GB HBM3 x1", "H200": "NVIDIA H200 x1", "2 CPU cores": "AMD EPYC, 2 cores"}
"""Columns of the speed table: title -> device of the records."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """Figure of the speed table: selection and wording of one record.

    Among several matching records, such as batch sizes, the one with the largest value counts.

    Attributes:
        name: Name of the record.
        config: Required entries of the record's configuration.
        text: Format string for the record's configuration and details, and for ``value``, which is shortened.
        minimum_of: Detail whose minimum selects the record instead, the one least favourable to us.
    """

    name: str
    config: dict[str, Any]
    text: str
    minimum_of: str | None = None


@dataclasses.dataclass(frozen=True)
class Speed:
    """Row of the speed table.

    Attributes:
        label: Text of the first column.
        figures: Figures by column (a name in `DEVICES`); other cells are empty.
    """

    label: str
    figures: dict[str, tuple[Figure, ...]]


@dataclasses.dataclass(frozen=True)
class Learning:
    """Row of the results table: runs with stored evidence.

    Attributes:
        label: Text of the first column.
        runs: Required configuration by name of the evidence; all seeds are pooled.
        metric: Column of the metrics.
        value_format: Name of the metric in the table, as a format string: ``success {}``.
        targets: Values for which the first steps that reach them are quoted ("X by N steps").
        steps: Environment steps at which values are quoted.
        lower_is_better: True if lower is better.
        command: Command, if it differs from the training command of the configuration.
    """

    label: str
    runs: dict[str, Config]
    metric: str = "eval/success"
    value_format: str = "success {:.2f}"
    targets: tuple[float, ...] = ()
    steps: tuple[int, ...] = ()
    lower_is_better: bool = False
    command: str | None = None


_IMAGES = "{image_size}x{image_size} {pixels}"


_STEPS = f"{{value}} env-steps/s ({{envs:,}} environments, {_IMAGES})"


def _environment(env: str, options: str = "", gpu: str = "H100") -> Speed:
    figures = (Figure("env/steps", {"env": env}, _STEPS),)
    return Speed(f"`bench env --env {env}`{options}", {gpu: figures, "2 CPU cores": figures})


def _scene(size: int, pixels: str) -> Figure:
    config = {"scene": "fetch_reach", "textures": True, "image_size": size, "pixels": pixels}
    return Figure("render/scene", config, f"{{value}} images/s {_IMAGES}")


def _peer(name: str, peer: str, size: int) -> Figure:
    config = {"scene": "fetch_reach", "textures": True, "image_size": size}
    return Figure(name, config, f"{peer}: {{value}} images/s {_IMAGES} (batch {{images:,}})")


def _update(text: str, config: dict[str, object]) -> Figure:
    return Figure("update/gradient_steps", {"env": "VisualFetchReach", **config}, text)


def _peer_update(preset: str, text: str) -> Figure:
    return Figure("update/peer_torch", {"preset": preset, "image_size": 64}, text)


_FAST: dict[str, object] = {"preset": "fast", "seeds": None, "without": None}
_UPDATE = f"{{value}} updates/s (batch {{batch_size}}, {_IMAGES}, {{dtype}})"

SPEED = (
    _environment("VisualFetchReach"),
    _environment("VisualReacher", gpu="H200"),
    _environment("VisualHandReach", ", 20 physics steps each"),
    _environment("VisualFingerTurn", ", 21 physics steps of 10 ms each, 3 stacked images"),
    _environment("VisualSawyerReach", gpu="H200"),
    Speed(
        "`bench env --env VisualFetchPush`, 20 physics steps each, with contacts ([more](push_speed.md))",
        {"H100": (Figure("env/steps", {"env": "VisualFetchPush"}, _STEPS),)},
    ),
    Speed(
        "`bench render --scene fetch_reach`: images of new poses ([more](renderer_speed.md))",
        {
            "H200": (_scene(64, "rgbd"), _scene(64, "depth"), _peer("render/peer_warp", "MuJoCo Warp", 64)),
            "2 CPU cores": (_scene(32, "rgbd"), _scene(64, "rgbd"), _peer("render/peer_mujoco", "`mujoco.Renderer`", 64)),
        },
    ),
    Speed(
        "`python -m benchmarks.peers.warp --scene primitives`: MuJoCo Warp's own 127 geoms, the variant that is hardest for us",
        {
            "H200": (
                Figure(
                    "render/peer_warp",
                    {"scene": "primitives"},
                    f"{{ours_over_peer}} times MuJoCo Warp's {{value}} images/s {_IMAGES} ({{variant}}, batch {{images:,}})",
                    minimum_of="ours_over_peer",
                ),
            )
        },
    ),
    Speed(
        "`bench update`: DDPG, replay included",
        {
            "H100": (
                _update("{value} updates/s (`fast`; batch {batch_size}, 64x64 RGB-D, {dtype})", _FAST),
                _update("{value} of five learners together (`fast`)", {"preset": "fast", "seeds": 5}),
                _update("{value} (`paper`'s networks)", {"preset": "paper", "image_size": 64}),
                _update("{value} (`paper`, 100x100)", {"preset": "paper", "image_size": 100}),
                _update(
                    "at least {roofline[gflop]:.1f} GFLOP an update, so {roofline[tflop_per_s]:.0f} TFLOP/s (`fast`)", _FAST
                ),
            ),
            "2 CPU cores": (Figure("update/gradient_steps", {"env": "VisualFetchReach"}, _UPDATE),),
        },
    ),
    Speed(
        "`python -m benchmarks.peers.torch`: the same gradient steps in PyTorch, compiled with max-autotune "
        "([more](gradient_step.md))",
        {
            "H100": (
                _peer_update("paper", "{ours_over_peer} times PyTorch's {value} updates/s (`paper`)"),
                _peer_update("fast", "{ours_over_peer} times its {value} (`fast`, no shifted images)"),
            )
        },
    ),
)


LEARNING = (
    Learning(
        "VisualFetchReach, 32x32 depth, seeds 0, 1 and 2, one after the other",
        {f"fetch_reach_cpu_seed{seed}": preset("cpu", seed=seed) for seed in (0, 1, 2)},
        targets=(0.9,),
        command="make train SEED=0",
    ),
    Learning(
        "VisualFetchReach, 64x64 RGB-D, oracle reward",
        {"fetch_reach_oracle": preset("fast", seeds=5, env_steps=60_000, eval_interval=1)},
        targets=(0.9, 0.97),
    ),
    Learning(
        "VisualFetchReach, 64x64 RGB-D, indicator rewards with balancing and filtering (images only)",
        {
            "fetch_reach_indicator": preset(
                "fast", seeds=5, method="indicator_balance_filter", env_steps=60_000, eval_interval=1
            )
        },
        targets=(0.9, 0.97),
    ),
    Learning(
        "VisualFingerTurn, 64x64 RGB-D, three frames, oracle reward",
        {"finger_turn_oracle": preset("fast", env="VisualFingerTurn", seeds=5, env_steps=500_000, eval_interval=5)},
        targets=(0.9, 0.97),
    ),
    Learning(
        "VisualHandReach, 64x64 RGB-D, oracle reward",
        {"hand_reach_oracle": preset("fast", env="VisualHandReach", seeds=5, env_steps=2_000_000, eval_interval=2)},
        targets=(0.65, 0.8),
    ),
    Learning(
        "VisualFetchReach, 100x100 RGB-D, with the authors' hyper-parameters (`paper`: 1 update per 100 steps, no auxiliary "
        "losses); their curve: 0.75 at 100 k, 0.98 at 160 k, 0.96 at 200 k",
        {"fetch_reach_paper": preset("paper", seeds=5, env_steps=200_000)},
        steps=(100_000, 160_000),
    ),
    Learning(
        "VisualReacher, 100x100 RGB-D, oracle reward",
        {"reacher_oracle": preset("fast", env="VisualReacher", image_size=100, seeds=5, env_steps=100_000)},
        metric="eval/goal_distance",
        value_format="mean final distance {:.3f} m",
        targets=(0.03, 0.02),
        lower_is_better=True,
    ),
)
