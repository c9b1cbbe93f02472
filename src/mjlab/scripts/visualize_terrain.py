"""Show terrains in the browser: `uv run mjlab visualize-terrain pyramid_stairs`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

import mjlab
from mjlab.cli.main import run_alias
from mjlab.terrains.config import ALL_TERRAIN_PRESETS
from mjlab.utils.errors import check_exists
from mjlab.utils.ranges import Range, Seed, check_ranges
from mjlab.viewer.page_server import check_address, page_url, serve_page
from mjlab.viewer.viser.terrain_page import ALL, RobotName, TerrainPage


@dataclass(frozen=True)
class VisualizeTerrainConfig:
    """Flags of `visualize_terrain`."""

    terrain: Annotated[str, tyro.conf.Positional] = "pyramid_stairs"
    """A preset of `mjlab.terrains.config`, or `all`."""
    num_levels: Annotated[int, Range(1, 10)] = 5
    """Number of difficulty levels in [0, 1]."""
    size: Annotated[float, Range(4.0, 16.0)] = 8.0
    """Extent of each terrain along x and y (m)."""
    seed: Seed = 0
    """Seed of the terrain."""
    robot: RobotName = "unitree_go1"
    """Robot placed at each origin, for scale."""
    host: str = "127.0.0.1"
    """Address of the page. `0.0.0.0`: all interfaces."""
    port: int = 8080
    """Port of the page; the next free port if taken."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab visualize-terrain`."""
    cfg = tyro.cli(VisualizeTerrainConfig, args=argv, prog=prog, config=mjlab.TYRO_FLAGS)
    run_visualize_terrain(cfg)


def run_visualize_terrain(cfg: VisualizeTerrainConfig) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        ValueError: unknown preset, parameter out of range, or invalid address.
    """
    check_address(cfg.host, cfg.port, "--")
    check_exists("terrain preset", cfg.terrain, (ALL, *ALL_TERRAIN_PRESETS))
    check_ranges(cfg, vars(cfg))
    server = serve_page(cfg.host, cfg.port)
    page = TerrainPage(server, cfg.terrain, cfg.num_levels, cfg.size, cfg.seed, cfg.robot)
    print(f"Serving the terrain on {page_url(server)} (Ctrl-C stops).", flush=True)
    try:
        page.run()
    finally:
        server.stop()


def main() -> None:
    """Entry point of `visualize-terrain`."""
    run_alias("visualize-terrain")


if __name__ == "__main__":
    main()
