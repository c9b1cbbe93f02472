"""State of the code that a run was made with: commit, status and uncommitted changes."""

from __future__ import annotations

import logging
import os
import subprocess
from pathlib import Path

from mjlab.utils.os import replacing

logger = logging.getLogger(__name__)

_INSTALLED = ("site-packages", "dist-packages")


def write_git_diff(run_dir: Path, source: Path) -> Path | None:
    """Write the state of the repository that `source` is in to `git/<repository>.diff`.

    Says so if there are uncommitted changes in it. Returns the file; None if it is there already, or
    if `source` is in no repository, such as that of an installed package.
    """
    # A virtual environment within a checkout is not part of it.
    if any(part in _INSTALLED for part in source.parts):
        return None
    root = _git(source.parent, "rev-parse", "--show-toplevel").strip()
    commit = _git(source.parent, "rev-parse", "--verify", "HEAD").strip()
    path = run_dir / "git" / f"{Path(root).name}.diff"
    if not root or not commit or path.exists():
        return None
    status, diff = _git(Path(root), "status"), _git(Path(root), "diff", "--no-ext-diff", "HEAD")
    path.parent.mkdir(parents=True, exist_ok=True)
    text = (
        f"--- git commit ---\n{commit}\n\n\n--- git status ---\n{status} \n\n\n--- git diff ---\n"
    )
    with replacing(path) as file:
        file.write((text + diff).encode(errors="replace"))
    if diff:
        logger.info(
            "Uncommitted changes of %s are kept in %s; --agent.save-git-diff False leaves them out.",
            root,
            path,
        )
    return path


def _git(folder: Path, *arguments: str) -> str:
    """Return what git prints; nothing if it fails, or is not installed."""
    try:
        told = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
        )
    except OSError:
        return ""
    return told.stdout if told.returncode == 0 else ""
