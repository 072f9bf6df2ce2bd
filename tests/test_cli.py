import subprocess
import sys
import time
from pathlib import Path

import pytest

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.config import PRESETS


def one_line(capsys: pytest.CaptureFixture[str], status: int) -> str:
    """What a wrong request was told: exactly one line, on stderr, with exit status 2."""
    output = capsys.readouterr()
    assert status == 2
    assert output.out == ""
    lines = output.err.splitlines()
    assert len(lines) == 1, output.err
    assert lines[0].startswith("jaxrl-vis: ")
    return lines[0]


@pytest.mark.parametrize("command", [[], *([name] for name in cli.COMMANDS)])
def test_help_is_quick_and_imports_no_jax(command: list[str], clean_environment: dict[str, str]) -> None:
    code = f"""
import sys
from jaxrl_vis import cli
try:
    cli.main({[*command, "--help"]!r})
except SystemExit as stop:
    assert stop.code in (0, None)
heavy = {{"jax", "jaxlib", "flax", "mujoco", "numpy", "matplotlib"}} & set(sys.modules)
assert not heavy, heavy
"""
    seconds = []
    for _ in range(2):  # the first may write byte code
        start = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code], env=clean_environment, capture_output=True, text=True)
        seconds.append(time.perf_counter() - start)
        assert done.returncode == 0, done.stderr
    assert "usage: jaxrl-vis" in done.stdout
    print(f"help {' '.join(command)}: {min(seconds):.2f} s")
    assert min(seconds) < 3.0  # 0.3 s on an idle machine; tests share theirs


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
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
        (["bench", "physics", "--peer", "mujoco"], ["bench render"]),
        (["bench", "render", "--peer", "playground"], ["bench physics"]),
        (["bench", "physics", "--peer", "playground"], ["--env FingerTurn"]),
        (["bench", "render", "--peer", "mujocco"], ["--peer cannot be 'mujocco'", "mujoco"]),
        (["bench", "physics", "--envs", "0"], ["--envs", "at least 1"]),
        (["bench", "render", "--env", "FetchReach"], ["--env VisualFetchReach"]),
        (["envs", "--galery", "x.png"], ["unknown option --galery", "--gallery"]),
        (["envs", "--env", "VisualFetchRach"], ["unknown environment 'VisualFetchRach'", "VisualFetchReach"]),
        (["envs", "--goals", "0"], ["--goals", "at least 1"]),
        (["train", "--randomize", "camra"], ["--randomize cannot be 'camra'", "did you mean camera"]),
        (["train", "--randomize", "dynamics", "--randomize-strength", "9", "--preset", "debug"], ["mass", "less than 1"]),
    ],
)
def test_bad_input_gets_one_line_and_exit_2(tokens: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = one_line(capsys, cli.main(tokens))
    for part in parts:
        assert part in line


def test_only_given_options_override_the_preset() -> None:
    tokens = ["train", "--preset", "cpu", "--image-size", "24", "--no-clip-targets-above", "--hidden-sizes", "8", "8"]
    config = cli.training_config(cli.parse(tokens), tokens)
    assert config == PRESETS["cpu"].replace(image_size=24, clip_targets_above=False, hidden_sizes=(8, 8))
    tokens = ["train", "VisualReacher", "--preset", "paper", "--batch_size=64"]
    assert cli.training_config(cli.parse(tokens), tokens) == PRESETS["paper"].replace(env="VisualReacher", batch_size=64)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_survives_the_command_line(name: str) -> None:
    tokens = ["train", "--preset", name]
    assert cli.training_config(cli.parse(tokens), tokens) == PRESETS[name]


def test_auto_follows_the_hardware() -> None:
    tokens = ["train", "--seeds", "2"]
    assert cli.training_config(cli.parse(tokens), tokens) == PRESETS["cpu"].replace(seeds=2)


def test_resume_starts_from_the_saved_configuration(tmp_path: Path) -> None:
    from jaxrl_vis.run.folder import RunFolder

    saved = PRESETS["debug"].replace(seed=3, latent_size=24, encoder_filters=(4,))
    RunFolder(tmp_path).open(saved)
    tokens = ["train", "--resume", "--run-dir", str(tmp_path), "--env-steps", "1000"]
    assert cli.training_config(cli.parse(tokens), tokens) == saved.replace(env_steps=1000)


def test_a_damaged_run_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{")
    assert "config.json" in one_line(capsys, cli.main(["train", "--resume", "--run-dir", str(tmp_path)]))


def test_play_refuses_an_unknown_kind_of_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{}")
    line = one_line(capsys, cli.main(["play", str(tmp_path), "--out", "video.avi"]))
    assert "video.avi" in line and ".gif" in line


def test_exit_status_of_a_run_that_stops(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    trainer = pytest.importorskip("jaxrl_vis.run.trainer")

    class Stopping:
        def __init__(self, error: BaseException) -> None:
            self.error = error

        def run(self):
            raise self.error
            yield

    for make_error, status in (
        (lambda: trainer.NonFiniteError("loss is NaN at iteration 3"), 4),
        (lambda: KeyboardInterrupt(), 130),
        (lambda: trainer.Terminated(), 143),
    ):
        monkeypatch.setattr(trainer, "make_trainer", lambda *_, make_error=make_error, **__: Stopping(make_error()))
        assert cli.main(["train", "--preset", "debug"]) == status
    assert "iteration 3" in capsys.readouterr().err


def test_flatten_reads_the_parser_s_box() -> None:
    lines = ["╭─ Parsing error ─╮", "│ Value 3 is      │", "│ wrong.          │", "│ ─────────────── │", "│ For help, run x │"]
    box = "\n".join([*lines, "╰─────────────────╯"])
    assert cli.flatten(box) == "Value 3 is wrong."


def test_doctor_finds_nothing_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "FAIL" not in output
    assert "all is well" in output


def test_doctor_reports_what_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from jaxrl_vis import doctor

    def broken() -> str:
        raise RuntimeError("no device\nat all")

    monkeypatch.setattr(doctor, "CHECKS", (("versions", doctor.versions), ("devices", broken)))
    assert doctor.main() == 1
    output = capsys.readouterr().out
    assert "FAIL  devices        RuntimeError: no device at all" in output
    assert "ok    versions" in output
