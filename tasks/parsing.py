"""From the text of a command line and a file of options to the options of a command. Loads no torch."""

from __future__ import annotations

import ast
import inspect
import json
import textwrap
from collections.abc import Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_type_hints

import tyro
import yaml

from swiftwrf.errors import InputError
from tasks.options import Options

Config = TypeVar("Config", bound=Options)
STYLE = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.DisallowNone,
)


@dataclass(frozen=True, kw_only=True)
class General(Options):
    """Options of every command. They are listed in the help and read before all others."""

    group: ClassVar[str] = "general"

    config: str | None = None
    """FILE.yaml or FILE.json with options by name, e.g. the config.json of a run; options of the command line win"""
    verbose: bool = False
    """print what is read and computed, with times"""


@dataclass(frozen=True, kw_only=True)
class Resumable(General):
    """Options of every command whose runs can be continued."""

    resume: str | None = None
    """continue the interrupted run DIR.partial; only --scheduler and options of the output may follow"""


def parse(config_type: type[Config], arguments: Sequence[str], program: str) -> Config:
    """Return the options of a command line.

    Args:
        config_type: Dataclass of the options. Its docstring is the description in the help.
        arguments: Options of the command line.
        program: Name of the command in the help.

    Raises:
        InputError: A file of options that is missing or does not fit the command.
        SystemExit: Help, or options that do not exist or cannot be read.
    """
    found = tyro.cli(
        _grouped(config_type),
        prog=program,
        description=inspect.cleandoc(config_type.__doc__ or ""),
        args=_with_file(config_type, list(arguments)),
        config=STYLE,
    )
    values = {name: value for group in vars(found).values() for name, value in vars(group).items()}
    return config_type(**{option.name: values[option.name] for option in fields(config_type)})


def _grouped(config_type: type[Options]) -> type[Any]:
    """Return a dataclass with a field for each group of options, in the order of the help."""
    groups: dict[str, list[Any]] = {}
    for source in (config_type, Resumable if config_type.resumable else General):
        hints = get_type_hints(source, include_extras=True)
        bases = [base for base in source.__mro__ if issubclass(base, Options)]
        for option in fields(source):
            owner = next(base for base in bases if option.name in inspect.get_annotations(base))
            group = "command" if owner is config_type else owner.group
            if option.default is MISSING and tyro.conf.Positional not in get_args(hints[option.name])[1:]:
                group = "required"
            default = {} if option.default is MISSING else {"default": option.default}
            entry = (option.name, _with_help(hints[option.name], owner, option), field(**default))
            groups.setdefault(group, []).append(entry)
    order = sorted(groups, key=lambda group: group != "required")  # an option of a base class may be required
    nested = [(group, make_dataclass(group, groups[group], kw_only=True)) for group in order]
    return make_dataclass("Command", nested, kw_only=True)


def _with_help(hint: Any, owner: type[Options], option: Field[Any]) -> Any:
    """Return the annotation of an option with its help, which shows one default at most."""
    if any(hasattr(extra, "help_behavior_hint") and extra.help for extra in get_args(hint)[1:]):
        return hint  # has a help of its own
    text = _documentation(owner)[option.name]
    is_shown = option.default not in (None, ()) and option.default is not False and "(default:" not in text
    behaviour = "(required)" if option.default is MISSING else None if is_shown else ""
    return Annotated[hint, tyro.conf.arg(help=text, help_behavior_hint=behaviour)]


def _documentation(owner: type[Options]) -> dict[str, str]:
    """Return the text below each option of a class, on one line."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    assert isinstance(body, ast.ClassDef)
    texts = {}
    for option, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(option, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            texts[ast.unparse(option.target)] = " ".join(str(below.value.value).split())
    return texts


def _with_file(config_type: type[Options], arguments: list[str]) -> list[str]:
    """Return a command line with the options of `--config FILE`, unless the command line names them itself."""
    if "--config" not in arguments:
        return arguments
    at = arguments.index("--config")
    if at + 1 == len(arguments):
        raise InputError("--config takes a file of options")
    given, file = arguments[:at] + arguments[at + 2 :], Path(arguments[at + 1])
    values = _file_options(file)
    known = {option.name: option for option in fields(config_type)}
    if unknown := [name for name in values if name not in known]:
        raise InputError(f"{file} names {unknown[0]!a}, which is no option of this command; --help lists them")
    hints = get_type_hints(config_type, include_extras=True)
    positional: list[str] = []
    options: list[str] = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        texts = [str(item) for item in value] if isinstance(value, list) else [str(value)]
        if value is None or value is False or any(text.partition("=")[0].replace("_", "-") == flag for text in given):
            continue
        if tyro.conf.Positional in get_args(hints[name])[1:]:
            positional += texts if not given or given[0].startswith("-") else []
        else:
            options += [flag] if value is True else [flag, *texts]
    return [*positional, *given, *options]


def _file_options(file: Path) -> dict[str, Any]:
    """Return the options of a file by name. The config.json of a run holds them under `config`.

    Raises:
        InputError: No such file, or one that holds no names and values.
    """
    try:
        text = file.read_text()
        content = json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise InputError(f"--config {file} cannot be read ({error})") from None
    if isinstance(content, dict) and isinstance(content.get("config"), dict):
        content = content["config"]
    if not isinstance(content, dict):
        raise InputError(f"--config {file} must hold options by name, got {type(content).__name__}")
    return {str(name): value for name, value in content.items()}
