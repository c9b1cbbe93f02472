"""Drawing of contacts: a ball at each point, an arrow along each force."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.sensor._contact_layout import to_world

if TYPE_CHECKING:
    import torch

    from mjlab.sensor.contact_sensor import ContactSensorCfg
    from mjlab.viewer.debug_visualizer import DebugVisualizer

_POINT_COLOR = (0.9, 0.7, 0.1, 1.0)
_FORCE_COLOR = (0.9, 0.2, 0.2, 0.9)
# Size of the balls and of the arrow shafts, in units of the model's mean body size.
_POINT_RADIUS = 0.1
_ARROW_WIDTH = 0.05
# Length of a force arrow: 5 mm for each newton, as for the arrows of external forces.
_METRES_PER_NEWTON = 0.005


def draw_contacts(
    visualizer: DebugVisualizer, fields: dict[str, torch.Tensor], cfg: ContactSensorCfg
) -> None:
    """Draw the contacts of a sensor in the environments in view.

    Arrows show the force that acts on the primary, which is the opposite of what is sensed.

    Args:
        visualizer: What to draw on.
        fields: found (N, C), force, pos, normal, tangent (N, C, 3), as MuJoCo senses them.
        cfg: Config of the sensor.
    """
    force = fields["force"]
    if cfg.reduce != "netforce":
        force = to_world(force, fields["normal"], fields["tangent"])
    for env in visualizer.get_env_indices(force.shape[0]):
        found = fields["found"][env].cpu()
        points = fields["pos"][env].double().cpu().numpy()
        forces = force[env].double().cpu().numpy()
        for column in found.nonzero().flatten().tolist():
            start = points[column]
            label = f"{cfg.name}_{column}"
            radius = _POINT_RADIUS * visualizer.meansize
            visualizer.add_sphere(start, radius, _POINT_COLOR, label)
            end = start - _METRES_PER_NEWTON * forces[column]
            width = _ARROW_WIDTH * visualizer.meansize
            visualizer.add_arrow(start, end, _FORCE_COLOR, width, label)
