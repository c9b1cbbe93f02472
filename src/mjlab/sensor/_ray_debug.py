"""Drawing what a ray sensor sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from mjlab.viewer.debug_visualizer import DebugVisualizer

Color = tuple[float, float, float, float]

_RAY_WIDTH = 0.1


@dataclass
class VizCfg:
    """How rays are drawn. Lengths are multiples of the model's mean size, colours RGBA."""

    hit_color: Color = (0.0, 1.0, 0.0, 0.8)
    """Colour of rays that hit something."""
    miss_color: Color = (1.0, 0.0, 0.0, 0.4)
    """Colour of rays that hit nothing."""
    hit_sphere_color: Color = (0.0, 1.0, 1.0, 1.0)
    """Colour of the spheres at the points that are hit."""
    hit_sphere_radius: float = 0.5
    """Radius of these spheres."""
    show_rays: bool = False
    """Whether to draw the rays as arrows."""
    show_normals: bool = False
    """Whether to draw surface normals at the points that are hit."""
    normal_color: Color = (1.0, 1.0, 0.0, 1.0)
    """Colour of the normals."""
    normal_length: float = 5.0
    """Length of the normals."""


def draw_rays(
    visualizer: DebugVisualizer,
    name: str,
    viz: VizCfg,
    max_distance: float,
    rays: dict[str, torch.Tensor],
) -> None:
    """Draw the rays of the environments in view.

    Args:
        visualizer: What to draw into.
        name: Name of the sensor, for the labels.
        viz: Colours and sizes.
        max_distance: Reach of the rays (m); a miss is drawn `min(0.5, 0.05 max_distance)` long.
        rays: `origins`, `directions`, `hits`, `normals` (N, R, 3) and `distances` (N, R).
    """
    size = visualizer.meansize
    miss_length = min(0.5, 0.05 * max_distance)
    for env in visualizer.get_env_indices(rays["distances"].shape[0]):
        origins, directions, hits, normals, distances = (
            rays[key][env].detach().cpu().double().numpy()
            for key in ("origins", "directions", "hits", "normals", "distances")
        )
        for i, distance in enumerate(distances):
            hit = distance >= 0.0
            end = hits[i] if hit else origins[i] + miss_length * directions[i]
            if viz.show_rays:
                color = viz.hit_color if hit else viz.miss_color
                visualizer.add_arrow(
                    origins[i], end, color, width=_RAY_WIDTH * size, label=f"{name}_ray_{i}"
                )
            if not hit:
                continue
            visualizer.add_sphere(
                end, viz.hit_sphere_radius * size, viz.hit_sphere_color, label=f"{name}_hit_{i}"
            )
            if viz.show_normals:
                visualizer.add_arrow(
                    end,
                    end + viz.normal_length * size * normals[i],
                    viz.normal_color,
                    width=_RAY_WIDTH * size,
                    label=f"{name}_normal_{i}",
                )
