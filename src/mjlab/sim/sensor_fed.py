"""Data fields that MuJoCo computes only for sensors, on either engine.

Without such a sensor they hold zeros on one engine and intermediate results on the other, so an
engine refuses them instead.
"""

from __future__ import annotations

import mujoco

_SENSORS_BY_FIELD = {
    **dict.fromkeys(
        ("cacc", "cfrc_int", "cfrc_ext"),
        ("accelerometer", "force", "torque", "framelinacc", "frameangacc"),
    ),
    **dict.fromkeys(("subtree_linvel", "subtree_angmom"), ("subtreelinvel", "subtreeangmom")),
}


def refuse_without_sensor(model: mujoco.MjModel, field: str) -> None:
    """Raise if `field` is computed only for sensors that `model` does not have, or never.

    Raises:
        AttributeError: names the sensors of which one has to be added, or what to read instead.
    """
    if field == "qfrc_inverse":
        # Inverse dynamics are no part of a step, so it would read zero for ever.
        raise AttributeError(
            "MuJoCo computes MjData.qfrc_inverse in inverse dynamics only, which no step runs. The "
            "forces that drive the joints are qfrc_actuator + qfrc_applied."
        )
    sensors = _SENSORS_BY_FIELD.get(field)
    if sensors is None:
        return
    types = {int(getattr(mujoco.mjtSensor, f"mjSENS_{name.upper()}")) for name in sensors}
    if types.isdisjoint(int(kind) for kind in model.sensor_type):
        raise AttributeError(
            f"MuJoCo computes MjData.{field} only if the model has a sensor that needs it. Add one "
            f"of these sensors to it: {', '.join(sensors)}."
        )
