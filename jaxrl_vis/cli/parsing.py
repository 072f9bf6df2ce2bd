"""Parsing of a command line into the frozen dataclass of a command.

    words -> tyro: help, or the words of each option -> `fields.read`: values -> the dataclass

For tyro, every option is an optional list of words, so that it never validates a value: errors are reported here in one line,
and missing options are distinguished from given ones.
"""

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import textwrap
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from jaxrl_vis.config import fields
from jaxrl_vis.errors import RequestError, nearest

PROGRAM = "jaxrl-vis"

# Options of brax, Stable-Baselines3, its zoo and CleanRL that users may try -> the equivalent here.
_FOREIGN_OPTIONS = {
    **dict.fromkeys(
        ("--cuda", "--no-cuda", "--device", "--gpu", "--cpu"),
        "JAX takes the accelerator that it finds; the environment variable JAX_PLATFORMS=cpu, cuda or tpu chooses",
    ),
    **dict.fromkeys(("--total-timesteps", "--num-timesteps", "--timesteps", "--n-timesteps"), "the option is --env-steps"),
    **dict.fromkeys(("--buffer-size", "--max-replay-size"), "the option is --replay-transitions"),
    **dict.fromkeys(("--gamma", "--discounting"), "the option is --discount"),
    **dict.fromkeys(("--load", "--trained-agent", "--restore"), "the options are --run-dir FOLDER --resume"),
    **dict.fromkeys(("--exp-name", "--log-folder", "--logdir"), "the option is --run-dir"),
    **dict.fromkeys(
        ("--capture-video", "--render", "--render-mode"), f"a run draws a video at its end; {PROGRAM} play draws more"
    ),
    "--algo": "the option is --algorithm, such as ddpg or td3; --method says where rewards come from",
}

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class FieldsOf:
    """Annotation of a command's field that collects, by name, the given fields of another dataclass.

    Attributes:
        record: The dataclass; its fields are options of the command, except those that the command declares itself.
        default: Maps a field's name to the help's description of its default.
    """

    record: type
    default: Callable[[str], str]


@dataclasses.dataclass(frozen=True)
class AlsoPositional:
    """Annotation of a field that may be given by position as well as by name: ``train TASK`` or ``train --env TASK``."""


@dataclasses.dataclass(frozen=True)
class DefaultText:
    """Annotation of a field whose default is described by a function.

    Attributes:
        describe: Function that returns the description for the help.
    """

    describe: Callable[[], str]


@dataclasses.dataclass(frozen=True)
class _Option:
    """Option or positional argument.

    Attributes:
        name: Name of the field.
        hint: Its annotation, without extras.
        is_positional: True for a positional argument.
        help: One or more sentences.
        default: Description of its default in the help; empty if obvious.
        is_required: True if it must be given.
        changes: Field of the command that collects it; None if it is a field of the command itself.
        is_positional_form: True for the positional form of a field that is also an option.
    """

    name: str
    hint: Any
    is_positional: bool
    help: str
    default: str
    is_required: bool
    changes: str | None = None
    is_positional_form: bool = False

    @property
    def key(self) -> str:
        """Key of the option for tyro."""
        return f"{self.name}_by_place" if self.is_positional_form else self.name

    @property
    def flag(self) -> str:
        """Spelling on a command line."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def metavar(self) -> str:
        """Name of its values in the help."""
        one, optional, several = fields.unwrap(self.hint)
        choices = fields.choices(self.hint)
        word = f"{{{','.join(choices)}}}" if choices else "TEXT" if one is str else one.__name__.upper()
        if self.is_positional:
            word = word if choices else self.name.upper()
            return f"[{word} ...]" if several else word if self.is_required else f"[{word}]"
        # None is shown only where it can override a preset or a saved run.
        return f"[{word} ...]" if several else f"{word}|None" if optional and self.changes else word

    @property
    def is_flag(self) -> bool:
        """True if it takes no value."""
        return fields.unwrap(self.hint)[0] is bool

    @property
    def takes_one_word(self) -> bool:
        """True if it takes exactly one value."""
        return not self.is_flag and not fields.unwrap(self.hint)[2]

    def annotation(self) -> Any:
        """Return the annotation for tyro: a list of words, or a flag."""
        hint = f"({self.default})" if self.default else ""
        if self.is_flag:
            extras: list[Any] = [tyro.conf.arg(help=self.help, help_behavior_hint=hint)]
            if self.changes is None:  # otherwise with --no-x, because either may override a preset
                extras.append(tyro.conf.FlagCreatePairsOff)
            return Annotated[bool, *extras]
        words = tyro.constructors.PrimitiveConstructorSpec(
            nargs=1 if self.takes_one_word else "*",
            metavar=self.metavar,
            instance_from_str=list,
            is_instance=lambda _: True,
            str_from_instance=lambda _: [],
        )
        extras = [words, tyro.conf.arg(help=self.help, help_behavior_hint=hint, metavar=self.metavar)]
        if self.is_positional:
            extras.append(tyro.conf.Positional)
        return Annotated[list[str], *extras]


def parse(command: type[T], words: Sequence[str], name: str = "") -> T:
    """Parse the arguments of a command.

    Args:
        command: A frozen dataclass. Its docstring and those of its fields are the help. A field annotated with
            `tyro.conf.Positional` is positional, one with `AlsoPositional` may be either, and one with `FieldsOf` stands for
            many options.
        words: Arguments after the command's name.
        name: Name of the command; the dataclass's name in lower case if not given.

    Raises:
        RequestError: The arguments are invalid.
        SystemExit: Help was printed.
    """
    options = {option.key: option for option in _collect_options(command)}
    _check_values(words, list(options.values()))
    program = f"{PROGRAM} {name or command.__name__.lower()}"
    arguments, left_over = _split(command, program, words, options)
    if left_over:
        word = left_over[0].partition("=")[0].replace("_", "-") if left_over[0].startswith("-") else left_over[0]
        if not word.startswith("-"):
            raise RequestError(f"unexpected argument {word!r}; see {program} --help")
        flags = [option.flag for option in options.values() if not option.is_positional]
        if word == "--version":
            raise RequestError(f"--version goes without a command: {PROGRAM} --version")
        if word in _FOREIGN_OPTIONS and word not in flags:
            raise RequestError(f"unknown option {word}: {_FOREIGN_OPTIONS[word]}")
        raise RequestError(f"unknown option {word}{nearest(word, flags, f'see {program} --help')}")
    values: dict[str, Any] = {}
    for key, option in options.items():
        if option.changes is not None:
            values.setdefault(option.changes, {})
        if key in arguments:
            target = values if option.changes is None else values[option.changes]
            value = _value(option, arguments[key])
            if target.get(option.name, value) != value:
                first, second = (item if isinstance(item, tuple) else (item,) for item in (target[option.name], value))
                both = f"{' '.join(map(str, first))} by {option.flag} and {' '.join(map(str, second))} by position"
                raise RequestError(f"{option.name} is given twice, {both}; give it once")
            target[option.name] = value
        elif option.is_required and option.name not in values:
            choices = fields.choices(option.hint)
            hint = f"; choose one of {', '.join(choices)}" if choices else f": {option.help} See {program} --help"
            raise RequestError(f"no {option.name if choices else option.metavar} given{hint}")
    return command(**values)


def _split(
    command: type, program: str, words: Sequence[str], options: dict[str, _Option]
) -> tuple[dict[str, Any], Sequence[str]]:
    """Split arguments into the words of each given option (True or False for flags) and the remaining words."""
    # A dictionary with optional keys: tyro omits options that were not given.
    annotations = {name: option.annotation() for name, option in options.items()}
    form: Any = typing.TypedDict(command.__name__, annotations, total=False)  # pyright: ignore[reportArgumentType]
    unset = {name: False for name, option in options.items() if option.is_flag and option.changes is None}
    text = inspect.getdoc(command)
    discarded = io.StringIO()
    try:
        with contextlib.redirect_stderr(discarded):
            return tyro.cli(form, prog=program, description=text, args=list(words), default=unset, return_unknown_args=True)
    except SystemExit as stop:
        if not stop.code:
            raise
    # The only remaining error is an option without its value.
    flags = {option.flag for option in options.values() if option.takes_one_word}
    for word, following in zip(words, [*words[1:], "--"], strict=True):
        is_number = following[1:2].isdigit() or following[1:2] == "."
        if word.replace("_", "-") in flags and following.startswith("-") and not is_number:
            raise RequestError(f"{word} needs a value; see {program} --help")
    raise RequestError(f"an option needs a value; see {program} --help")


def _check_values(words: Sequence[str], options: Sequence[_Option]) -> None:
    """Reject true or false after a flag, and several numbers after an option that takes one: they would pass for a task.

    Raises:
        RequestError: There are such values.
    """
    flags = {option.flag: option for option in options if not option.is_positional}
    takes_path = any(option.is_positional and option.hint is Path for option in options)
    for index, word in enumerate(words):
        option = flags.get(word.replace("_", "-"))
        following = list(itertools.takewhile(_is_number, words[index + 1 :]))
        if option is None:
            continue
        if option.is_flag and words[index + 1 : index + 2] and words[index + 1].lower() in ("true", "false", "0", "1"):
            opposite = f"write {option.flag.replace('--', '--no-', 1)}" if option.changes else "leave it out"
            raise RequestError(f"{option.flag} takes no value: {opposite} for its opposite")
        if option.takes_one_word and len(following) > 1 and not takes_path:
            raise RequestError(f"{option.flag} takes one value, not {' '.join(following)}: {option.help}")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _value(option: _Option, words: Any) -> Any:
    if isinstance(words, bool):
        return words
    words = [words] if isinstance(words, str) else words
    choices = fields.choices(option.hint)
    if option.is_positional and choices and words[0] not in choices:
        raise RequestError(f"unknown {option.name} {words[0]!r}{nearest(words[0], choices)}")
    return fields.read(option.name if option.is_positional else option.flag, option.hint, words)


def _collect_options(command: type) -> list[_Option]:
    """List the options of a command in the order of its fields, with those of a `FieldsOf` in its place.

    A field that may be given either by name or by position makes two options, in this order.
    """
    own = {field.name for field in dataclasses.fields(command)}
    options = []
    for field, text in describe_options(command):
        changes = next((extra for extra in field.extras if isinstance(extra, FieldsOf)), None)
        if changes is None:
            is_required = field.default is dataclasses.MISSING
            default = "required" if is_required else f"default: {field.default}" if field.default else ""
            for extra in field.extras:
                default = extra.describe() if isinstance(extra, DefaultText) else default
            if AlsoPositional() in field.extras:
                options.append(_Option(field.name, field.hint, False, text, "" if is_required else default, False))
                options.append(_Option(field.name, field.hint, True, text, default, is_required, is_positional_form=True))
                continue
            is_positional = tyro.conf.Positional in field.extras
            options.append(_Option(field.name, field.hint, is_positional, text, default, is_required))
            continue
        options += [
            _Option(item.name, item.hint, False, item_text, changes.default(item.name), False, field.name)
            for item, item_text in describe_options(changes.record)
            if item.name not in own
        ]
    return options


def describe_options(record: type) -> list[tuple[fields.Field, str]]:
    """List the fields of a dataclass, those of its groups in their place, with their docstrings."""
    described = fields.describe(record)
    texts = {kind: _docstrings(kind) for kind in {field.record for field in described}}
    return [(field, texts[field.record].get(field.name, "")) for field in described]


@functools.cache
def _docstrings(record: type) -> dict[str, str]:
    """Return the docstrings below the fields of a dataclass, inherited ones included, as single lines."""
    texts: dict[str, str] = {}
    for kind in reversed([kind for kind in record.__mro__ if dataclasses.is_dataclass(kind)]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        for line, following in itertools.pairwise(definition.body):
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and isinstance(following, ast.Expr):
                texts[line.target.id] = " ".join(str(ast.literal_eval(following.value)).split())
    return texts
