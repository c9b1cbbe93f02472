"""Serving the page that shows a NaN dump."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass

import mujoco

from mjlab.scripts.cli import UserError
from mjlab.utils.nan_guard import NanDump
from mjlab.viewer.page_server import check_address, page_url, serve_page


@dataclass(frozen=True)
class VizNanConfig:
    """Flags of `viz-nan`."""

    host: str = "127.0.0.1"
    """Address to serve on; `0.0.0.0` serves the whole network."""
    port: int = 8080
    """Port to serve on; the next free one where it is taken."""


def run_viz_nan(path: str, cfg: VizNanConfig) -> None:
    """Serve the page of the dump at `path` until Ctrl-C.

    Raises:
        UserError: the dump or its model is missing or cannot be read.
        ValueError: the page cannot be served at that address.
    """
    check_address(cfg.host, cfg.port, "--")
    dump, model = load_dump(path)
    from mjlab.scripts.nan_page import NanPage

    server = serve_page(cfg.host, cfg.port)
    page = NanPage(server, dump, model)
    print(f"Serving {path} on {page_url(server)} (Ctrl-C stops).", flush=True)
    try:
        page.run()
    finally:
        server.stop()


def load_dump(path: str) -> tuple[NanDump, mujoco.MjModel]:
    """Return a dump and the model it was recorded with.

    Raises:
        UserError: either is missing or cannot be read; the text says which and why.
    """
    try:
        dump = NanDump.load(path)
    except ValueError as error:
        raise UserError(str(error)) from error
    except FileNotFoundError:
        raise UserError(
            f"There is no dump {path}. `train --enable-nan-guard True` writes one when a NaN "
            "appears, and says where."
        ) from None
    if not dump.steps:
        raise UserError(f"The dump {path} holds no states.")
    if not dump.model_file.is_file():
        raise UserError(
            f"The dump {path} needs its model, {dump.model_file.name}, in the same folder. Copy "
            "both."
        )
    digest = hashlib.sha256(dump.model_file.read_bytes()).hexdigest()
    # MuJoCo itself reads most damaged models without a word. Earlier dumps do not say.
    if dump.metadata.get("model_sha256", digest) != digest:
        raise UserError(
            f"The model {dump.model_file} is not that of the dump {path}: it was changed or damaged. "
            "Copy both again."
        )
    try:
        model = mujoco.MjModel.from_binary_path(str(dump.model_file))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise UserError(
            f"The model {dump.model_file} cannot be read by MuJoCo {mujoco.__version__}; it has to "
            f"be the version that wrote it. {error}"
        ) from error
    try:
        size = mujoco.mj_stateSize(model, dump.metadata["state_spec"])
        if size != dump.metadata["state_size"]:
            raise ValueError(f"its states have {dump.metadata['state_size']} numbers, not {size}")
        written, data = copy.copy(model), mujoco.MjData(model)
        for step in dump.steps:
            dump.apply(step, 0, written, data)
    except Exception as error:
        raise UserError(
            f"The dump {path} and its model {dump.model_file.name} are not of the same simulation: "
            f"{error}."
        ) from error
    return dump, model
