"""Run each Python file of a folder in a namespace of its own; exit with the number of failures."""

from __future__ import annotations

import runpy
import sys
import traceback
from pathlib import Path

from mjlab.envs import ManagerBasedRlEnv


def main(folder: Path) -> None:
    """Run the files in order, and build what the functions that return a task's config return."""
    failed = 0
    for path in sorted(folder.glob("*.py")):
        try:
            names = runpy.run_path(str(path))
            for name, value in names.items():
                # Not what the block imports.
                if name.endswith("_env_cfg") and value.__module__ == "<run_path>":
                    ManagerBasedRlEnv(value(), device="cpu").close()
        except Exception:
            failed += 1
            print(f"{path.name}:\n{traceback.format_exc()}", file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
