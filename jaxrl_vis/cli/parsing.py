"""Reads the words of a command line into the frozen dataclass of one command.

    words -> tyro: which words belong to which option, or help -> `fields.read`: values -> the dataclass

tyro sees every option as a list of words that may be missing, so that it never judges a value: what is wrong with one is told
in one line here, and what was not given is known to be so.
"""

import ast
import contextlib
import dataclasses
import inspect
import io
import itertools
import textwrap
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from jaxrl_vis import fields
from jaxrl_vis.errors import RequestError, nearest

PROGRAM = "jaxrl-vis"

# Options of brax, Stable-Baselines3, its zoo and CleanRL that people try here -> what does the same.
_ELSEWHERE = {
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
    "--algo": "the option is --algorithm, ddpg or module:Name; --method says where rewards come from",
}

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class ChangesOf:
    """Marks the field of a command that collects those fields of another dataclass that were given, by name.

    Attributes:
        record: The dataclass; its fields are options of the command, but for those that the command declares itself.
        default: A field's name -> what the help says about its default.
    """

    record: type
    default: Callable[[str], str]


@dataclasses.dataclass(frozen=True)
class ByPlaceToo:
    """Marks a field that may be given by its place as well as by its name: ``train TASK`` or ``train --env TASK``."""


@dataclasses.dataclass(frozen=True)
class SayDefault:
    """Marks a field whose default the help cannot read off.

    Attributes:
        words: What the help says about it.
    """

    words: Callable[[], str]


@dataclasses.dataclass(frozen=True)
class _Option:
    """One option or positional argument.

    Attributes:
        name: Of the field.
        hint: Its annotation, without extras.
        positional: Whether it is known by its place instead of its name.
        help: One or more sentences.
        default: What the help says about its default; nothing where it goes without saying.
        required: Whether it must be given.
        changes: The field of the command that collects it; None where it is a field of the command itself.
        twin: Whether it is the same field as another option, which is known by its name.
    """

    name: str
    hint: Any
    positional: bool
    help: str
    default: str
    required: bool
    changes: str | None = None
    twin: bool = False

    @property
    def key(self) -> str:
        """What tyro calls it."""
        return f"{self.name}_by_place" if self.twin else self.name

    @property
    def flag(self) -> str:
        """As it is written on a command line."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def metavar(self) -> str:
        """What the help calls its values."""
        one, optional, several = fields.unwrap(self.hint)
        choices = fields.choices(self.hint)
        word = f"{{{','.join(choices)}}}" if choices else "TEXT" if one is str else one.__name__.upper()
        if self.positional:
            word = word if choices else self.name.upper()
            return f"[{word} ...]" if several else word if self.required else f"[{word}]"
        # None says nothing, but where it can undo what a preset or a saved run says.
        return f"[{word} ...]" if several else f"{word}|None" if optional and self.changes else word

    @property
    def is_flag(self) -> bool:
        """Whether no word follows."""
        return fields.unwrap(self.hint)[0] is bool

    @property
    def takes_one_word(self) -> bool:
        """Whether exactly one word must follow."""
        return not self.is_flag and not fields.unwrap(self.hint)[2]

    def annotation(self) -> Any:
        """What tyro is told: a list of words, or a flag."""
        hint = f"({self.default})" if self.default else ""
        if self.is_flag:
            extras: list[Any] = [tyro.conf.arg(help=self.help, help_behavior_hint=hint)]
            if self.changes is None:  # else --no-x as well: either may contradict a preset
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
        if self.positional:
            extras.append(tyro.conf.Positional)
        return Annotated[list[str], *extras]


def parse(command: type[T], words: Sequence[str], name: str = "") -> T:
    """One command, from the words that follow its name.

    Args:
        command: A frozen dataclass. Its docstring and those of its fields are the help. A field that is annotated with
            `tyro.conf.Positional` is known by its place, one annotated with `ByPlaceToo` by either, and one annotated with
            `ChangesOf` stands for many.
        words: Of the command line.
        name: What it is called; the dataclass's name in lower case if not given.

    Raises:
        RequestError: The words do not make sense.
        SystemExit: Help was asked for, and printed.
    """
    options = {option.key: option for option in _options_of(command)}
    _check_values(words, list(options.values()))
    program = f"{PROGRAM} {name or command.__name__.lower()}"
    given, left_over = _split(command, program, words, options)
    if left_over:
        word = left_over[0].partition("=")[0].replace("_", "-") if left_over[0].startswith("-") else left_over[0]
        if not word.startswith("-"):
            raise RequestError(f"unexpected argument {word!r}; see {program} --help")
        flags = [option.flag for option in options.values() if not option.positional]
        if word == "--version":
            raise RequestError(f"--version goes without a command: {PROGRAM} --version")
        if word in _ELSEWHERE and word not in flags:
            raise RequestError(f"unknown option {word}: {_ELSEWHERE[word]}")
        raise RequestError(f"unknown option {word}{nearest(word, flags, f'see {program} --help')}")
    values: dict[str, Any] = {}
    for key, option in options.items():
        if option.changes is not None:
            values.setdefault(option.changes, {})
        if key in given:
            target = values if option.changes is None else values[option.changes]
            value = _value(option, given[key])
            if target.get(option.name, value) != value:
                here, there = (each if isinstance(each, tuple) else (each,) for each in (target[option.name], value))
                both = f"{' '.join(map(str, here))} by {option.flag} and {' '.join(map(str, there))} by its place"
                raise RequestError(f"{option.name} is given twice, {both}; give it once")
            target[option.name] = value
        elif option.required and option.name not in values:
            choices = fields.choices(option.hint)
            mend = f"; choose one of {', '.join(choices)}" if choices else f": {option.help} See {program} --help"
            raise RequestError(f"no {option.name if choices else option.metavar} given{mend}")
    return command(**values)


def _split(
    command: type, program: str, words: Sequence[str], options: dict[str, _Option]
) -> tuple[dict[str, Any], Sequence[str]]:
    """The words of each option that was given (or True and False for flags), and the words that belong to none."""
    # A dictionary of which every key may be missing: tyro leaves out what was not given.
    annotations = {name: option.annotation() for name, option in options.items()}
    form: Any = typing.TypedDict(command.__name__, annotations, total=False)  # pyright: ignore[reportArgumentType]
    unset = {name: False for name, option in options.items() if option.is_flag and option.changes is None}
    text = inspect.getdoc(command)
    unread = io.StringIO()
    try:
        with contextlib.redirect_stderr(unread):
            return tyro.cli(form, prog=program, description=text, args=list(words), default=unset, return_unknown_args=True)
    except SystemExit as stop:
        if not stop.code:
            raise
    # The one thing that is left to go wrong: there is no word where one must be.
    flags = {option.flag for option in options.values() if option.takes_one_word}
    for word, following in zip(words, [*words[1:], "--"], strict=True):
        is_number = following[1:2].isdigit() or following[1:2] == "."
        if word.replace("_", "-") in flags and following.startswith("-") and not is_number:
            raise RequestError(f"{word} needs a value; see {program} --help")
    raise RequestError(f"an option needs a value; see {program} --help")


def _check_values(words: Sequence[str], options: Sequence[_Option]) -> None:
    """Refuses true or false after a flag, and several numbers after an option of one, which would be taken for a task.

    Raises:
        RequestError: That is so.
    """
    flags = {option.flag: option for option in options if not option.positional}
    takes_path = any(option.positional and option.hint is Path for option in options)
    for place, word in enumerate(words):
        option = flags.get(word.replace("_", "-"))
        following = list(itertools.takewhile(_is_number, words[place + 1 :]))
        if option is None:
            continue
        if option.is_flag and words[place + 1 : place + 2] and words[place + 1].lower() in ("true", "false", "0", "1"):
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
    if option.positional and choices and words[0] not in choices:
        raise RequestError(f"unknown {option.name} {words[0]!r}{nearest(words[0], choices)}")
    return fields.read(option.name if option.positional else option.flag, option.hint, words)


def _options_of(command: type) -> list[_Option]:
    """The options of a command in the order of its fields, those that a `ChangesOf` stands for in its place.

    A field that may be given either way is two options: first by its name, then by its place.
    """
    own = {field.name for field in dataclasses.fields(command)}
    found = []
    for field, hint, extras, text in _described(command):
        changes = next((extra for extra in extras if isinstance(extra, ChangesOf)), None)
        if changes is None:
            required = field.default is dataclasses.MISSING
            default = "required" if required else f"default: {field.default}" if field.default else ""
            for extra in extras:
                default = extra.words() if isinstance(extra, SayDefault) else default
            if ByPlaceToo() in extras:
                found.append(_Option(field.name, hint, False, text, "" if required else default, False))
                found.append(_Option(field.name, hint, True, text, default, required, twin=True))
                continue
            found.append(_Option(field.name, hint, tyro.conf.Positional in extras, text, default, required))
            continue
        found += [
            _Option(each.name, each_hint, False, each_text, changes.default(each.name), False, field.name)
            for each, each_hint, _, each_text in _described(changes.record)
            if each.name not in own
        ]
    return found


def _described(record: type) -> list[tuple[dataclasses.Field, Any, tuple[Any, ...], str]]:
    """Fields of a dataclass with their annotations, what `typing.Annotated` adds to these, and their docstrings."""
    texts: dict[str, str] = {}
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(record))).body
    for line, following in itertools.pairwise(definition.body):
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and isinstance(following, ast.Expr):
            texts[line.target.id] = " ".join(str(ast.literal_eval(following.value)).split())
    hints = typing.get_type_hints(record, include_extras=True)
    plain = fields.hints(record)
    return [
        (field, plain[field.name], getattr(hints[field.name], "__metadata__", ()), texts.get(field.name, ""))
        for field in dataclasses.fields(record)
    ]
