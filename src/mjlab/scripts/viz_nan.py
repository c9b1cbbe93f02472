"""Show the states that led to a NaN in the browser: `uv run mjlab viz-nan DUMP`."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass

import mujoco

from mjlab.cli.flags import parse_flags
from mjlab.cli.main import run_alias
from mjlab.utils.errors import UserError
from mjlab.utils.nan_guard import NanDump
from mjlab.viewer.page_server import check_address, page_url, serve_page
from mjlab.viewer.viser.nan_page import NanPage


@dataclass(frozen=True)
class VizNanConfig:
    """Flags of `viz-nan`."""

    host: str = "127.0.0.1"
    """Address of the page. `0.0.0.0`: all interfaces."""
    port: int = 8080
    """Port of the page; the next free port if taken."""


def command(argv: list[str], prog: str) -> None:
    """Run `viz-nan`."""
    dump, *flags = argv
    run_viz_nan(dump, parse_flags(VizNanConfig, VizNanConfig(), flags, f"{prog} DUMP"))


def run_viz_nan(path: str, cfg: VizNanConfig) -> None:
    """Serve the page of the dump at `path` until Ctrl-C.

    Raises:
        UserError, ValueError, OSError: invalid address, or see `load_dump`.
    """
    check_address(cfg.host, cfg.port, "--")
    dump, model = load_dump(path)

    server = serve_page(cfg.host, cfg.port)
    page = NanPage(server, dump, model)
    print(f"Serving {path} on {page_url(server)} (Ctrl-C stops).", flush=True)
    try:
        page.run()
    finally:
        server.stop()


def load_dump(path: str) -> tuple[NanDump, mujoco.MjModel]:
    """Return a dump and its model.

    Raises:
        FileNotFoundError: dump or model is missing; the model must be in the folder of the dump.
        ValueError: the file is not a valid dump.
        UserError: the model is damaged, or of another dump.
    """
    dump = NanDump.load(path)
    if not dump.model_file.is_file():
        raise FileNotFoundError(
            f"Dump {path}: model {dump.model_file} not found; copy it to the folder of the dump."
        )
    digest = hashlib.sha256(dump.model_file.read_bytes()).hexdigest()
    # MuJoCo loads most damaged models without an error. Older dumps lack the digest.
    if dump.metadata.get("model_sha256", digest) != digest:
        raise UserError(
            f"Model {dump.model_file}: expected the model of the dump {path}, got a changed or damaged "
            "file; copy both files again."
        )
    try:
        model = mujoco.MjModel.from_binary_path(str(dump.model_file))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise UserError(
            f"Model {dump.model_file}: expected a model written by MuJoCo {mujoco.__version__}, got "
            f"{error}; use the MuJoCo version that wrote the model."
        ) from error
    try:
        size = mujoco.mj_stateSize(model, dump.metadata["state_spec"])
        if size != dump.metadata["state_size"]:
            raise ValueError(f"expected states of size {size}, got {dump.metadata['state_size']}")
        written, data = copy.copy(model), mujoco.MjData(model)
        for step in dump.steps:
            dump.apply(step, 0, written, data)
    except Exception as error:
        raise UserError(
            f"Dump {path}: expected states of the model {dump.model_file.name}, got states of another "
            f"simulation: {error}."
        ) from error
    return dump, model


def main() -> None:
    """Entry point of `viz-nan`."""
    run_alias("viz-nan")


if __name__ == "__main__":
    main()
