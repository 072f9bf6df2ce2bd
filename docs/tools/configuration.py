"""Writes the tables of docs/configuration.md from `jaxrl_vis.config`; a test fails where the page is not what this writes.

python docs/tools/configuration.py
"""

import dataclasses
import inspect
import re
from pathlib import Path

from jaxrl_vis import fields
from jaxrl_vis.cli.parsing import _describe_fields
from jaxrl_vis.config import OF_IMAGES, OF_ORACLE, OF_TASK, PRESETS, Config
from jaxrl_vis.run.storage.folder import MAY_CHANGE

PAGE = Path(__file__).resolve().parents[1] / "configuration.md"
BEGIN, END = "<!-- fields: begin -->\n", "<!-- fields: end -->\n"
LAST = "<!-- tasks: end -->"


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "none"
    return f"{value:,}" if type(value) is int and value >= 10_000 else str(value)


def _default(name: str) -> str:
    """What ``fast`` says, and after it the presets that say something else."""
    values = {preset: getattr(config, name) for preset, config in PRESETS.items()}
    others = [f"{preset}: {_shown(value)}" for preset, value in values.items() if value not in (values["fast"], preset)]
    return "<br>".join([f"**{_shown(values['fast'])}**", *others])


def _groups() -> dict[str, str]:
    """Field -> the comment that heads its group in the source."""
    group, found = "What to train", {}
    for line in inspect.getsource(Config).splitlines():
        if head := re.fullmatch(r"    # -- (.*)", line):
            group = head[1]
        elif field := re.match(r"    (\w+): .* = ", line):
            found[field[1]] = group
    return found


def table() -> str:
    """All fields, group by group."""
    groups, lines, last = _groups(), [], ""
    for field, hint, _, text in _describe_fields(Config):
        if groups[field.name] != last:
            last = groups[field.name]
            lines += ["", f"## {last}", "", "| field | default | meaning |", "|---|---|---|"]
        allowed = fields.choices(hint)
        choices = f" One of {', '.join(f'`{choice}`' for choice in allowed)}." if allowed else ""
        mark = " ↻" if field.name in MAY_CHANGE else ""
        lines.append(f"| `{field.name}`{mark} | {_default(field.name)} | {text}{choices} |".replace("  ", " "))
    assert set(groups) == {field.name for field in dataclasses.fields(Config)}
    return "\n".join([*lines[1:], ""])


def of_tasks() -> str:
    """What presets have otherwise for some tasks."""
    of_images, of_oracle = (", ".join(f"`{name}`" for name in names) for names in (OF_IMAGES, OF_ORACLE))
    lines = [
        "## What presets have otherwise for some tasks",
        "",
        f"Where a task shows images, and they are not compared to give rewards (`--method autoencoder`): {of_images}.",
        f"With the oracle's rewards: {of_oracle}. Elsewhere these are what the preset has for other tasks.",
        "",
        "| preset | task | fields |",
        "|---|---|---|",
    ]
    for (preset, task), values in OF_TASK.items():
        fields_of_task = ", ".join(f"`{name}` **{_shown(value)}**" for name, value in values.items())
        lines.append(f"| `{preset}` | {task}, Visual{task} | {fields_of_task} |")
    return "\n".join([*lines, ""])


def page(text: str) -> str:
    """The page with its tables as they are to be."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(LAST)
    return f"{before}{BEGIN}{table()}{END}\n{of_tasks()}{LAST}{after}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
