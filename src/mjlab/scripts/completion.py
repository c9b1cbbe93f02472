"""Shell completion of commands, task names and frequent flags: `eval "$(mjlab completion bash)"`."""

from __future__ import annotations

import pkgutil

from mjlab.cli.help import ALL, TOPICS, Row, screen_rows
from mjlab.utils.errors import BadCallError

# Configs of the commands with frequent flags.
_CONFIGS = {
    "train": "mjlab.cli.train_config:TrainConfig",
    "train-seeds": "mjlab.cli.train_config:TrainConfig",
    "sweep": "mjlab.cli.train_config:TrainConfig",
    "play": "mjlab.scripts.play:PlayConfig",
    "evaluate": "mjlab.scripts.evaluate:EvaluateConfig",
    "profile-env": "mjlab.scripts.profile_env:ProfileConfig",
    "describe": "mjlab.scripts.describe:DescribeConfig",
}

_USAGE = """\
usage: mjlab completion bash|zsh|fish

Print a script that completes subcommands, task names and frequent flags. Add one of these lines to the startup file of
the shell:

    eval "$(mjlab completion bash)"        # ~/.bashrc
    eval "$(mjlab completion zsh)"         # ~/.zshrc, after compinit
    mjlab completion fish | source         # ~/.config/fish/config.fish"""

# The shell calls `mjlab completion --candidates WORD...` and completes the last word. `train`, `play`
# and so on are passed as words of `mjlab train` and `mjlab play`.
_BASH = """\
_mjlab_complete() {
    local words=("${COMP_WORDS[@]:1:COMP_CWORD}")
    [ "${COMP_WORDS[0]##*/}" = mjlab ] || words=("${COMP_WORDS[0]##*/}" "${words[@]}")
    COMPREPLY=($(mjlab completion --candidates "${words[@]}" 2>/dev/null))
}
complete -o default -F _mjlab_complete """

_ZSH = "autoload -Uz bashcompinit && bashcompinit\n" + _BASH

_FISH = """\
function _mjlab_complete
    set -l words (commandline -opc) (commandline -ct)
    set -l name (basename $words[1])
    test $name = mjlab; and set words $words[2..]; or set words $name $words[2..]
    mjlab completion --candidates $words 2>/dev/null
end
for name in """


def candidates(words: list[str]) -> list[str]:
    """Return the completions of the last of `words`, the words after `mjlab` on a command line."""
    from mjlab.cli.main import COMMANDS

    *before, partial = words or [""]
    if not before:
        names = [command.name for command in COMMANDS]
    elif before in ([c.name] for c in COMMANDS if c.argument in ("TASK", "TASK|POLICY", "TARGET")):
        from mjlab.tasks.registry import list_tasks

        names = list_tasks()
    else:
        names = _flag_candidates(before, partial)
    return [name for name in names if name.startswith(partial)]


def _flag_candidates(before: list[str], partial: str) -> list[str]:
    """Return what may follow a command and its task: a value, a topic of `--help`, or a flag."""
    name, last = before[0], before[-1]
    if name != "demo" and name not in _CONFIGS:
        return []
    if last == "--help":
        return [name, "agent", "env", *TOPICS, ALL]
    if last == "--profile" and name != "demo":
        from mjlab.tasks.registry import list_profiles

        return list_profiles(before[1])
    if not (partial.startswith("-") or last.startswith("-")):
        return []
    rows = _rows(name, before)
    values = [
        row.placeholder.split("|") for row in rows if row.flag == last and "|" in row.placeholder
    ]
    if values:
        return values[0]
    return ["--help", *(row.flag for row in rows)] if partial.startswith("-") else []


def _rows(name: str, before: list[str]) -> list[Row]:
    """Return the frequent flags of a command and its task."""
    if name == "demo":
        from mjlab.scripts.demo import DEMOS, demo_cfg

        return screen_rows(demo_cfg(DEMOS["go1"]))
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

    kind, task = pkgutil.resolve_name(_CONFIGS[name]), before[1]
    agent = {"agent": load_rl_cfg(task)} if kind.__name__ == "TrainConfig" else {}
    return screen_rows(kind(env=load_env_cfg(task), **agent))


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab completion`."""
    from mjlab.cli.main import ALIASES

    names = " ".join(["mjlab", *ALIASES])
    scripts = {
        "bash": _BASH + names,
        "zsh": _ZSH + names,
        "fish": f"{_FISH}{names}\n    complete -c $name -f -a '(_mjlab_complete)'\nend",
    }
    if argv[:1] == ["--candidates"]:
        print("\n".join(candidates(argv[1:])))
    elif not argv or argv[0] in ("-h", "--help"):
        print(_USAGE)
    elif argv[0] in scripts and len(argv) == 1:
        print(scripts[argv[0]])
    else:
        raise BadCallError(f"{prog}: expected one of {', '.join(scripts)}, got {' '.join(argv)!r}.")


def main() -> None:
    """Entry point of `python -m mjlab.scripts.completion`."""
    from mjlab.cli.main import run_alias

    run_alias("completion")


if __name__ == "__main__":
    main()
