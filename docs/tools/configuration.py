"""Write the tables of docs/configuration.md from `jaxrl_vis.config`; a test fails if the page is out of date.

python docs/tools/configuration.py
"""

import inspect
from pathlib import Path

from jaxrl_vis.cli.parsing import describe_options
from jaxrl_vis.config import PRESETS, RESUMABLE, TASKS, Config, fields

PAGE = Path(__file__).resolve().parents[1] / "configuration.md"
BEGIN, END = "<!-- fields: begin -->\n", "<!-- fields: end -->\n"
LAST = "<!-- tasks: end -->"


def _format_value(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "none"
    return f"{value:,}" if type(value) is int and value >= 10_000 else str(value)


def _format_defaults(name: str) -> str:
    """Format the value of an option in the preset ``fast``, followed by those of presets that differ."""
    values = {preset: config.value(name) for preset, config in PRESETS.items()}
    others = [f"{preset}: {_format_value(value)}" for preset, value in values.items() if value not in (values["fast"], preset)]
    return "<br>".join([f"**{_format_value(values['fast'])}**", *others])


def option_tables() -> str:
    """Return the tables of all options in Markdown, group by group."""
    lines: list[str] = []
    group = ""
    for field, text in describe_options(Config):
        if field.group != group:
            group = field.group
            title = " ".join((inspect.getdoc(field.record) or "").split())
            lines += ["", f"## {group}", "", title, "", "| option | default | meaning |", "|---|---|---|"]
        allowed = fields.choices(field.hint)
        choices = f" One of {', '.join(f'`{choice}`' for choice in allowed)}." if allowed else ""
        mark = " ↻" if RESUMABLE in field.extras else ""
        lines.append(f"| `{field.name}`{mark} | {_format_defaults(field.name)} | {text}{choices} |".replace("  ", " "))
    return "\n".join([*lines[1:], ""])


def task_table() -> str:
    """Return the table of the task-specific values of presets, in Markdown."""
    lines = [
        "## Task-specific values of presets",
        "",
        "`jaxrl-vis train TASK --preset NAME --show-config` prints the complete configuration.",
        "",
        "| preset | task | always | images¹ | oracle² | images¹ and oracle² |",
        "|---|---|---|---|---|---|",
    ]
    for (preset, task), values in TASKS.items():
        cells = (values.always, values.images, values.oracle, values.images_and_oracle)
        shown = (", ".join(f"`{name}` **{_format_value(value)}**" for name, value in cell.items()) for cell in cells)
        lines.append(f"| `{preset}` | {task}, Visual{task} | {' | '.join(shown)} |")
    return "\n".join(
        [
            *lines,
            "",
            "¹ Image observations, unless the method compares images in the latent space of an autoencoder.",
            "² Rewards from the true state (`--method oracle`).",
            "",
        ]
    )


def update_page(text: str) -> str:
    """Return the text of the page with up-to-date tables."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(LAST)
    return f"{before}{BEGIN}{option_tables()}{END}\n{task_table()}{LAST}{after}"


if __name__ == "__main__":
    PAGE.write_text(update_page(PAGE.read_text()))
