"""The page about the renderer: its examples run, its images are there."""

import importlib.util
import json
import re
from pathlib import Path

import pytest
import render_models


@pytest.fixture
def page(checkout: Path) -> str:
    return (checkout / "docs" / "renderer.md").read_text()


def test_examples_run_and_print_what_they_say(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    examples = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    exec(compile(examples, "docs/renderer.md", "exec"), {})
    said = re.findall(r"print\(.*\)  # (\([^a-z]*\))$", examples, re.MULTILINE)
    assert len(said) == 3
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in printed if line.startswith("(")] == said
    assert 0.5 < float(printed[-1]) < 1.5


def test_the_table_of_models_is_that_of_the_record(checkout: Path) -> None:
    spec = importlib.util.spec_from_file_location("render_parity", checkout / "benchmarks" / "render_parity.py")
    assert spec is not None and spec.loader is not None
    parity = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(parity)
    rows = json.loads(parity.TARGET.read_text())["rows"]
    assert [row["model"] for row in rows] == list(render_models.MODELS)
    assert not [row["model"] for row in rows if row["failures"]]
    assert parity.PAGE.read_text().endswith(parity.MARK + parity.table(rows)), "run benchmarks/render_parity.py --page"
    assert f" {len(rows)} models " in (checkout / "docs" / "renderer.md").read_text()


def test_images_are_there(page: str, checkout: Path) -> None:
    images = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert len(images) == 5
    for image in images:
        assert (checkout / "docs" / image).read_bytes().startswith(b"\x89PNG")
