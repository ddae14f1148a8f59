"""Completion of commands and options in a shell: `eval "$(swiftwrf completion bash)"`."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

from swiftwrf.errors import InputError
from tasks import configs
from tasks.options import ALIASES, General

SHELLS = ("bash", "zsh", "fish")
BASH = """\
_swiftwrf() {{
  local words="{commands}"
  if [ "$COMP_CWORD" -gt 1 ]; then
    case "${{COMP_WORDS[1]}}" in
{cases}
      *) words="" ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _swiftwrf swiftwrf
"""


def flags(kind: type[Any]) -> list[str]:
    """Return the options of a command, those of groups and other names of options included.

    Example:
        >>> flags(General)[:2]
        ['--config', '--verbose']
    """
    found = []
    for option in fields(kind):
        if is_dataclass(option.default):
            found += flags(type(option.default))
        elif "Positional" not in str(option.type):
            others = [other for other, name in ALIASES.items() if name == option.name]
            found += [f"--{name.replace('_', '-')}" for name in (option.name, *others)]
    return found


def script(shell: str, commands: dict[str, str]) -> str:
    """Return the completion of a shell, for commands by the names of their options.

    Raises:
        InputError: A shell that is not known.
    """
    if shell not in SHELLS:
        raise InputError(f"completion is for {', '.join(SHELLS)}, got {shell!a}")
    options = {name: [*flags(getattr(configs, kind)), *flags(General)] for name, kind in commands.items()}
    if shell == "fish":
        lines = [f"complete -c swiftwrf -n __fish_use_subcommand -a '{' '.join(options)}'"]
        for name, words in options.items():
            lines += [f"complete -c swiftwrf -n '__fish_seen_subcommand_from {name}' -l {word[2:]}" for word in words]
        return "\n".join(lines)
    cases = "\n".join(f'      {name}) words="{" ".join(words)}" ;;' for name, words in options.items())
    before = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return before + BASH.format(commands=" ".join(options), cases=cases)
