"""From a command line, and a file of options, to the options of a command. Loads no torch."""

from __future__ import annotations

import inspect
import json
from argparse import ArgumentError, ArgumentParser
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tyro
import yaml
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo

from swiftwrf.errors import InputError
from tasks.options import Options

Config = TypeVar("Config", bound=Options)
STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)
MAX_CONFIG_BYTES = 2**20


def file_of_options(arguments: Sequence[str]) -> str | None:
    """Return the value of --config on a command line, None without one.

    Raises:
        InputError: It is given twice or lacks its value.

    Example:
        >>> file_of_options(["--seed", "7", "--config=options.yaml"])
        'options.yaml'
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", action="append", default=[])
    try:
        files = parser.parse_known_args(arguments)[0].config
    except ArgumentError as error:
        raise InputError(f"{error.argument_name}: {error.message}; --help shows its use") from None
    if len(files) > 1:
        raise InputError(f"--config is given twice: {' and '.join(files)}; give one")
    return files[0] if files else None


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
        arguments: Options of the command line.
        program: Name of the command in the help.
        saved: Values of `file_options` or of a run by name, in place of the defaults.
        origin: File or directory of the saved values, for messages.

    Raises:
        InputError: A saved value that is not of its option's type, or an unknown name.
        SystemExit: Help, or options that do not exist or cannot be read.
    """
    left = dict(saved or {})
    defaults = _defaults(config_type, left, origin)
    for name in left:
        raise InputError(f"{origin} names {name!a}, which is no option of this command; --help lists them")
    # a flag that a file sets needs its negation on the command line
    style = STYLE if saved else (*STYLE, tyro.conf.FlagCreatePairsOff)
    description = inspect.cleandoc(config_type.__doc__ or "")
    found: Config = tyro.cli(
        config_type, prog=program, description=description, args=arguments, default=defaults, config=style
    )
    return found


def _defaults(kind: type[Any], saved: dict[str, Any], origin: object) -> Any:
    """Return options with the values that are taken from `saved`, and the others as they are by default.

    Raises:
        InputError: A value that its option does not take.
    """
    made, hints = object.__new__(kind), get_type_hints(kind, include_extras=True)  # required ones may be missing
    for option in fields(kind):
        default = tyro.MISSING if option.default is MISSING else option.default
        if is_dataclass(default):
            default = _defaults(type(default), saved, origin)
        elif (value := saved.pop(option.name, None)) is not None:
            default = _typed(option.name, value, hints[option.name], origin)
        object.__setattr__(made, option.name, default)
    return made


def _typed(name: str, value: Any, hint: Any, origin: object) -> Any:
    """Return a saved value in the type of its option, read like the words of a command line.

    Raises:
        InputError: The option does not take it.
    """
    items = value if isinstance(value, list) else [value]
    spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))
    is_fitting = spec.nargs == "*" or len(items) in (spec.nargs if isinstance(spec.nargs, tuple) else (spec.nargs,))
    try:
        if not is_fitting or any(isinstance(item, dict | list) for item in items):
            raise ValueError
        return spec.instance_from_str([str(item) for item in items])
    except ValueError:
        raise InputError(f"{origin}: {name} takes {spec.metavar}, got {value!a}") from None


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
