"""Tests of the README and docs/: code runs, commands parse, tables and links are valid, and the site builds."""

import contextlib
import dataclasses
import functools
import html.parser
import importlib
import importlib.util
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import doc_blocks
import pytest
import render_models
import small_program
from doc_blocks import ROOT, Block, blocks, pages_with
from fake_program import make_fake_trainer, small_config

import jaxrl_vis
from benchmarks import render_parity
from jaxrl_vis import cli, config
from jaxrl_vis.cli.checks import check_env
from jaxrl_vis.cli.parsing import parse
from jaxrl_vis.cli.train import Train, training_config
from jaxrl_vis.config import OPTIONS, RESUMABLE, Config, marked, validate
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run import trainer
from jaxrl_vis.run.storage import metrics
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.names import TASKS

DOCS = ROOT / "docs"
# Commands that are executed; those that train, measure or draw for long are parsed and checked.
EXECUTED = {"eval", "envs", "doctor", "--version", "--help"}
# Python blocks are executed with the task that compiles fastest, with small batches, and an environment of Gymnasium's with the
# images of the run that plays on the same page, so that its programs serve both.
SMALLER = {"FetchReach": "Reacher", "4096": "4", "num_envs=64": "num_envs=4"}
SMALLER |= {"image_size=64, render_mode": 'image_size=16, pixels="depth", render_mode'}


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@contextlib.contextmanager
def small_settings() -> Iterator[None]:
    """Train with the smallest preset instead of any other within the context, in one program that is traced once."""
    full_preset = config.preset

    def small_preset(name: str, **overrides: Any) -> Config:
        make_env(validate(full_preset(name, **overrides)))  # what the page asks for must be right
        return full_preset("debug", env="VisualReacher")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "preset", small_preset)
        patch.setattr(trainer, "make_train_step", small_program.make_train_step)
        yield


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder with a trained run, runs/mine; while it is in use, everything is trained with the smallest preset."""
    folder = tmp_path_factory.mktemp("desk")
    with small_settings():
        list(trainer.make_trainer(jaxrl_vis.preset("debug"), folder / "runs" / "mine").run())
        yield folder


@pytest.fixture
def reader(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Current folder of a reader who types a page's code: a copy of the desk; modules and tasks from it are removed after."""
    shutil.copytree(desk, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = set(sys.modules)
    yield tmp_path
    own = {
        name for name in set(sys.modules) - modules if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path))
    }
    for name in own:
        del sys.modules[name]
    for name in [name for name, entry in registry._ENTRIES.items() if entry.config_class.__module__ in own]:
        del registry._ENTRIES[name]


# -- Blocks


def missing(what: str) -> bool:
    """Return True if a requirement in a mark is missing: a module, a name in one, or an option of `train`."""
    if what.startswith("--"):
        return what[2:] not in {*OPTIONS, *(field.name for field in dataclasses.fields(Train))}
    module, _, name = what.rpartition(".")
    try:
        if importlib.util.find_spec(what) is not None:
            return False
    except (ImportError, ValueError):
        pass
    return not module or not hasattr(importlib.import_module(module), name)


@pytest.mark.parametrize("page", doc_blocks.PAGES, ids=page_name)
def test_blocks_have_a_language_and_marks_are_true(page: Path) -> None:
    for block in blocks(page):
        assert block.language in {*doc_blocks.LANGUAGES, ""}, f"{page}:{block.line}"
        if block.language == "toml":
            tomllib.loads(block.text)
        if block.language == "python":
            compile(block.text, f"{page}:{block.line}", "exec")
        if block.mark.startswith("needs "):
            assert missing(block.mark.removeprefix("needs ")), f"{page}:{block.line}: it is there: take the mark away"


def save_file(block: Block) -> bool:
    """Write a block that begins with `# file: name` to that file; return True if it did."""
    file = re.match(r"# file: (\S+)\n", block.text)
    if file:
        Path(file[1]).write_text(block.text)
    return bool(file)


def run_block(page: Path, block: Block, names: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """Execute a block in the namespace ``names``, and check prints against comments (`# (...)`, `# [...]`, `# about 1.0`)."""
    capsys.readouterr()
    if save_file(block):
        return
    text = functools.reduce(lambda text, large: text.replace(large, SMALLER[large]), SMALLER, block.text)
    exec(compile("\n" * block.line + text, str(page), "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    for said in re.findall(r"^print\(.*\)  # ((?:\(|\[|about ).*)$", block.text, re.MULTILINE):
        if said.startswith("about "):
            assert float(printed[-1]) == pytest.approx(float(said.split()[1].rstrip(":;,")), abs=0.5)
        else:
            assert said in printed, f"{page}:{block.line}: {said} is not what it prints: {printed}"


@pytest.mark.parametrize("page", pages_with("python"), ids=page_name)
def test_python_blocks_run(
    page: Path, reader: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ppo = pytest.importorskip("brax.training.agents.ppo.train")
    signature = inspect.signature(ppo.train)
    # Minutes of training are not executed; their arguments must be those of the function.
    monkeypatch.setattr(ppo, "train", lambda *args, **kwargs: (signature.bind(*args, **kwargs), None, {}))
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page):
        if block.language == "python" and not block.mark:
            run_block(page, block, names, capsys)


@pytest.mark.parametrize("page", [ROOT / "README.md", DOCS / "index.md"], ids=page_name)
def test_what_is_typed_first_suits_a_laptop(page: Path) -> None:
    text = next(block.text for block in blocks(page) if "jaxrl_vis.preset(" in block.text)
    call = re.search(r"jaxrl_vis\.preset\(.*?\)", text)
    assert call is not None
    asked = eval(call[0], {"jaxrl_vis": jaxrl_vis})
    program = make_train_step(make_env(asked), asked)
    assert asked.run.seeds * program.replay_bytes < 2**30


def checked_environment(env: str, env_options: tuple[str, ...], randomize: tuple[str, ...]) -> None:
    make_env(Config().replace(env=env, env_options=env_options, randomize=randomize))  # type: ignore[arg-type]


@pytest.mark.parametrize("page", pages_with("sh"), ids=page_name)
def test_shell_blocks_could_be_typed(page: Path, reader: Path) -> None:
    for block in blocks(page):
        save_file(block)
        for words in doc_blocks.commands(block) if block.language == "sh" and not block.mark else ():
            if words[0] != "jaxrl-vis":
                doc_blocks.check_command(words)
                continue
            name, rest = (words[1], words[2:]) if words[1].startswith("-") else cli.split_command(words[1:])
            there = name != "eval" or Path(rest[0]).exists()  # a page may evaluate what it has trained
            if name in EXECUTED and there and "--gallery" not in rest:
                assert cli.main([*name.split(), *rest]) == 0, f"{page}:{block.line}"
            elif "--help" in rest:
                with pytest.raises(SystemExit, match="0"):
                    cli.main([*name.split(), *rest])
            else:
                options = parse(cli.all_commands()[name][0], rest)
                if name == "train":
                    asked = validate(training_config(options))
                    checked_environment(asked.environment.env, asked.environment.env_options, asked.environment.randomize)
                elif name == "bench" and options.env:
                    check_env(options.env)


def test_every_module_and_figure_works_without_runs(tmp_path: Path) -> None:
    code = """
import importlib, pkgutil
import jaxrl_vis
from jaxrl_vis import cli
for module in pkgutil.walk_packages(jaxrl_vis.__path__, "jaxrl_vis."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:  # of an extra
            assert error.name.partition(".")[0] != "jaxrl_vis", error
for figure in ("5.1", "5.4"):  # of no runs: status 3
    assert cli.main(["figure", figure, "--quick", "--draw-only", "--runs", "runs"]) == 3
"""
    (tmp_path / "runs").mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "envs")))}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# -- Tables


def read_keys(page: Path, name: str) -> list[str]:
    """Return the first column of the table between the marks with a name."""
    table = page.read_text().partition(f"<!-- {name}: begin -->")[2].partition(f"<!-- {name}: end -->")[0]
    return re.findall(r"^\| `([^`]+)`", table, re.MULTILINE)


def test_the_table_of_metrics_has_the_keys_that_runs_write(desk: Path, tmp_path: Path) -> None:
    written = {key for row in metrics.read_rows(desk / "runs" / "mine" / "metrics.jsonl") for key in row}
    # A run that goes on without its replay writes one more.
    list(make_fake_trainer(small_config(full_checkpoint_interval=0, env_steps=40), tmp_path / "run").run())
    list(make_fake_trainer(small_config(full_checkpoint_interval=0), tmp_path / "run", resume=True).run())
    later = set(metrics.read_rows(tmp_path / "run" / "metrics.jsonl")[-1])
    said = read_keys(DOCS / "learner.md", "metrics")
    assert len(said) == len(set(said))
    assert set(said) == written | {key for key in later if key.startswith("resume/")}


def load_tool(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, DOCS / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_configuration_page_is_that_of_the_source() -> None:
    tool = load_tool("configuration")
    assert tool.PAGE.read_text() == tool.update_page(tool.PAGE.read_text()), "run python docs/tools/configuration.py"
    assert set(read_keys(tool.PAGE, "fields")) == set(OPTIONS)


def test_runs_page_lists_what_may_change_and_every_exit_status() -> None:
    page = (DOCS / "runs.md").read_text()
    fields = page.partition("These fields may change: ")[2].partition(". ")[0]
    assert set(re.findall(r"`(\w+)`", fields)) == set(marked(RESUMABLE))
    statuses = {int(status) for status in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}
    assert statuses == {0, 1, 3, 130, 143} | set(cli._STATUS.values())


def test_thesis_options_are_fields() -> None:
    page = (DOCS / "learner.md").read_text().partition("## Symbols of the thesis")[2].partition("## What a run logs")[0]
    paper = config.PRESETS["paper"]
    for name, value in re.findall(r"`(\w+)=([^`]+)`", page):
        if name not in ("method", "env_options"):
            assert paper.value(name) == eval(value), name
    for line in page.splitlines():
        if line.startswith("| ") and "(5" in line or "eq. 5" in line:
            options = re.findall(r"`(\w+)`", line.split("|")[3])
            assert set(options) <= set(OPTIONS)


def test_the_table_of_tasks_is_that_of_the_environments() -> None:
    table = (DOCS / "tasks.md").read_text().partition("| task | goal state |")[2].partition("Chance is")[0]
    rows = re.findall(r"^\| (\w+) \|(.*)\|$", table, re.MULTILINE)
    cells = {name: [cell.strip() for cell in rest.split("|")] for name, rest in rows}
    assert set(cells) == set(TASKS)
    for name, (goal, action, horizon, threshold, period, chance, difficulty) in cells.items():
        env = jaxrl_vis.learner.environment.make_env(Config().replace(env=name))
        assert env.chance is not None
        assert goal.endswith(f", {env.goal_state_size}") and int(action.split(":")[0]) == env.action_size
        assert int(horizon) == env.horizon and threshold == f"{env.threshold:g} {env.distance_unit}"
        assert period == f"{1000 * env.control_period:g} ms"
        assert chance == f"{100 * env.chance:.1f} %" and difficulty == f"{env.difficulty:.1f}"


def test_the_table_of_models_is_that_of_the_record(checkout: Path) -> None:
    rows = render_parity.read_rows(render_parity.TARGET)
    assert [row["model"] for row in rows] == list(render_models.MODELS)
    assert not [row["model"] for row in rows if row["failures"]]
    assert f" {len(rows)} models " in (checkout / "docs" / "renderer.md").read_text()


# -- Links and the site


@pytest.mark.parametrize("page", [*doc_blocks.PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"], ids=page_name)
def test_scripts_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    for script in re.findall(r"benchmarks/[\w/]+\.py", text):
        assert (ROOT / script).exists(), script
    for module in re.findall(r"-m (benchmarks[.\w]*\w)", text):
        assert module == "benchmarks.peers.NAME" or importlib.util.find_spec(module) is not None, module


@pytest.mark.parametrize("page", doc_blocks.PAGES, ids=page_name)
def test_links_and_images_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)]+)\)", text):
        file, _, _ = target.partition("#")
        if "://" in file:  # a source that is cited
            continue
        there = page.parent / file
        assert not file or there.exists(), f"{page}: {target}"
        if there.suffix == ".png":
            assert there.read_bytes().startswith(b"\x89PNG")


def test_every_page_is_in_the_menu_and_reached_from_the_readme() -> None:
    menu = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(menu) == sorted(page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md"))
    readme = (ROOT / "README.md").read_text()
    for page in DOCS.glob("*.md"):
        assert (
            page.stem == "index"
            or f"(docs/{page.name})" in readme
            or f"({page.name})" in "".join(other.read_text() for other in DOCS.glob("*.md"))
        )
    for guide in ("start", "tasks", "learner", "configuration", "runs", "extending", "adapters", "renderer", "glossary"):
        assert f"(docs/{guide}.md)" in readme


class Reader(html.parser.HTMLParser):
    """Parser of a page's resources (scripts, styles, images, frames), link targets and anchors."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.anchors |= {named[name] or "" for name in ("id", "name") if name in named}
        if tag == "a":
            self.links.append(named.get("href") or "")
        if tag == "link" and named.get("rel") not in ("prev", "next", "canonical"):
            self.addresses.append(named.get("href") or "")
        if tag in ("script", "img", "iframe", "source", "video", "object"):
            self.addresses += [named[name] or "" for name in ("src", "srcset", "data") if named.get(name)]


def test_the_site_builds_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(site)]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stdout + done.stderr
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(list(DOCS.rglob("*.md")))  # and one for what is not found
    readers = {page: Reader() for page in pages}
    for page, reader in readers.items():
        reader.feed(page.read_text())
    for page, reader in readers.items():
        for link in reader.links:
            file, _, anchor = link.partition("#")
            if anchor and "://" not in link and page.name != "404.html":
                there = (page.parent / file).resolve() if file else page
                assert anchor in {*readers[there].anchors, "__skip"}, f"{page.name} links {link}"
        for address in reader.addresses:
            assert not re.match(r"(https?:)?//", address), f"{page.name} loads {address}"
            if page.name != "404.html" and not address.startswith(("data:", "#")):
                assert (page.parent / address.partition("?")[0]).exists(), f"{page.name} lacks {address}"
    for style in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", style.read_text()), style
    # Search works in a folder without a server: its index and its worker are scripts.
    assert "choose_goal_slots" in (site / "search" / "search_index.js").read_text()
    assert "lunr" in (site / "assets" / "local-iframe-worker.js").read_text()
    for name in ("make_trainer", "preset", "RequestError"):
        assert f'.{name}"' in (site / "api" / "training.html").read_text()


def test_columns_of_the_site_are_wide_enough_to_read() -> None:
    """Regression test: code that may break anywhere, beside cells that may not break, was set with one letter per line."""
    style = (DOCS / "site.css").read_text()
    assert not re.search(r"td[^{]*\{[^}]*nowrap", style)
    assert re.search(r"table:not\(\[class\]\) code \{[^}]*word-break: normal", style)
    assert float(re.search(r"td\.long \{ min-width: ([\d.]+)rem", style)[1]) >= 8  # type: ignore[index]
    fit = load_tool("hooks").fit_cells
    assert fit("<td>short</td><th>x</th>") == "<td>short</td><th>x</th>"
    sentence = "a sentence that takes more than one line of a column, &lt;here&gt;"
    assert (
        fit(f'<td style="text-align: left;">{sentence}</td>') == f'<td style="text-align: left;" class="long">{sentence}</td>'
    )
    assert fit("<td>" + "<br>".join(["a short line"] * 9) + "</td>").startswith("<td>")
    assert fit("<td><code>a_long.name_that(is_longer=than_it)</code> a_b</td>") == (
        "<td><code>a_<wbr>long.<wbr>name_<wbr>that(<wbr>is_<wbr>longer=<wbr>than_<wbr>it)</code> a_b</td>"
    )
    assert fit("<td><code>x --env-steps 1</code></td>") == '<td><code>x <span class="option">--env-steps</span> 1</code></td>'
    assert fit("<td><code>image_size 16</code></td>") == "<td><code>image_size 16</code></td>"


def test_rows_of_wide_tables_have_labels_for_phones() -> None:
    label = load_tool("hooks").label_cells
    head = "<table><thead><tr><th>a</th><th>b &amp; <code>c</code></th><th>d</th></tr></thead>"
    narrow = head + "<tbody><tr><td>1</td><td>2</td><td>3</td></tr></tbody></table>"
    assert label(narrow) == narrow
    wide = label(narrow.replace("<td>2", '<td class="long">2'))
    assert wide.startswith("<table data-cards>") and "<th>a</th>" in wide
    assert '<td data-label="a">1</td><td data-label="b &amp; c" class="long">2</td>' in wide
    assert "[data-cards] td" in (DOCS / "site.css").read_text()


def test_pages_of_the_site_name_files_that_it_does_not_hold() -> None:
    hooks = load_tool("hooks")
    assert (
        hooks.name_files_outside("see [the tests](../tests/x.py) and [a](b.md)") == "see the tests (`tests/x.py`) and [a](b.md)"
    )
    assert hooks.name_files_outside("[benchmarks/results](../benchmarks/results)") == "`benchmarks/results`"
    assert hooks.name_files_outside("![image](../x.png)") == "![image](../x.png)"
    assert hooks.name_files_outside("[a](../b.md) [c](../../d.py)", depth=1) == "[a](../b.md) c (`d.py`)"
