import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, get_args

import pytest

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.cli import train
from jaxrl_vis.cli.bench import Bench, Benchmark
from jaxrl_vis.cli.envs import Envs
from jaxrl_vis.cli.parsing import parse
from jaxrl_vis.cli.train import Train, training_config
from jaxrl_vis.cli.trained.eval import Eval
from jaxrl_vis.cli.trained.play import Play
from jaxrl_vis.config import PRESETS, Config, fields, preset
from jaxrl_vis.config.methods import METHODS, MethodName
from jaxrl_vis.errors import NonFiniteError, StorageError, Terminated
from jaxrl_vis.host import provenance
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run.command import training_options


def one_line(capsys: pytest.CaptureFixture[str], status: int) -> str:
    """Return the report of a wrong request, after checking that it is one line on stderr, with exit status 2."""
    output = capsys.readouterr()
    assert status == 2
    assert output.out == ""
    lines = output.err.splitlines()
    assert len(lines) == 1, output.err
    assert lines[0].startswith("jaxrl-vis: ")
    return lines[0]


ROOT = Path(__file__).resolve().parents[2]
HELP = [[], ["phenotype"], *(name.split() for name in cli.all_commands())]


@pytest.fixture(scope="module")
def help_outputs() -> list[tuple[list[str], str]]:
    """Heavy packages imported after each command of `HELP`, and its output; all run in one process."""
    code = f"""
import contextlib, io, json, sys
from jaxrl_vis import cli
found = []
for command in {HELP!r}:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            cli.main([*command, "--help"])
        except SystemExit as stop:
            assert stop.code in (0, None)
    found.append((sorted({{"jax", "jaxlib", "flax", "mujoco", "numpy", "matplotlib"}} & set(sys.modules)), printed.getvalue()))
print(json.dumps(found))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "envs")))}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("index", range(len(HELP)), ids=lambda index: " ".join(HELP[index]) or "jaxrl-vis")
def test_help_imports_nothing_heavy(index: int, help_outputs: list[tuple[list[str], str]]) -> None:
    heavy, printed = help_outputs[index]
    assert not heavy
    assert "usage: jaxrl-vis" in printed


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    assert "--version   show the version" in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == jaxrl_vis.__version__


@pytest.mark.parametrize(
    ("tokens", "parts"),
    [
        (["trian"], ["unknown command 'trian'", "did you mean train"]),
        ([], ["no command given", "train, eval, play"]),
        (["train", "--methd", "oracle"], ["unknown option --methd", "--method"]),
        (["train", "--zzzzqqqq", "1"], ["unknown option --zzzzqqqq", "train --help"]),
        (["train", "--method", "orakel"], ["--method cannot be 'orakel'", "did you mean oracle"]),
        (["train", "--method=orakel"], ["--method cannot be 'orakel'", "did you mean oracle"]),
        (["train", "--compute-dtype", "int3"], ["--compute-dtype cannot be 'int3'", "float32"]),
        (["train", "--preset", "fasst"], ["unknown preset 'fasst'", "did you mean fast"]),
        (["train", "VisualFetchRach", "--preset", "debug"], ["unknown environment 'VisualFetchRach'", "VisualFetchReach"]),
        (["train", "--seed", "one"], ["--seed", "one"]),
        (["train", "VisualFetchReach", "VisualReacher"], ["VisualReacher"]),
        (["train", "--resume", "--overwrite", "--run-dir", "x"], ["--resume and --overwrite"]),
        (["eval", "no/such/run"], ["no/such/run is not a run folder"]),
        (["eval"], ["RUN"]),
        (["play", "no/such/run"], ["no/such/run is not a run folder"]),
        (["train", "--image-size", "0", "--preset", "debug"], ["image_size", "at least 1"]),
        (["train", "--image-size", "2", "--preset", "debug", "--run-dir", "x"], ["image_size 2", "encoder"]),
        (["bench", "rendr"], ["unknown benchmark 'rendr'", "render"]),
        (["bench"], ["render", "train"]),
        (["bench", "physics", "--scene", "finger"], ["bench render"]),
        (["bench", "render", "--peer", "warp"], ["unknown option --peer"]),
        (["bench", "env", "--seeds", "2"], ["bench update", "bench train"]),
        (["bench", "env", "--batch-size", "8"], ["--batch-size", "bench update", "bench train"]),
        (["bench", "physics", "--envs", "0"], ["--envs", "at least 1"]),
        (["bench", "render", "--env", "FetchReach"], ["--env VisualFetchReach"]),
        (["envs", "--galery", "x.png"], ["unknown option --galery", "--gallery"]),
        (["envs", "--env", "VisualFetchRach"], ["unknown environment 'VisualFetchRach'", "VisualFetchReach"]),
        (["envs", "--goals", "0"], ["--goals", "at least 1"]),
        (["--versio"], ["unknown option '--versio'"]),
        (["train", "--seed"], ["--seed needs a value"]),
        (["train", "--image-size", "8", "--action_noise", "--resume"], ["--action_noise needs a value"]),
        (["train", "--run-dir", "--action-noise", "-0.5"], ["--run-dir needs a value"]),
        (["train", "--action-noise", "nan"], ["--action-noise must be a finite number, not nan"]),
        (["train", "--discount", "inf"], ["--discount must be a finite number, not inf"]),
        (["train", "--image-size", "4.5"], ["--image-size must be a whole number, not '4.5'"]),
        (["train", "--hidden-sizes", "8", "x"], ["--hidden-sizes must be a whole number, not 'x'"]),
        (["train", "--methd", "oracle", "FetchReach"], ["unknown option --methd", "--method"]),
        (["train", "FetchReach", "--preset", "debug", "--hidden-sizes", "0"], ["hidden_sizes", "at least 1"]),
        (["train", "VisualReacher", "--preset", "debug", "--encoder-filters", "0", "8"], ["encoder_filters", "not 0 8"]),
        (["train", "VisualReacher", "--preset", "debug", "--encoder-filters", "-4", "8"], ["encoder_filters", "not -4 8"]),
        (["train", "VisualReacher", "--preset", "debug", "--seed", "99999999999999999999"], ["seed", "too large"]),
        (["train", "--preset", "debug", "--run-dir", __file__], [f"--run-dir {__file__} is a file"]),
        (["train", "--preset", "debug", "--run-dir", "/proc/run"], ["cannot write --run-dir /proc/run"]),
        (["bench", "physics", "--repeats", "0"], ["--repeats", "at least 1"]),
        (["envs", "--env", "FetchReach", "--gallery", "x.png"], ["FetchReach shows no images; VisualFetchReach does"]),
        (["train", "--randomize", "camra"], ["--randomize cannot be 'camra'", "did you mean camera"]),
        (["train", "--randomize", "dynamics", "--randomize-strength", "9", "--preset", "debug"], ["mass", "less than 1"]),
    ],
)
def test_bad_input_gets_one_line_and_exit_2(tokens: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = one_line(capsys, cli.main(tokens))
    for part in parts:
        assert part in line


def test_only_given_options_override_the_preset() -> None:
    tokens = ["--preset", "cpu", "--image-size", "24", "--no-clip-targets-above", "--hidden-sizes", "8", "8"]
    config = training_config(parse(Train, tokens))
    assert config == preset("cpu", image_size=24, clip_targets_above=False, hidden_sizes=(8, 8))
    tokens = ["VisualReacher", "--preset", "paper", "--batch_size=64"]
    assert training_config(parse(Train, tokens)) == PRESETS["paper"].replace(env="VisualReacher", batch_size=64)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_survives_the_command_line(name: str) -> None:
    tokens = ["--preset", name]
    assert training_config(parse(Train, tokens)) == preset(name)


@pytest.mark.parametrize("method", METHODS)
def test_the_command_of_a_configuration_gives_that_configuration(method: MethodName) -> None:
    choices: list[dict[str, Any]] = [{}, {"trivial_goals": 1.0}, {"hidden_sizes": (8, 8), "clip_targets_above": False}]
    for changes in choices:
        config = preset("fast", env="VisualFingerTurn", method=method, **changes)
        assert training_config(parse(Train, training_options(config))) == config


def test_a_task_is_named_by_its_place_or_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    for command, before in ((Train, ["--preset", "debug"]), (Bench, ["env"])):
        for words in (["Reacher"], ["--env", "Reacher"], ["--env=Reacher"], ["Reacher", "--env", "Reacher"]):
            options: Any = parse(command, [*before, *words])
            assert options.env == "Reacher", words
    assert parse(Bench, ["env"]).env == "VisualFetchReach" and parse(Train, []).env is None
    for words in (["Reacher", "FetchReach"], ["--env", "Reacher", "FetchReach"]):
        assert parse(Envs, words).env == ("Reacher", "FetchReach")
    for command in (Eval, Play):
        for words in (["runs/mine"], ["--run-dir", "runs/mine"]):
            assert parse(command, words).run_dir == Path("runs/mine")
    for words in (["train", "Reacher", "--env", "FetchReach"], ["bench", "env", "Reacher", "--env", "FetchReach"]):
        assert "env is given twice, FetchReach by --env and Reacher by position; give it once" in one_line(
            capsys, cli.main(words)
        )
    assert "run_dir is given twice, a by --run-dir and b by position" in one_line(
        capsys, cli.main(["eval", "b", "--run-dir", "a"])
    )
    assert "env is given twice" in one_line(capsys, cli.main(["envs", "Reacher", "--env", "FetchReach", "Reacher"]))


@pytest.mark.parametrize(("accelerator", "preset"), [(False, "cpu"), (True, "fast")])
def test_help_shows_what_auto_takes_here(
    accelerator: bool, preset: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    monkeypatch.setattr(train, "guess_accelerator", lambda: accelerator)
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert f"(default: auto, which is {preset} on this machine; its values are the defaults shown below)" in text
    for name in ("image_size", "num_envs", "batch_size"):
        value = PRESETS[preset].value(name)
        assert re.search(rf"--{name.replace('_', '-')} INT [^(]*\(default: {value}; ", text)


def test_resuming_what_is_not_there_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for words in (["--run-dir", "runs/mine"], ["--preset", "debug"], ["--preset", "debug", "--run-dir", "runs/mine"]):
        line = one_line(capsys, cli.main(["train", "Reacher", "--resume", *words]))
        folder = "runs/mine" if "--run-dir" in words else "runs/Reacher-oracle-debug-seed0"
        assert f"nothing to resume: there is no folder {folder}; leave out --resume to start a run there" in line
    assert not list(tmp_path.iterdir())


def test_examples_of_the_first_page_leave_nothing_untracked(checkout: Path) -> None:
    page = (checkout / "docs" / "start.md").read_text()
    files = re.findall(r"(?:--out|--gallery|--json|--run-dir) ([\w./]+)", page)
    assert {"reach.gif", "tasks.png", "runs/mine"} <= set(files)
    if provenance.is_checkout(checkout):
        for file in files:
            assert provenance.git("check-ignore", f"{file}/x" if file.startswith("runs") else file, folder=checkout), file


def test_the_whole_configuration_is_shown_with_its_sources(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["train", "VisualFetchReach", "--preset", "fast", "--batch-size", "64", "--run-dir", str(tmp_path / "run")]
    assert cli.main([*words, "--show-config"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {line.split()[0]: line.split()[1:] for line in lines if line and not line.startswith("[")}
    assert set(shown) == {field.name for field in fields.describe(Config)}
    assert shown["batch_size"] == ["64", "given"]
    assert shown["num_envs"] == ["25", "preset", "fast,", "for", "VisualFetchReach"]
    assert shown["discount"] == ["None"]
    assert not (tmp_path / "run").exists()


def test_flags_may_contradict_a_preset_both_ways() -> None:
    for name, word, expected in (("paper", "--clip-targets-above", True), ("cpu", "--no-clip-targets-above", False)):
        assert training_config(parse(Train, ["--preset", name, word])).ddpg.clip_targets_above is expected
        assert training_config(parse(Train, ["--preset", name])).ddpg.clip_targets_above is not expected


def test_auto_follows_the_hardware() -> None:
    tokens = ["--seeds", "2"]
    assert training_config(parse(Train, tokens)) == preset("cpu", seeds=2)


def test_resume_starts_from_the_saved_configuration(tmp_path: Path) -> None:
    from jaxrl_vis.run.storage.folder import RunFolder

    saved = PRESETS["debug"].replace(seed=3, latent_size=24, encoder_filters=(4,))
    RunFolder(tmp_path).open(saved)
    tokens = ["--resume", "--run-dir", str(tmp_path), "--env-steps", "1000"]
    assert training_config(parse(Train, tokens)) == saved.replace(env_steps=1000)


def test_a_given_option_counts_even_where_it_repeats_a_default(tmp_path: Path) -> None:
    from jaxrl_vis.run.storage.folder import RunFolder

    saved = PRESETS["debug"].replace(env="VisualReacher", discount=0.5)
    RunFolder(tmp_path).open(saved)
    assert training_config(parse(Train, ["--resume", "--run-dir", str(tmp_path)])) == saved
    tokens = ["VisualFetchReach", "--resume", "--run-dir", str(tmp_path), "--discount", "None"]
    assert training_config(parse(Train, tokens)) == saved.replace(env="VisualFetchReach", discount=None)


def test_help_explains_every_option(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    texts: dict[str, dict[str, str]] = {}
    for name in cli.all_commands():
        with pytest.raises(SystemExit) as stop:
            cli.main([*name.split(), "--help"])
        assert stop.value.code == 0
        lines = "\n".join(line.strip("│| ") for line in capsys.readouterr().out.splitlines())
        texts[name] = dict(re.findall(r"^(--[a-z][a-z-]*)(.*(?:\n(?![-╰]).*)*)", lines, flags=re.MULTILINE))
    for options in texts.values():
        for option, text in options.items():
            assert re.search(r"\w.*[.)]$", text), option
    assert set(texts["train"]) >= {f"--{field.name.replace('_', '-')}" for field in fields.describe(Config)} - {"--env"}
    assert "(default: 32; paper 100, fast 64, debug 16)" in texts["train"]["--image-size"]
    assert "(default: True; paper False)" in texts["train"]["--clip-targets-above"]
    assert "(default: oracle)" in texts["train"]["--method"]


def test_allowed_values_of_bench_are_those_there_are() -> None:
    from jaxrl_vis import bench

    assert get_args(Benchmark) == bench.BENCHMARKS


def test_the_package_runs_as_a_program(clean_environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "jaxrl_vis", "--version"]
    assert subprocess.check_output(command, env=clean_environment, text=True).strip() == jaxrl_vis.__version__


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """A run folder that cannot be read, and paths that cannot be written, by the expected error."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    (tmp_path / "file").write_text("")
    return {"run": run, "is a folder": run, "is a file, not a folder": tmp_path / "file" / "x", "cannot write": Path("/proc/x")}


@pytest.mark.parametrize(
    ("words", "suffix"),
    [
        (["eval", "RUN", "--json"], ".json"),
        (["play", "RUN", "--out"], ".gif"),
        (["play", "RUN", "--html", "--out"], ".html"),
        (["envs", "--env", "VisualReacher", "--gallery"], ".png"),
        (["bench", "physics", "--json"], ".json"),
    ],
    ids=" ".join,
)
def test_outputs_are_checked_before_the_work(
    words: list[str], suffix: str, places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """No command could succeed: the run is empty, and a benchmark or a gallery would take longer than this test allows."""
    run = places.pop("run")
    for wrong, place in places.items():
        path = place.with_suffix(suffix)
        if wrong == "is a folder":
            path.mkdir()
        start = time.perf_counter()
        line = one_line(capsys, cli.main([str(run) if word == "RUN" else word for word in words] + [str(path)]))
        assert wrong in line and str(path) in line
        assert time.perf_counter() - start < 10.0
    assert not list(run.glob("*.*.*")) and not Path("/proc/x").exists()


def test_results_must_be_a_folder_that_can_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for path, wrong in ((tmp_path / "file", "is a file: name a folder"), (Path("/proc/x"), "cannot write")):
        assert wrong in one_line(capsys, cli.main(["bench", "physics", "--results", str(path)]))


def test_the_default_run_folder_is_checked_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("")
    line = one_line(capsys, cli.main(["train", "VisualReacher", "--preset", "debug"]))
    assert "runs/VisualReacher-oracle-debug-seed0" in line and "is a file, not a folder" in line


def test_missing_folders_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from jaxrl_vis.run.trained import restored_run

    (tmp_path / "config.json").write_text("{}")
    monkeypatch.setattr(restored_run, "evaluate_run", lambda *_, **__: {"eval/success": [0.5]})
    path = tmp_path / "new" / "folder" / "figures.json"
    assert cli.main(["eval", str(tmp_path), "--json", str(path)]) == 0
    assert json.loads(path.read_text()) == {"eval/success": [0.5]}
    assert cli.main(["eval", str(tmp_path), "--json", str(path)]) == 0  # a file that exists is replaced
    assert "0.5000" in capsys.readouterr().out


def test_checking_an_output_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("kept")
    for name in ("old", "new", "a/b/c"):
        check_writable(tmp_path / name)
    check_writable(tmp_path / "runs" / "one", folder=True)
    check_writable(Path("/dev/null"))
    assert [path.name for path in tmp_path.iterdir()] == ["old"] and (tmp_path / "old").read_text() == "kept"


def test_a_damaged_run_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{")
    assert "config.json" in one_line(capsys, cli.main(["train", "--resume", "--run-dir", str(tmp_path)]))


def test_play_refuses_an_unknown_kind_of_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{}")
    line = one_line(capsys, cli.main(["play", str(tmp_path), "--out", "video.avi"]))
    assert "video.avi" in line and ".gif" in line


def test_exit_status_of_a_run_that_stops(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from jaxrl_vis.run import trainer

    class Stopping:
        def __init__(self, error: BaseException) -> None:
            self.error = error

        def run(self):
            raise self.error
            yield

    for make_error, status in (
        (lambda: NonFiniteError("loss is NaN at iteration 3"), 4),
        (lambda: StorageError("cannot write to runs/x: make room"), 1),
        (lambda: KeyboardInterrupt(), 130),
        (lambda: Terminated(), 143),
    ):
        monkeypatch.setattr(trainer, "make_trainer", lambda *_, make_error=make_error, **__: Stopping(make_error()))
        assert cli.main(["train", "--preset", "debug"]) == status
    assert capsys.readouterr().err.splitlines() == [
        "jaxrl-vis: loss is NaN at iteration 3",
        "jaxrl-vis: cannot write to runs/x: make room",
    ]


def test_doctor_finds_nothing_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "FAIL" not in output
    assert "all is well" in output


def test_doctor_reports_what_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from jaxrl_vis.host import doctor

    def broken() -> str:
        raise RuntimeError("no device\nat all")

    monkeypatch.setattr(doctor, "CHECKS", (("versions", doctor.versions), ("devices", broken)))
    assert doctor.main() == 1
    output = capsys.readouterr().out
    assert "FAIL  devices        RuntimeError: no device at all" in output
    assert "ok    versions" in output


def test_a_reader_that_closes_its_pipe_is_not_an_error() -> None:
    command = [sys.executable, "-m", "jaxrl_vis", "train", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None and program.stderr is not None
        program.stdout.close()
        assert program.stderr.read() == ""
        assert program.wait() == 141


@pytest.mark.skipif(sys.platform != "linux", reason="counts page faults of a thread")
def test_calls_of_a_command_map_no_memory_at_any_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the end of a chunk of Python's frames, each of a thousand calls would map one; a thread has its own chunks."""
    import resource

    counts: list[int] = []

    def count_faults(depth: int) -> int:
        if depth:
            return count_faults(depth - 1)
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        for _ in range(1000):
            sum(map(abs, (1,)))
            str.join(",", (letter for letter in "ab"))
        return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before

    def command() -> int:
        counts.extend(count_faults(depth) for depth in range(300))
        return 0

    monkeypatch.setattr(cli, "_parse_command", lambda argv: command)
    thread = threading.Thread(target=cli.main, args=([],))
    thread.start()
    thread.join()
    assert len(counts) == 300 and max(counts) < 500
