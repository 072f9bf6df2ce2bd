import dataclasses
import functools
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis import bench, cli
from jaxrl_vis.bench import conditions, peaks, physics, record, render, roofline, timing, train, update, variation
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.base import GoalEnv, State
from jaxrl_vis_envs.pixels import PixelsConfig


def measurement(value: float, envs: int = 4, unit: str = "images/s") -> Measurement:
    return Measurement(
        "render/images", value, unit, {"env": "VisualReacher", "envs": envs, "sizes": (1, 2)}, {"compile_s": 1.5}
    )


def idle_conditions(speed: float = 1.0, **changes: Any) -> dict[str, Any]:
    """Return the conditions of an idle machine whose calibration is ``speed`` times the usual one."""
    calibration = {"gflops": 100.0 * speed, "gbytes_per_s": 10.0 * speed}
    same = {"machine": "a", "cores": 2, "busy_cores": 0.0, "calibration": {"before": calibration, "after": calibration}}
    return {**same, **changes}


def test_record_round_trip_and_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for value in (100.0, 110.0):
        record.compare_and_keep("render", measurement(value), tmp_path, idle_conditions())
    record.compare_and_keep("render", measurement(50.0, envs=8), tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert "(first record)" in lines[0]
    assert "+10.0 %" in lines[2]
    assert "(first record)" in lines[4]
    path = record.results_path("render", tmp_path)
    assert [path] == list(tmp_path.iterdir())
    kept = {entry["config"]["envs"]: entry for entry in record.load(path)}
    assert {envs: entry["value"] for envs, entry in kept.items()} == {4: 110.0, 8: 50.0}
    assert kept[4]["config"]["sizes"] == [1, 2]
    expected = {"conditions", "schema", "name", "value", "unit", "config", "details", "device", "versions", "revision", "date"}
    assert set(kept[4]) == expected
    assert kept[4]["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize(
    ("now", "then", "why"),
    [
        (idle_conditions(), None, "it does not say how fast its machine was"),
        (idle_conditions(machine="b"), idle_conditions(), "it is of another machine of this name"),
        (idle_conditions(0.58), idle_conditions(), "the machine itself runs at 0.58 times the speed that it had then"),
        (idle_conditions(busy_cores=1.2), idle_conditions(), "other programs used 1.2 of 2 cores now"),
        (idle_conditions(), idle_conditions(busy_cores=1.9), "other programs used 1.9 of 2 cores then"),
        (
            idle_conditions(calibration={"before": {"gflops": 100.0}, "after": {"gflops": 60.0}}),
            idle_conditions(calibration={"before": {"gflops": 80.0}, "after": {"gflops": 80.0}}),
            "while it was measured now, the machine's speed changed by -40%",
        ),
    ],
)
def test_only_like_is_compared_with_like(now: dict, then: dict | None, why: str) -> None:
    """Regression test: a machine of the same name at 0.58 times the speed was reported as a loss of 42 %."""
    old, new = (record.to_record(measurement(value), each) for value, each in ((100.0, then), (58.0, now)))
    line = record.describe(new, old)
    assert line.endswith(f": {why})") and "not compared with 100 of" in line and "42 %" not in line


def test_a_change_is_reported_with_the_spread_of_the_repeats() -> None:
    old, new = (record.to_record(measurement(value), idle_conditions(speed)) for value, speed in ((100.0, 1.0), (97.0, 0.95)))
    line = record.describe(new, old)
    assert "-3.0 % against 100 of" in line and line.endswith("the same machine at the same speed)")
    new["details"]["spread"] = 0.04
    assert record.describe(new, old).endswith("the same speed, no more than the spread of the repeats, 4.0 %)")


def test_a_calibration_keeps_no_more_than_two_results_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of results of half a gigabyte would fill a device."""
    alive, most = 0, 0

    class Result:
        def __init__(self) -> None:
            nonlocal alive, most
            alive += 1
            most = max(most, alive)

        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    monkeypatch.setattr(conditions, "calibrations", lambda: {"results": conditions.Work(Result, (), 1.0)})
    assert conditions.calibrate()["results"] > 0.0
    assert alive == 0 and most <= 2


def test_what_a_machine_is_calibrated_with_is_computed_when_it_is_measured() -> None:
    """Constants would be folded by the compiler, for minutes on a GPU, and not computed when the machine is measured."""
    for work in conditions.calibrations().values():
        bytes_of_arguments = sum(array.nbytes for array in work.arguments)
        assert work.program.memory_analysis().argument_size_in_bytes == bytes_of_arguments > 0  # type: ignore[attr-defined]
        assert work().shape == work.arguments[0].shape


def test_the_machine_is_watched() -> None:
    monitor = conditions.ConditionMonitor()
    found = monitor.conditions()
    assert conditions.machine_id() == found["machine"] and len(found["machine"]) == 12
    assert found["busy_cores"] is None or 0.0 <= found["busy_cores"] <= 2 * found["cores"]
    for each in found["calibration"].values():
        assert set(each) == {"gflops", "gbytes_per_s"} and all(value > 0.0 for value in each.values())
    assert found["calibration"]["after"] == monitor.conditions()["calibration"]["before"]


def test_a_user_s_records_go_into_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    record.compare_and_keep("render", measurement(1.0))
    assert [path.parent for path in tmp_path.rglob("*.json")] == [tmp_path / "jaxrl-vis" / "bench"]
    assert "conditions" in record.load(record.results_path("render"))[0]


def test_records_of_another_device_do_not_compare(tmp_path: Path) -> None:
    path = tmp_path / "render.json"
    first = record.to_record(measurement(100.0))
    assert record.keep(path, first) is None
    assert record.keep(path, {**first, "device": "another"}) is None
    assert record.keep(path, {**first, "value": 90.0})["value"] == 100.0
    assert len(record.load(path)) == 2


def test_a_file_of_something_else_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "render.json"
    path.write_text('[{"schema": 99}]')
    with pytest.raises(ValueError, match="schema"):
        record.keep(path, record.to_record(measurement(1.0)))
    assert path.read_text() == '[{"schema": 99}]'


@pytest.mark.parametrize("contents", ["[{", '["a record"]', '{"schema": 1}'])
def test_a_damaged_file_is_reported_before_anything_is_measured(
    contents: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise the measurement would be lost, because it could not be stored."""
    path = record.results_path("physics", tmp_path)
    path.write_text(contents)
    monkeypatch.setattr(physics, "measure", lambda _: pytest.fail("measured"))
    assert cli.main(["bench", "physics", "--results", str(tmp_path)]) == 2
    line = capsys.readouterr().err
    assert str(path) in line and line.count("\n") == 1
    assert path.read_text() == contents


def test_json_holds_this_run_s_records(tmp_path: Path) -> None:
    records = [record.to_record(measurement(1.0), idle_conditions()), record.to_record(measurement(2.0, envs=8))]
    record.write_json(tmp_path / "deep" / "out.json", records)
    assert [entry["value"] for entry in json.loads((tmp_path / "deep" / "out.json").read_text())] == [1.0, 2.0]


def test_a_record_of_no_checkout_has_an_unknown_revision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "revision", lambda digits: None)
    assert record.to_record(measurement(1.0))["revision"] == "unknown"


def test_copies_are_refused() -> None:
    variation.assert_varied(np.arange(8).reshape(4, 2), "rows")
    with pytest.raises(AssertionError, match="only 1 of 4 rows differ"):
        variation.assert_varied(np.ones((4, 2)), "rows")
    variation.assert_varied(np.ones((1, 2)), "rows")


def test_timing_keeps_its_budget_and_takes_the_median() -> None:
    calls = []
    slow = timing.measure(lambda: (calls.append(1), time.sleep(0.15)), repeats=50, budget_s=0.5)
    assert 3 <= slow.repeats < 10
    assert len(calls) == slow.repeats + 2
    assert 0.15 <= slow.median_s < 1.0
    quick = timing.measure(lambda: calls.append(2), repeats=1)
    assert quick.repeats == 1
    assert calls.count(2) > 10


def test_least_cost_agrees_with_the_compiler_for_dense_layers() -> None:
    sizes = (24, 32, 16, 3)
    kernels = [jnp.ones((first, second)) for first, second in zip(sizes, sizes[1:], strict=False)]

    def forward(rows):
        for kernel in kernels:
            rows = rows @ kernel
        return rows

    counted = roofline.compiler_cost(jax.jit(forward).lower(jnp.ones((8, 24))).compile())
    assert counted is not None
    assert counted.flops == pytest.approx(2 * 8 * roofline.head_products(sizes), rel=0.02)


def test_encoder_products_count_every_layer() -> None:
    from jaxrl_vis.learner.networks.networks import Networks

    config = preset("debug", encoder_filters=(8, 16), latent_size=32)
    networks = Networks(config, jax.ShapeDtypeStruct((3, 16, 16), jnp.uint8), 4, 0.0)
    first = 8 * 8 * (4 * 3) * 8
    assert roofline.encoder_products(networks) == (first + 4 * 4 * (4 * 8) * 16 + 4 * 4 * 16 * 32, first)


def test_peaks_take_the_longest_name() -> None:
    assert peaks.device_peak("NVIDIA H100 80GB HBM3") is peaks.PEAKS["NVIDIA H100 80GB HBM3"]
    assert peaks.device_peak("NVIDIA H200 NVL") is peaks.PEAKS["NVIDIA H200"]
    assert peaks.device_peak("cpu") is None
    shares = roofline.describe(roofline.Cost(989e9, 3.35e9), 0.01, "bfloat16", "NVIDIA H100 80GB HBM3")
    assert shares["share_of_peak_flops"] == pytest.approx(0.1)
    assert shares["share_of_peak_bandwidth"] == pytest.approx(0.1)
    assert shares["roofline_updates_per_s"] == 1000


def test_noise_fills_the_whole_replay() -> None:
    from jaxrl_vis.bench.update import fill_replay
    from jaxrl_vis.learner.memory.replay import make_replay

    replay = make_replay(transitions=40, num_envs=2, horizon=5)
    empty = replay.init(jax.ShapeDtypeStruct((1, 4, 4), jnp.uint8), goal_state_size=3, action_size=2)
    full = fill_replay(empty, jax.random.key(0))
    assert jax.tree.map(jax.typeof, full) == jax.tree.map(jax.typeof, empty)
    assert int(full.size) == replay.num_episodes
    frames = np.asarray(full.episodes.observations).reshape(replay.num_episodes * 7, -1)
    assert len({frame.tobytes() for frame in frames}) == len(frames)


class Dot(GoalEnv):
    """Environment that compiles quickly: a bright dot moves in a dark image."""

    name, horizon, action_size, threshold, control_period = "Dot", 3, 2, 0.1, 0.1

    def __init__(self, config: PixelsConfig | None = None, moves: bool = True) -> None:
        self.moves = moves

    def draw(self, place: jax.Array) -> jax.Array:
        rows = jnp.linspace(-1.0, 1.0, 16)
        bump = jnp.exp(-((rows[:, None] - place[0]) ** 2) - (rows[None] - place[1]) ** 2)
        return (255 * bump[None]).astype(jnp.uint8)

    def reset(self, key: jax.Array) -> State:
        goal = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        frame = self.draw(jnp.zeros(2))
        obs = {"observation": frame, "achieved_goal": frame, "desired_goal": self.draw(goal)}
        return self._measure(jnp.zeros(2), jnp.zeros(2), goal, obs)

    def advance(self, state: State, action: jax.Array) -> State:
        place = state.data + 0.3 * action * self.moves
        return self._measure(place, place, state.goal_state, state.obs)

    def observe(self, state: State) -> jax.Array:
        return self.draw(state.data)


@pytest.fixture
def dots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments ``Dot``, whose dot moves, and ``StillDot``, whose dot does not; their configuration marks them as visual.

    Measurements are shorter than usual, because no test depends on their values.
    """
    monkeypatch.setattr(timing, "_MIN_SECONDS", 0.01)
    for name, moves in (("Dot", True), ("StillDot", False)):
        make = functools.partial(Dot, moves=moves)
        monkeypatch.setitem(registry._ENTRIES, name, registry._Entry(make, PixelsConfig))


@pytest.mark.usefixtures("dots")
@pytest.mark.parametrize("benchmark", bench.BENCHMARKS)
def test_every_benchmark_keeps_records(benchmark: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def tiny(_: Settings, **overrides: int):
        return preset("debug", **overrides)

    for module in (train, update):
        monkeypatch.setattr(module, "training_config", tiny)
    found = bench.run(benchmark, env="Dot", envs=(3,), repeats=1, results=tmp_path, json=tmp_path / "out" / "run.json")
    assert found and all(entry.value > 0.0 for entry in found)
    assert len(json.loads((tmp_path / "out" / "run.json").read_text())) == len(found)
    assert len(record.load(record.results_path(benchmark, tmp_path))) == len(found)
    if benchmark == "train":
        parts = found[0].details["milliseconds"]
        assert set(parts) == {"rollout", "insert", "updates", "evaluation", "host", "env"}
        assert all(part > 0.0 for name, part in parts.items() if name != "host") and parts["host"] >= 0.0
        iteration = 1e3 * 3 * Dot.horizon / found[0].value  # ms; 3 environments
        assert found[0].details["share_of_predicted"] == pytest.approx((parts["env"] + parts["updates"]) / iteration, rel=0.01)


def test_what_one_of_several_devices_does() -> None:
    """Efficiency is relative to a run of one device with its share of the seeds, or of the learner."""
    config = preset("debug", seeds=6, num_envs=8, batch_size=16, replay_transitions=800)
    seeds = train.single_device_config(config.replace(devices=2))
    assert (seeds.run.devices, seeds.run.seeds, seeds.run.num_envs, seeds.run.batch_size) == (1, 3, 8, 16)
    parts = train.single_device_config(config.replace(devices=4, data_devices=2))
    assert (parts.run.seeds, parts.run.num_envs, parts.run.batch_size, parts.run.replay_transitions) == (3, 4, 8, 400)


def test_a_table_says_where_an_iteration_goes() -> None:
    parts = {"rollout": 0.25, "insert": 0.05, "updates": 0.5, "evaluation": 0.1, "host": 0.0}
    lines = {" ".join(line.split()[:-3]): line.split()[-3:] for line in train.describe(1.0, parts, 0.7).splitlines()}
    assert lines["rollout"] == ["250.00", "ms", "25.0%"]
    assert lines["sum without evaluation"] == ["800.00", "ms", "80.0%"]
    assert lines["predicted"] == ["700.00", "ms", "70.0%"]


@pytest.mark.usefixtures("dots")
def test_several_learners_are_measured_together(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(env="Dot", seeds=2)
    assert update.training_config(settings).run.seeds == 2
    monkeypatch.setattr(update, "training_config", lambda _, **overrides: preset("debug", seeds=2, **overrides))
    (found,) = update.measure(dataclasses.replace(settings, repeats=1).for_this_device())
    assert found.config["seeds"] == 2 and found.value > 0.0
    assert "seeds" not in Settings(env="Dot").seeds_config()


@pytest.mark.usefixtures("dots")
@pytest.mark.parametrize("benchmark", ["render", "physics", "env"])
def test_a_broadcast_is_not_measured(benchmark: str, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="broadcast"):
        bench.run(benchmark, env="StillDot", envs=(3,), repeats=1, results=tmp_path)


@pytest.mark.usefixtures("dots")
def test_settings_of_images_go_to_environments_that_have_them() -> None:
    images, none = Settings(env="Dot", image_size=16, pixels="rgb"), Settings(env="Reacher", image_size=16, pixels="rgb")
    assert images.image_config() == {"env": "Dot", "image_size": 16, "pixels": "rgb"}
    assert none.image_config() == {"env": "Reacher"}
    assert update.training_config(images).environment.image_size == 16
    with pytest.raises(RequestError, match="needs an environment with images, and Reacher has none"):
        bench.run("render", env="Reacher")


@pytest.mark.parametrize(("requested", "sizes"), [(None, (32, 64)), (64, (64,)), (16, (16,))])
def test_only_a_requested_image_size_is_measured(requested: int | None, sizes: tuple[int, ...]) -> None:
    assert render.image_sizes(Settings(image_size=requested).for_this_device()) == sizes


def test_a_missing_opengl_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import mujoco

    from benchmarks.peers import mujoco as peer

    def no_renderer(*_, **__):
        raise RuntimeError("cannot\nconnect")

    monkeypatch.setattr(mujoco, "Renderer", no_renderer, raising=False)
    with pytest.raises(RequestError, match="needs OpenGL.*MUJOCO_GL") as caught:
        peer.check()
    assert "\n" not in str(caught.value)
