"""User tasks, by module:Name, and tasks of installed packages, by an entry point."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import jaxrl_vis
import jaxrl_vis_envs
from jaxrl_vis import cli
from jaxrl_vis.config import RESUMABLE, marked, preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.run.storage.folder import default_folder
from jaxrl_vis_envs import registry

TASK = '''
import dataclasses
from point_mass import PointMass, PointMassConfig
from jaxrl_vis_envs import GoalEnv, register
from jaxrl_vis_envs.tasks.mjx_env import register_task

@dataclasses.dataclass(frozen=True)
class MyConfig(PointMassConfig):
    strength: float = 1.0
    mode: dict = dataclasses.field(default_factory=dict)

class MyReach(PointMass):
    def __init__(self, config: MyConfig):
        super().__init__(config)

class Plain(PointMass):
    """Without settings."""
    def __init__(self):
        super().__init__(MyConfig())

class Unfinished(GoalEnv):
    def reset(self, key): ...

class Untyped(PointMass):
    def __init__(self, config):
        super().__init__(config)

class Fails(PointMass):
    def __init__(self, config: MyConfig):
        self.nothing.here

class Silent(PointMass):
    def __init__(self, config: MyConfig):
        super().__init__(config)
        del self.threshold

class OldReset(PointMass):
    def __init__(self, config: MyConfig):
        super().__init__(config)
    def reset(self): ...

register("VisualPush", MyReach, MyConfig, state_variant="Push")
helper = 3
'''


@pytest.fixture
def my_task(here: Path) -> str:
    (here / "my_task.py").write_text(TASK)
    return "my_task:MyReach"


@pytest.fixture
def package(tmp_path: Path, here: Path) -> Callable[..., None]:
    """Function that installs packages with entry points as `pip install` does, in a folder on Python's path."""
    site = tmp_path / "site-packages"
    site.mkdir()
    sys.path.append(str(site))

    def install(name: str, source: str | None, **points: str) -> None:
        if source is not None:
            (site / f"{name}.py").write_text(source)
        information = site / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = "\n".join(f"{point} = {value}" for point, value in points.items())
        (information / "entry_points.txt").write_text(f"[jaxrl_vis.environments]\n{lines}\n")

    return install


def test_a_class_in_the_current_folder_is_a_task(my_task: str) -> None:
    env = jaxrl_vis_envs.make(my_task, image_size=12, strength=2.0)
    assert env.name == my_task and env.observation_spec.shape == (4, 12, 12) and env.config.strength == 2.0
    assert registry.has_images(my_task) and registry.state_variant(my_task) is None
    with pytest.raises(jaxrl_vis_envs.UnknownOverrideError, match="my_task:MyReach has no option 'strenght'; did you mean"):
        jaxrl_vis_envs.make(my_task, strenght=2.0)
    assert jaxrl_vis_envs.make("my_task:Plain").horizon == 5
    assert my_task not in jaxrl_vis_envs.list_envs()


def test_what_a_module_registers_is_known_by_that_name_too(my_task: str) -> None:
    assert jaxrl_vis_envs.make("my_task:VisualPush").name == "my_task:VisualPush"
    assert registry.state_variant("my_task:VisualPush") == "my_task:Push"
    assert "VisualPush" in jaxrl_vis_envs.list_envs()  # from now on in this process, without the module's name as well


def test_a_registered_task_has_both_variants(here: Path) -> None:
    (here / "pair.py").write_text(
        TASK + "class Slide(PointMass):\n"
        "    def __init__(self, config: MyConfig, observer=None):\n"
        "        super().__init__(config)\n"
        "@dataclasses.dataclass(frozen=True)\n"
        "class StateConfig:\n"
        "    horizon: int = 5\n"
        "    threshold: float = 0.1\n"
        'register_task(Slide, StateConfig, MyConfig)\n'
    )  # fmt: skip
    assert registry.state_variant("pair:VisualSlide") == "pair:Slide"
    assert registry.visual_variant("pair:Slide") == "pair:VisualSlide"
    assert registry.visual_variant("pair:VisualPush") == "pair:VisualPush"


def test_modules_in_packages_and_what_they_import(here: Path) -> None:
    (here / "robots").mkdir()
    (here / "robots" / "arms.py").write_text("from robots.common import Base\nclass Arm(Base):\n    pass\n")
    (here / "robots" / "common.py").write_text(TASK + "Base = Plain\n")
    assert jaxrl_vis_envs.make("robots.arms:Arm").horizon == 5
    assert registry.load("robots.arms:Arm") == str(here)


def test_a_built_in_name_cannot_be_taken(here: Path) -> None:
    (here / "thief.py").write_text(TASK.replace('"VisualPush"', '"VisualReacher"'))
    with pytest.raises(jaxrl_vis_envs.TaskModuleError, match="'VisualReacher' exists already"):
        jaxrl_vis_envs.make("thief:MyReach")


WRONG = (
    ("my_task:MyRech", "my_task has no MyRech; did you mean MyReach?"),
    ("my_task:helper", "my_task:helper is not an environment but of type int"),
    ("my_task:MyConfig", "my_task:MyConfig is not an environment but a class: it must be a subclass of jaxrl_vis_envs.GoalEnv"),
    ("my_task:Unfinished", "my_task:Unfinished is not complete: it must define advance, observe"),
    ("my_task:Untyped", "the settings of my_task:Untyped are unknown: annotate 'config'"),
    ("my_taks:MyReach", "there is no module my_taks, in "),
    ("my_taks:MyReach", "did you mean my_task?"),
    ("my_task.py:MyReach", "names a file, not a module: write my_task:MyReach"),
    ("../my_task:MyReach", "names a file, not a module: write my_task:MyReach"),
    ("sub/my_task.py:MyReach", "write sub.my_task:MyReach"),
    ("my_task.MyReach", "unknown environment 'my_task.MyReach'; a task of your own is written module:Name"),
    ("my_task:", "is not a task: a task of your own is written module:Name"),
    ("a:b:c", "is not a task"),
    ("types:MyReach", "types has no MyReach"),
    ("needs:X", "No module named 'nothing_like_it' (needs.py, line 2); install nothing_like_it"),
    ("divides:X", "divides cannot be imported: ZeroDivisionError: division by zero (divides.py, line 1)"),
    ("unfinished:X", "unfinished cannot be imported: SyntaxError"),
    ("leaves:X", "leaves cannot be imported: SystemExit: 3"),
)  # fmt: skip


@pytest.mark.parametrize(("name", "complaint"), WRONG)
@pytest.mark.parametrize("words", [["train"], ["envs", "--env"], ["bench", "env"]], ids=" ".join)
def test_wrong_names_get_one_line(
    words: list[str], name: str, complaint: str, my_task: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module, text in {
        "needs": "\nimport nothing_like_it",
        "divides": "1 / 0",
        "unfinished": "def f(:",
        "leaves": "import sys\nsys.exit(3)",
    }.items():
        (here / f"{module}.py").write_text(text)
    before = list(sys.path)
    assert cli.main([*words, name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    if complaint.startswith(("needs", "divides", "leaves", "unfinished")):
        assert sys.path == before
    for make in (jaxrl_vis_envs.make, lambda name: make_env(preset("debug", env=name))):
        with pytest.raises(ValueError) as refused:
            make(name)
        assert complaint in str(refused.value)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("my_task:Fails", "my_task:Fails cannot be built: AttributeError: 'Fails' object has no attribute 'nothing'"),
        ("my_task:Silent", "my_task:Silent has no threshold: every environment must define horizon, action_size"),
        ("my_task:OldReset", "my_task:OldReset: reset must take (key), not ()"),
    ],
)
def test_environments_that_cannot_be_built_raise_one_line(
    name: str, complaint: str, my_task: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["train", name, "--preset", "debug"], ["envs", name], ["bench", "env", name]):
        assert cli.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert complaint in line


def test_options_reach_a_custom_task(my_task: str) -> None:
    config = preset("debug", env=my_task, env_options=("strength=2.5",))
    assert make_env(config).config.strength == 2.5
    for option, complaint in (("strenght=2", "did you mean strength"), ("mode=x", "mode cannot be set")):
        with pytest.raises(RequestError, match=complaint):
            make_env(config.replace(env_options=(option,)))


def test_a_run_is_found_again_from_another_folder(
    my_task: str, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run trained in one folder is evaluated and played from another; without the task's file, one line says so."""
    tiny = ["--preset", "debug", "--image-size", "8", "--encoder-filters", "4", "--env-steps", "40", "--eval-episodes", "2"]
    assert cli.main(["train", "--env", my_task, *tiny]) == 0
    run = (here / "runs" / "my_task-MyReach-oracle-debug-seed0").resolve()
    saved = json.loads((run / "config.json").read_text())["config"]["environment"]
    assert saved["env"] == my_task and saved["env_folder"] == str(here)

    def forget() -> None:
        for name in ("my_task",):
            sys.modules.pop(name, None)
        sys.path[:] = [folder for folder in sys.path if folder != str(here)]
        registry._ENTRIES.pop("VisualPush", None)

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    forget()
    assert cli.main(["eval", str(run)]) == 0
    assert "eval/success" in capsys.readouterr().out
    assert cli.main(["play", "--run-dir", str(run), "--out", "reach.gif", "--episodes", "2"]) == 0
    assert (elsewhere / "reach.gif").exists()
    capsys.readouterr()

    (here / "my_task.py").rename(tmp_path / "my_task.py")
    forget()
    assert cli.main(["eval", str(run)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"my_task was imported from {here}, which no longer contains it" in line
    assert "run this in the folder that does" in line
    monkeypatch.chdir(tmp_path)
    resumed = jaxrl_vis.make_trainer(preset("debug", env=my_task, env_folder=str(here)))
    assert resumed.config.environment.env_folder == str(tmp_path)  # where it lies now


def test_another_loaded_module_of_that_name_is_an_error(my_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jaxrl_vis_envs.make(my_task)
    (tmp_path / "my_task.py").write_text(TASK)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(jaxrl_vis_envs.TaskModuleError, match="has loaded another my_task already.*start a new process"):
        jaxrl_vis_envs.make(my_task)


def test_names_of_run_folders_suit_every_system() -> None:
    assert ":" not in str(default_folder(preset("cpu", env="robots.arms:Arm")))
    assert default_folder(preset("cpu", env="robots.arms:Arm")).name == "robots.arms-Arm-oracle-cpu-seed0"


def test_installed_packages_offer_tasks(package: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    package("roboworks", TASK, RoboReach="roboworks:MyReach", RoboPush="roboworks:VisualPush", Reacher="roboworks:MyReach")
    assert {"RoboReach", "RoboPush"} <= set(jaxrl_vis_envs.list_envs())
    assert "roboworks" not in sys.modules  # listing imports nothing
    env = jaxrl_vis_envs.make("RoboReach", image_size=12)
    assert env.name == "RoboReach" and env.observation_spec.shape == (4, 12, 12)
    assert registry.load("RoboReach") is None and registry.load("roboworks:MyReach") is None  # nothing to remember
    assert type(jaxrl_vis_envs.make("Reacher")).__module__ == "jaxrl_vis_envs.tasks.reacher"
    assert make_env(preset("debug", env="RoboPush")).horizon == 5
    assert cli.main(["train", "RoboRech", "--preset", "debug"]) == 2
    assert "did you mean RoboReach" in capsys.readouterr().err


def test_broken_packages_do_not_break_the_list(package: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    package("goodworks", TASK, GoodReach="goodworks:MyReach")
    package("badworks", "raise RuntimeError('out of\\norder')", BadReach="badworks:MyReach", WorseReach="nowhere:MyReach")
    package("samename", TASK.replace("VisualPush", "Other"), Twice="samename:MyReach")
    package("samename2", None, Twice="goodworks:MyReach")
    assert cli.main(["envs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("GoodReach" in line and "4x8x8" in line for line in lines)
    for name, complaint in (
        ("BadReach", "badworks cannot be imported: RuntimeError: out of order"),
        ("WorseReach", "there is no module nowhere"),
        ("Twice", "several installed packages have a Twice: request goodworks:MyReach or samename:MyReach"),
    ):
        assert any(line.startswith(f"{name} cannot be used: ") and complaint in line for line in lines), name
        assert cli.main(["train", name, "--preset", "debug"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert complaint in line


def test_custom_task_in_the_gallery(my_task: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["envs", my_task, "--gallery", "tasks.png", "--image-size", "16", "--goals", "1"]) == 0
    assert (here / "tasks.png").exists() and my_task in capsys.readouterr().out


def test_records_of_custom_tasks_depend_on_no_package_file() -> None:
    from benchmarks.ledger import staleness
    from jaxrl_vis.host.provenance import CHECKOUT

    files = [file.name for file in staleness.measured_files("env/steps", "gone:Reach", True, CHECKOUT)]
    assert "env.py" in files and "reacher.py" not in files


def test_the_saved_folder_may_change_on_resume() -> None:
    assert "env_folder" in marked(RESUMABLE)
