"""Smoke test of the installation: a new user's commands on an unprepared machine.

    python benchmarks/install_smoke_test.py [--python python3.12 python3.13] [--methods wheel clone notebooks] [--full]

wheel      build a wheel, install it with pip, run every command, train a custom task, and try invalid commands
clone      clone the repository, `make train`, then the commands of docs/start.md; no untracked files may remain
notebooks  Jupyter without this project, and the notebooks in a separate folder: they must stop without a repository address or
           with one that cannot be cloned, and run with that of a clone

Each has an empty home folder, virtual environment and caches of its own; packages come from the registry that pip is configured
for. Settings are tiny (the robots learn nothing), except for notebooks with ``--full``. Each command is printed with its exit
status and its time. Exits with 1 if an exit status is unexpected, an invalid command is answered with more than one line, or an
expected output is missing. Takes about ten minutes per Python version on two idle cores.
"""

import argparse
import dataclasses
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ("01_quickstart", "02_new_environment")
TINY = "--preset debug --env-steps 400"
# Parts of names of inherited variables, which configure the access to registries; all others are dropped.
_KEPT_VARIABLE_PARTS = ("PIP_", "UV_", "SSL", "CA_BUNDLE", "PROXY")
_SHOWN_LINES = 4  # lines of a command's output that are shown


@dataclasses.dataclass
class Shell:
    """Shell of a new user.

    Attributes:
        folder: The current folder.
        environment: Environment variables.
        failures: Unexpected results, one line each.
    """

    folder: Path
    environment: dict[str, str]
    failures: list[str] = dataclasses.field(default_factory=list)

    def run(self, command: str, status: int = 0, shows: str = "", **variables: str) -> str:
        """Run a command line, print the result, and return its output.

        Args:
            command: The command line.
            status: Expected exit status; with 2, the output must be one line.
            shows: Text that the output must contain.
            **variables: Additional environment variables.
        """
        prefix = "".join(f"{name}={shlex.quote(value)} " for name, value in variables.items())
        print(f"$ {prefix}{command}", flush=True)
        start = time.perf_counter()
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self.folder,
            env=self.environment | variables,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        output = done.stdout + done.stderr
        problems = [] if done.returncode == status else [f"exit status {done.returncode}, not {status}"]
        if status == 2 and len(output.splitlines()) != 1:
            problems.append(f"{len(output.splitlines())} lines, not one")
        if shows not in output:
            problems.append(f"{shows!r} is missing")
        lines = output.splitlines()
        for line in lines if problems else lines[-_SHOWN_LINES:]:
            print(f"    {line[:200]}")
        verdict = "; ".join(["NOT AS EXPECTED", *problems]) if problems else "as expected"
        print(f"  exit status {done.returncode}, {time.perf_counter() - start:.1f} s: {verdict}", flush=True)
        if problems:
            self.failures.append(f"{prefix}{command}: {'; '.join(problems)}")
        return output

    def activate(self, environment: Path) -> None:
        """Activate the virtual environment, as ``source .venv/bin/activate`` does."""
        self.environment["PATH"] = f"{environment / 'bin'}{os.pathsep}{self.environment['PATH']}"
        self.environment["VIRTUAL_ENV"] = str(environment)


def new_shell(folder: Path, python: Path) -> Shell:
    """Create a shell in the new folder ``folder``/work, with ``python`` as python3 and an empty home folder."""
    (folder / "home").mkdir(parents=True)
    (folder / "work").mkdir()
    (folder / "bin").mkdir()
    for name in ("python3", python.name):
        if not (folder / "bin" / name).exists():
            (folder / "bin" / name).symlink_to(python)
    inherited = {
        name: value for name, value in os.environ.items() if any(part in name.upper() for part in _KEPT_VARIABLE_PARTS)
    }
    return Shell(
        folder / "work",
        {
            **inherited,
            "HOME": str(folder / "home"),
            "PATH": os.pathsep.join([str(folder / "bin"), "/usr/local/bin", "/usr/bin", "/bin"]),
            "LANG": "C.UTF-8",
            "PIP_NO_CACHE_DIR": "1",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        },
    )


def puck_push() -> str:
    """Return the source of the task that notebook 02 writes."""
    cells = json.loads((CHECKOUT / "notebooks/02_new_environment.ipynb").read_text())["cells"]
    (source,) = (text for cell in cells if (text := "".join(cell["source"])).startswith("%%writefile puck_push.py\n"))
    return source.partition("\n")[2]


def mistakes() -> list[tuple[str, Mapping[str, str]]]:
    """Return invalid command lines, each with additional environment variables; all must fail with one line and status 2."""
    train = "jaxrl-vis train"
    lines = [
        "jaxrl-vis",
        "jaxrl-vis trian",
        f"{train} VisualReachr",
        f"{train} VisualReacher --presett debug",
        f"{train} VisualReacher --preset tiny",
        f"{train} VisualReacher --num-envs 0",
        f"{train} VisualReacher --env-steps many",
        f"{train} VisualReacher --seed -1",
        f"{train} no_such_file:Task",
        f"{train} puck_push:PuckPull",
        f"{train} puck_push.py",
        f"{train} VisualReacher {TINY} --run-dir runs/tiny",
        f"{train} VisualReacher {TINY} --run-dir runs/missing --resume",
        f"{train} VisualReacher {TINY} --run-dir runs/tiny --resume --overwrite",
        "jaxrl-vis eval runs/missing",
        "jaxrl-vis eval runs/tiny --episodes 0",
        "jaxrl-vis play runs/tiny --out tiny.avi",
        "jaxrl-vis envs --gallery",
        "jaxrl-vis bench nothing",
    ]
    without_gpu = [(f"{train} VisualReacher {TINY}", {"JAX_PLATFORMS": "cuda"})] if shutil.which("nvidia-smi") is None else []
    return [*((line, {}) for line in lines), *without_gpu]


def check_wheel(shell: Shell, python: Path) -> None:
    """Test the installation of a wheel with pip, and the program's commands; failures are added to ``shell.failures``.

    Args:
        shell: Shell of a new user.
        python: Interpreter of the virtual environment.
    """
    shell.run(f"git clone --quiet {CHECKOUT} source")
    shell.run(f"{python.name} -m venv .venv")
    shell.activate(shell.folder / ".venv")
    shell.run("pip wheel --quiet --no-deps --wheel-dir dist ./source")
    shell.run('pip install --quiet "$(ls dist/*.whl)[video]"')
    shutil.rmtree(shell.folder / "source")  # leave nothing but the wheel
    shell.run("pip check")
    shell.run("jaxrl-vis --version", shows="0.")
    shell.run("python -m jaxrl_vis --version", shows="0.")
    shell.run("jaxrl-vis --help", shows="train")
    shell.run("jaxrl-vis train --help", shows="--env-steps")
    shell.run("jaxrl-vis doctor", shows="all is well")
    shell.run("jaxrl-vis envs", shows="VisualFetchReach")
    shell.run("jaxrl-vis envs --gallery tasks.png && test -s tasks.png")
    shell.run(f"jaxrl-vis train VisualReacher {TINY} --run-dir runs/tiny && ls runs/tiny", shows="video.gif")
    shell.run("jaxrl-vis eval runs/tiny", shows="eval/success")
    for suffix in ("gif", "mp4"):
        shell.run(f"jaxrl-vis play runs/tiny --out tiny.{suffix} && test -s tiny.{suffix}")
    shell.run("jaxrl-vis play runs/tiny --html && test -s runs/tiny/play.html")
    shell.run("jaxrl-vis train --run-dir runs/tiny --resume")
    load = "import jaxrl_vis; print(jaxrl_vis.load_policy('runs/tiny'))"
    shell.run(f"python -c {shlex.quote(load)}")
    (shell.folder / "puck_push.py").write_text(puck_push())
    shell.run(f"jaxrl-vis train puck_push:PuckPush {TINY} --run-dir runs/puck", shows="puck_push:PuckPush")
    (shell.folder / "elsewhere").mkdir()
    shell.run("cd elsewhere && jaxrl-vis eval ../runs/puck", shows="eval/success")
    shell.run("cd elsewhere && jaxrl-vis play ../runs/puck --out puck.gif && test -s puck.gif")
    for line, variables in mistakes():
        shell.run(line, status=2, **variables)


def first_commands() -> list[str]:
    """Return the program's commands in docs/start.md, without comments."""
    lines = [line.partition(" # ")[0].strip() for line in (CHECKOUT / "docs" / "start.md").read_text().splitlines()]
    return [line for line in lines if line.startswith("jaxrl-vis ")]


def tiny(line: str) -> str:
    """Return a command of docs/start.md with tiny settings and without its preset."""
    words = shlex.split(line)
    if words[1] == "train" and "--resume" not in words:
        for option in {"--preset", "--env-steps"}.intersection(words):
            at = words.index(option)
            del words[at : at + 2]
        words += shlex.split(TINY)
    if words[1] == "bench":
        words += shlex.split("--envs 8 --image-size 16 --repeats 1")
    return shlex.join(words)


def check_clone(shell: Shell, python: Path) -> None:
    """Test the installation of a clone with make, and the commands of docs/start.md; failures are added to ``shell.failures``.

    Args:
        shell: Shell of a new user.
        python: Interpreter of the virtual environment.
    """
    shell.run(f"git clone --quiet {CHECKOUT} jaxrl-vis")
    shell.folder /= "jaxrl-vis"
    shell.run("make help", shows="make train")
    tiny_run = f"PRESET=debug RUN_DIR=runs/first PYTHON={python}"
    shell.run(f"make train {tiny_run} ARGS='--env-steps 400' && ls runs/first", shows="video.gif")
    shell.run(".venv/bin/python --version", shows=f"Python {python.name.removeprefix('python')}")
    shell.activate(shell.folder / ".venv")
    # Extras that the page names next to the commands that need them.
    shell.run(".uv/bin/uv pip install --quiet '.[tensorboard,wandb]'")
    for line in first_commands():
        shell.run(tiny(line))
    untracked = shell.run("git status --porcelain")
    if untracked.strip():
        shell.failures.append(f"left in the checkout: {' '.join(untracked.split())}")


def check_notebooks(shell: Shell, python: Path, full: bool) -> None:
    """Test the notebooks, in a separate folder, in a Jupyter without this project; failures are added to ``shell.failures``.

    Args:
        shell: Shell of a new user.
        python: Interpreter of the virtual environment.
        full: Whether to run them in full length.
    """
    shell.run(f"{python.name} -m venv .venv")
    shell.activate(shell.folder / ".venv")
    shell.run("pip install --quiet nbconvert nbclient ipykernel")
    shell.run(f"git clone --quiet {CHECKOUT} ../address")
    for name in NOTEBOOKS:
        shutil.copy(CHECKOUT / f"notebooks/{name}.ipynb", shell.folder)
    variables = {} if full else {"JAXRL_VIS_NOTEBOOK_FAST": "1"}
    execute = "jupyter nbconvert --execute --to html --ExecutePreprocessor.timeout=7200"
    shell.run(f"{execute} {NOTEBOOKS[0]}.ipynb", status=1, shows="set REPOSITORY in this cell")
    missing = str(shell.folder.parent / "missing")
    shell.run(f"{execute} {NOTEBOOKS[0]}.ipynb", status=1, shows="could not clone", JAXRL_VIS_REPOSITORY=missing)
    for name in NOTEBOOKS:
        shell.run(f"{execute} {name}.ipynb", JAXRL_VIS_REPOSITORY=f"file://{shell.folder.parent / 'address'}", **variables)
        text = (shell.folder / f"{name}.html").read_text()
        for line in text.splitlines():
            if "goals reached" in line and "%" in line and "print" not in line:
                print(f"    {name}: {line.strip()}")
    shell.run("ls")


def main(arguments: list[str] | None = None) -> int:
    """Print the transcript; return 1 if anything was unexpected, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="+", default=["python3.12", "python3.13"], help="names or paths of interpreters")
    parser.add_argument(
        "--methods", nargs="+", choices=("wheel", "clone", "notebooks"), default=["wheel", "clone", "notebooks"]
    )
    parser.add_argument("--full", action="store_true", help="notebooks train to the end")
    parser.add_argument(
        "--folder", type=Path, help="where to work, and keep what comes of it; default: a folder that is removed"
    )
    options = parser.parse_args(arguments)
    interpreters = {name: shutil.which(name) for name in options.python}
    for name, path in interpreters.items():
        if path is None:
            parser.error(f"there is no {name} on this machine")
    top = Path(tempfile.mkdtemp(prefix="stranger-")) if options.folder is None else options.folder.resolve()
    failures = []
    for path in interpreters.values():
        for method in options.methods:
            python = Path(str(path)).resolve()
            print(f"\n== {method}, {python.name} ==", flush=True)
            shell = new_shell(top / f"{method}-{python.name}", python)
            if method == "wheel":
                check_wheel(shell, python)
            elif method == "clone":
                check_clone(shell, python)
            else:
                check_notebooks(shell, python, options.full)
            failures += [f"{method}, {python.name}: {failure}" for failure in shell.failures]
    print(f"\n{len(failures)} commands were not as expected" if failures else "\nall as expected")
    for failure in failures:
        print(f"  {failure}")
    if options.folder is None:
        shutil.rmtree(top)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
