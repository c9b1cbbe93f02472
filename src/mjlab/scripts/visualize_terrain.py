"""Look at terrains in the browser: `python -m mjlab.scripts.visualize_terrain pyramid_stairs`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from mjlab.scripts.cli import UserError, run_command
from mjlab.scripts.terrain_knobs import RobotName


@dataclass(frozen=True)
class VisualizeTerrainConfig:
    """Flags of `visualize_terrain`."""

    terrain: Annotated[str, tyro.conf.Positional] = "pyramid_stairs"
    """A preset of `mjlab.terrains.config`, or `all`."""
    num_levels: int = 5
    """Number of difficulties, from 0 to 1."""
    size: float = 8.0
    """Extent of each terrain along x and y, in metres."""
    seed: int = 0
    """Seed of the terrain."""
    robot: RobotName = "unitree_go1"
    """Robot to place at each start, for scale."""
    host: str = "127.0.0.1"
    """Address to serve on; `0.0.0.0` serves the whole network."""
    port: int = 8080
    """Port to serve on; the next free one where it is taken."""


def _command(argv: list[str]) -> None:
    import mjlab

    cfg = tyro.cli(
        VisualizeTerrainConfig, args=argv, prog="visualize_terrain", config=mjlab.TYRO_FLAGS
    )
    run_visualize_terrain(cfg)


def run_visualize_terrain(cfg: VisualizeTerrainConfig) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        UserError: no such preset, or figures that no terrain can have.
        ValueError: the page cannot be served at that address.
    """
    from mjlab.viewer.page_server import check_address, page_url, serve_page

    check_address(cfg.host, cfg.port, "--")
    from mjlab.terrains.config import ALL_TERRAIN_PRESETS

    if cfg.terrain != "all" and cfg.terrain not in ALL_TERRAIN_PRESETS:
        raise UserError(
            f"There is no terrain preset {cfg.terrain!r}. Choose from: all, "
            f"{', '.join(ALL_TERRAIN_PRESETS)}."
        )
    if not 1 <= cfg.num_levels <= 10 or not 4.0 <= cfg.size <= 16.0 or cfg.seed < 0:
        raise UserError(
            f"num_levels is {cfg.num_levels}, size {cfg.size} and seed {cfg.seed}; they must be "
            "from 1 to 10, from 4 to 16 m, and not negative."
        )
    from mjlab.scripts.terrain_page import TerrainPage

    server = serve_page(cfg.host, cfg.port)
    page = TerrainPage(server, cfg.terrain, cfg.num_levels, cfg.size, cfg.seed, cfg.robot)
    print(f"Serving the terrain on {page_url(server)} (Ctrl-C stops).", flush=True)
    try:
        page.run()
    finally:
        server.stop()


def main() -> None:
    """Entry point of `python -m mjlab.scripts.visualize_terrain`."""
    run_command(_command)


if __name__ == "__main__":
    main()
