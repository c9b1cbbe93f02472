"""List the registered tasks."""

from __future__ import annotations

import argparse
import sys

from mjlab.cli.main import run_alias
from mjlab.utils.string import counted


def list_environments(keyword: str | None = None) -> list[str]:
    """Return the names of all tasks that contain `keyword`, ignoring case."""
    from mjlab.tasks.registry import list_tasks

    pattern = (keyword or "").lower()
    return [name for name in list_tasks() if pattern in name.lower()]


def command(argv: list[str], prog: str) -> None:
    """Run `list-envs`: exits 0, or 1 if nothing matches."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="List the registered tasks, their profiles, and the minutes of reference runs.",
    )
    parser.add_argument("--keyword", help="show only tasks whose name contains KEYWORD")
    args = parser.parse_args(argv)
    names = list_environments(args.keyword)
    if not names:
        print(f"No task name contains {args.keyword!r}.", file=sys.stderr)
        sys.exit(1)
    from mjlab.tasks.registry import list_profiles

    digits, width = len(str(len(names))), max(map(len, names))
    for number, name in enumerate(names, start=1):
        profiles = list_profiles(name)
        shown = f"(profiles: {', '.join(profiles)})" if profiles else ""
        print(f"{number:>{digits}}  {name:<{width}}  {shown}  {_usual_time(name)}".rstrip())


def _usual_time(task: str) -> str:
    """Return the time of reference runs on a CPU, until solved or stopped, or an empty string."""
    from mjlab.runs.reference import DATA, Reference, reference_path

    path = reference_path(DATA, task, "cpu")
    reference = Reference.load(path) if path.is_file() else None
    if reference is None or not reference.seeds:
        return ""
    minutes, said = reference.usual_minutes, "usually"
    if minutes is None:
        runs = [seed.run for seed in reference.seeds]
        solved = sum(run.ended == "solved" for run in runs)
        minutes = max(run.seconds for run in runs) / 60.0
        said = f"{solved} of {counted(len(runs), 'seed')} solved in"
    profile = "" if reference.profile is None else f" with {reference.profile}"
    teacher = ", after its teacher," if reference.teacher else ""
    cores = counted(reference.seeds[-1].machine["cores"], "core")
    return f"{said} {minutes:.1f} min{profile}{teacher} on {cores}"


def main() -> None:
    """Entry point of `list-envs`."""
    run_alias("list-envs")


if __name__ == "__main__":
    main()
