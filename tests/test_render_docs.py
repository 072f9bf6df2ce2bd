"""The page about the renderer: its examples run, its images are there."""

import re
from pathlib import Path

import pytest


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


def test_images_are_there(page: str, checkout: Path) -> None:
    images = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert len(images) == 5
    for image in images:
        assert (checkout / "docs" / image).read_bytes().startswith(b"\x89PNG")
