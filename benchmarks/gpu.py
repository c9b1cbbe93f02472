"""GPU validation: `make gpu`, or `python benchmarks/gpu.py --device cuda:0 --part parity ...`.

Runs on any Python with the dependencies, without a network and without an installed mjlab.
Each part is a process with a time limit. Its JSON, and the table of all parts, are written row by
row, so that failures and time limits do not lose earlier results.

`--device cpu --tiny` runs the same parts, at sizes of a few seconds, on Warp's CPU device.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Generator, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "benchmarks")]

from gpu_parts.options import Options  # noqa: E402 - found by the lines above.
from measure import Row, show  # noqa: E402

MINUTES = 9.5
"""Time for all parts together, by default."""
# Seconds that are left for writing results when the time is over.
_MARGIN = 5.0


@dataclass(frozen=True)
class Part:
    """One table."""

    seconds: float
    """Time limit."""
    least: float
    """Time (s) that parts before it leave for this one."""
    what: str
    """Question it answers, for people."""


PARTS = {
    "kernels": Part(200, 60, "compiles Warp's kernels, the tasks side by side; seconds each"),
    "tests": Part(120, 40, "the tests marked `cuda`: both engines compute the same"),
    "parity": Part(80, 35, "observations and rewards of both engines from the same states"),
    "speed": Part(150, 60, "`env.step` over bare `mujoco_warp`; waits for the GPU, memory"),
    "learning": Part(180, 150, "Go1 flat until it is solved, scored by `evaluate` on fresh seeds"),
    "cameras": Part(60, 40, "images a second"),
}


def time_limit(part: str, later: Iterable[str], left: float) -> float:
    """Return the seconds of a part, of the `left` ones for it and all `later` parts.

    Later parts keep their `least`. Where that is too much, each gets its share of it.
    """
    own, kept = PARTS[part].least, sum(PARTS[name].least for name in later)
    return min(PARTS[part].seconds, max(left - kept, left * own / (own + kept)))


class Record:
    """A part's JSON, written whenever something is added, and with it the table of all parts."""

    def __init__(self, folder: Path, part: str) -> None:
        self.part, self._folder = part, folder
        self.rows: list[Row] = []
        self.content: dict[str, Any] = {"part": part, "status": "running"}
        folder.mkdir(parents=True, exist_ok=True)

    @classmethod
    def read(cls, folder: Path, part: str) -> Record | None:
        """Return what has been written of the part so far, if anything."""
        record = cls(folder, part)
        try:
            record.content = json.loads((folder / f"{part}.json").read_text(encoding="utf-8"))
            record.rows = [Row(**row) for row in record.content["rows"]]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return record

    def add(self, row: Row) -> None:
        """Append a row, print it and write the files."""
        self.rows.append(row)
        print(f"  {row.what}: {row.measured}", flush=True)
        self.write()

    def write(self, **changes: Any) -> None:
        """Write the files, after `changes` of the JSON's entries."""
        self.content.update(changes, rows=[asdict(row) for row in self.rows])
        _write_whole(self._folder / f"{self.part}.json", json.dumps(self.content, indent=2) + "\n")
        _write_whole(self._folder / "table.md", table(self._folder))

    @property
    def passed(self) -> bool:
        """True if the part ended by itself and reached all targets."""
        return self.content["status"] == "done" and all(
            row.reached is not False for row in self.rows
        )

    def text(self) -> str:
        """Return the part as Markdown."""
        seconds = self.content.get("seconds")
        took = "" if seconds is None else f", {seconds:.0f} s"
        lines = [f"## {self.part}: {self.content['status']}{took}", ""]
        if self.rows:
            lines += [show(self.rows), ""]
        if error := self.content.get("error"):
            lines += ["```text", error.rstrip(), "```", ""]
        if machine := self.content.get("machine"):
            about = ", ".join(f"{name} {value}" for name, value in machine.items())
            lines += [f"Measured: {about}.", ""]
        return "\n".join(lines)


def table(folder: Path) -> str:
    """Return all parts that `folder` has, as Markdown."""
    records = [record for part in PARTS if (record := Record.read(folder, part)) is not None]
    return "\n".join(record.text() for record in records)


def _write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all: the process may end at any moment."""
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def run_part(part: str, options: Options) -> bool:
    """Run a part in this process; return whether it passed."""
    begin = time.monotonic()
    record = Record(options.output, part)
    record.write()
    try:
        # Imported here, because what is missing is a failure of the part, by name.
        machine = importlib.import_module("gpu_parts.machine")
        record.write(machine=machine.described(options.device))
        for row in importlib.import_module(f"gpu_parts.{part}").measure(options):
            record.add(row)
    except SystemExit as end:
        record.write(status=str(end), seconds=time.monotonic() - begin)
        raise
    except BaseException as error:
        said = traceback.format_exc()
        record.write(status="failed", error=said, seconds=time.monotonic() - begin)
        print(said, file=sys.stderr, flush=True)
        if not isinstance(error, Exception):
            raise
    else:
        record.write(status="done", seconds=time.monotonic() - begin)
    return record.passed


def start_part(part: str, options: Options, seconds: float) -> Record:
    """Run a part in a separate process, terminated after `seconds`."""
    print(f"\n{part}: {PARTS[part].what} (at most {seconds:.0f} s)", flush=True)
    command = [sys.executable, str(Path(__file__)), "--in-process", "--part", part]
    command += ["--device", options.device, "--output", str(options.output)]
    command += ["--seconds", str(seconds), *(["--tiny"] if options.tiny else [])]
    Record(options.output, part).write()
    begin = time.monotonic()
    with _child(command) as (process, last_lines):
        status = "done" if _waited(process, seconds) else "out of time"
    record = Record.read(options.output, part) or Record(options.output, part)
    if record.content["status"] == "running":
        # The process could not say how it ended: it was killed, or crashed below Python.
        code = process.returncode
        record.write(
            status="out of time" if status == "out of time" else "failed",
            seconds=time.monotonic() - begin,
            error=f"The process ended with {code}. It printed last:\n{''.join(last_lines)}",
        )
    print(record.text(), flush=True)
    return record


@contextlib.contextmanager
def _child(
    command: list[str],
) -> Generator[tuple[subprocess.Popen[str], collections.deque[str]]]:
    """Yield a process whose output is passed on, and its last lines; it does not outlive the block."""
    last_lines: collections.deque[str] = collections.deque(maxlen=40)
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
    )

    def pass_on() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            last_lines.append(line)
            print(line, end="", flush=True)

    reader = threading.Thread(target=pass_on, daemon=True)
    reader.start()
    try:
        yield process, last_lines
    finally:
        if process.poll() is None:
            # First in a way that lets it end what it has started itself.
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
        process.kill()
        process.wait()
        reader.join(5)


def _waited(process: subprocess.Popen[str], seconds: float) -> bool:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return False
    return True


def parse(argv: list[str]) -> argparse.Namespace:
    """Return the flags."""
    width = max(map(len, PARTS))
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="parts:\n" + "\n".join(f"  {n:<{width}}  {p.what}" for n, p in PARTS.items()),
    )
    parser.add_argument("--device", default="cuda:0", help="torch device; cpu with --tiny")
    parser.add_argument(
        "--part", nargs="+", action="extend", choices=PARTS, metavar="PART", help="parts to run"
    )
    parser.add_argument("--minutes", type=float, default=MINUTES, help="time for all of them")
    parser.add_argument("--tiny", action="store_true", help="sizes of a few seconds, for testing")
    parser.add_argument(
        "--output",
        type=Path,
        default=ROOT / "benchmarks/results/gpu",
        help="folder of the table and of each part's JSON",
    )
    parser.add_argument(
        "--in-process", action="store_true", help="run parts here, without limits of time"
    )
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run the parts asked for; return 0 if all of them passed, else 1."""
    flags = parse(sys.argv[1:] if argv is None else argv)
    if not re.fullmatch(r"cpu|cuda(:\d+)?", flags.device):
        raise SystemExit(f"--device: expected cpu, cuda or cuda:<index>, got {flags.device!r}")
    parts = list(dict.fromkeys(flags.part or PARTS))
    # Processes that parts start find modules as this one does, in whichever folder they run.
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(ROOT / "src"), *(os.path.abspath(path) for path in given if path)]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    deadline = time.monotonic() + 60 * flags.minutes

    def options_of(part: str) -> Options:
        seconds = flags.seconds or PARTS[part].seconds
        return Options(flags.device, flags.tiny, flags.output.resolve(), seconds)

    if flags.in_process:
        passed = [run_part(part, options_of(part)) for part in parts]
        return int(not all(passed))
    records = []
    for position, part in enumerate(parts):
        options = options_of(part)
        left = deadline - time.monotonic() - _MARGIN
        seconds = min(options.seconds, time_limit(part, parts[position + 1 :], left))
        if seconds < 1:
            record = Record(options.output, part)
            record.write(status="not started: no time was left")
        else:
            record = start_part(part, options, seconds)
        records.append(record)
    print("\n" + "\n".join(record.text() for record in records))
    missed = [record.part for record in records if not record.passed]
    print(f"Written to {flags.output}." + (f" Not passed: {', '.join(missed)}." if missed else ""))
    return int(bool(missed))


def _end(*_: Any) -> None:
    # Clean-up handlers end the processes and record it in the files.
    raise SystemExit("out of time")


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _end)
    sys.exit(main())
