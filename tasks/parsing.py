"""From a command line, and a file of options, to the options of a command. Loads no torch."""

from __future__ import annotations

import ast
import inspect
import json
import textwrap
from argparse import ArgumentError, ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_type_hints

import tyro
import yaml
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo

from swiftwrf.errors import InputError
from tasks.options import Options

Config = TypeVar("Config", bound=Options)
STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)
MAX_CONFIG_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class General(Options):
    """Options of every command, `resume` of those whose runs can be continued. They are read before all others."""

    group: ClassVar[str] = "general"

    config: str | None = None
    """FILE.yaml or FILE.json with options by name, e.g. the config.json of a run; options of the command line win"""
    verbose: bool = False
    """print what is read and computed, with times"""
    resume: str | None = None
    """continue the interrupted run DIR.partial; only --scheduler, --processes and options of the output may be given"""


def general_options(arguments: Sequence[str]) -> tuple[Namespace, list[str]]:
    """Return the options of `General` on a command line, and the other arguments.

    Raises:
        InputError: One of them is given twice or lacks its value.

    Example:
        >>> general_options(["--seed", "7", "--config=options.yaml"])
        (Namespace(config='options.yaml', resume=None, verbose=False), ['--seed', '7'])
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--config", "--resume"):
        parser.add_argument(name, action="append")
    parser.add_argument("--verbose", action="store_true")
    try:
        found, others = parser.parse_known_args(arguments)
    except ArgumentError as error:
        raise InputError(f"{error.argument_name}: {error.message}; --help shows its use") from None
    for name, values in vars(found).items():
        if isinstance(values, list):
            if len(values) > 1:
                raise InputError(f"--{name} is given twice: {' and '.join(values)}; give one")
            setattr(found, name, values[0])
    return found, others


def parse(
    config_type: type[Config],
    arguments: Sequence[str],
    program: str,
    saved: Mapping[str, Any] | None = None,
    origin: object = "",
) -> Config:
    """Return the options of a command line.

    Args:
        config_type: Dataclass of the options. Its docstring is the description in the help.
        arguments: Options of the command line, without those of `general_options`.
        program: Name of the command in the help.
        saved: Values of `file_options` or of a run, in place of the defaults.
        origin: File or directory of the saved values, for messages.

    Raises:
        InputError: A saved value that is not of its option's type, or an unknown name.
        SystemExit: Help, or options that do not exist or cannot be read.
    """
    # a flag that a file sets needs its negation on the command line
    flags = (tyro.conf.FlagCreatePairsOff,) if saved is None else ()
    found = tyro.cli(
        _grouped(config_type, _typed(config_type, saved or {}, origin)),
        prog=program,
        description=inspect.cleandoc(config_type.__doc__ or ""),
        args=arguments,
        config=(*STYLE, *flags),
    )
    values = {name: value for group in vars(found).values() for name, value in vars(group).items()}
    return config_type(**{option.name: values[option.name] for option in fields(config_type)})


def _grouped(config_type: type[Options], defaults: Mapping[str, Any]) -> type[Any]:
    """Return a dataclass with a field for each group of options, in the order of the help, and with these defaults."""
    groups: dict[str, list[Any]] = {}
    for source in (config_type, General):
        hints = get_type_hints(source, include_extras=True)
        bases = [base for base in source.__mro__ if issubclass(base, Options)]
        for option in fields(source):
            if option.name == "resume" and not config_type.resumable:
                continue
            owner = next(base for base in bases if option.name in inspect.get_annotations(base))
            group = "command" if owner is config_type else owner.group
            if option.default is MISSING and tyro.conf.Positional not in get_args(hints[option.name])[1:]:
                group = "required"
            default = defaults.get(option.name, option.default)
            entry = (option.name, _with_help(hints[option.name], owner, option.name, default), field(default=default))
            groups.setdefault(group, []).append(entry)
    order = sorted(groups, key=lambda group: group != "required")  # an option of a base class may be required
    nested = [(group, make_dataclass(group, groups[group], kw_only=True)) for group in order]
    return make_dataclass("Command", nested, kw_only=True)


def _with_help(hint: Any, owner: type[Options], name: str, default: Any) -> Any:
    """Return the annotation of an option with its help, which shows one default at most."""
    if any(hasattr(extra, "help_behavior_hint") and extra.help for extra in get_args(hint)[1:]):
        return hint  # has a help of its own
    text = _documentation(owner)[name]
    is_shown = default not in (None, ()) and default is not False and "(default:" not in text
    behaviour = "(required)" if default is MISSING else None if is_shown else ""
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


def _typed(config_type: type[Options], saved: Mapping[str, Any], origin: object) -> dict[str, Any]:
    """Return saved values in the types of their options, read like the words of a command line; null is left out.

    Raises:
        InputError: An unknown name, or a value that the option does not take.
    """
    hints = get_type_hints(config_type, include_extras=True)
    known = {option.name for option in fields(config_type)}
    typed = {}
    for name, value in saved.items():
        if name not in known:
            raise InputError(f"{origin} names {name!a}, which is no option of this command; --help lists them")
        items = value if isinstance(value, list) else [value]
        spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hints[name], set()))
        is_fitting = spec.nargs == "*" or len(items) in (spec.nargs if isinstance(spec.nargs, tuple) else (spec.nargs,))
        try:
            if not is_fitting or any(isinstance(item, dict | list) for item in items):
                raise ValueError
            if value is not None:
                typed[name] = spec.instance_from_str([str(item) for item in items])
        except ValueError:
            raise InputError(f"{origin}: {name} takes {spec.metavar}, got {value!a}") from None
    return typed


def file_options(file: Path) -> dict[str, Any]:
    """Return the options of a file by name. The config.json of a run holds them under `config`; its `out` is taken.

    Raises:
        InputError: No such file, or one that holds no names and values.
    """
    try:
        if not file.is_file() or file.stat().st_size > MAX_CONFIG_BYTES:
            raise OSError(f"expected a file of at most {MAX_CONFIG_BYTES} bytes")
        text = file.read_text(encoding="utf-8-sig")
        content = json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise InputError(f"--config {file} cannot be read ({error})") from None
    if isinstance(content, dict) and isinstance(content.get("config"), dict):
        content = content["config"] | {"out": None}
    if not isinstance(content, dict):
        raise InputError(f"--config {file} must hold options by name, got {type(content).__name__}")
    return {str(name): value for name, value in content.items()}
