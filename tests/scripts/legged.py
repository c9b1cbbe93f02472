"""Small legged robots of any size, with two, four or six legs."""

from __future__ import annotations

import mujoco

HINGE = mujoco.mjtJoint.mjJNT_HINGE


def legged_spec(
    legs: int = 4, size: float = 1.0, knee: tuple[float, float] = (-2.6, -0.3), waist: bool = False
) -> mujoco.MjSpec:
    """Return a robot with legs of two links of 0.2 m, times `size`, and motors.

    Two legs have flat feet with ankles, and carry the trunk above them. Names of joints say nothing.

    Args:
        legs: Number of legs.
        size: Scale of lengths; masses scale with its cube.
        knee: Range of the knees (rad).
        waist: Add a torso with an arm on each side, on a waist.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "robot"
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0, 0, 0.5 * size))
    trunk.add_freejoint()
    length = 0.05 if legs == 2 else 0.25
    _box(trunk, size, (length, 0.08, 0.05), 6.0)
    rows = {2: (0.0,), 4: (0.2, -0.2), 6: (0.25, 0.0, -0.25)}[legs]
    for row, x in enumerate(rows):
        for side, y in (("a", 0.12), ("b", -0.12)):
            _add_leg(spec, trunk, f"{side}{row}", (x, y), size, knee, flat=legs == 2)
    if waist:
        torso = trunk.add_body(name="torso", pos=(0, 0, 0.1 * size))
        _hinge(spec, torso, "turn", (0, 0, 1), (-1.0, 1.0), 20.0, size)
        _box(torso, size, (0.05, 0.08, 0.1), 8.0)
        for side, y in (("a", 0.15), ("b", -0.15)):
            arm = torso.add_body(name=f"{side}_arm", pos=(0, y * size, 0.1 * size))
            _hinge(spec, arm, f"{side}_arm", (0, 1, 0), (-2.0, 2.0), 10.0, size)
            _capsule(arm, size, 0.2, 0.5)
    return spec


def _add_leg(spec, trunk, name, place, size, knee, *, flat) -> None:
    x, y = place
    hip = trunk.add_body(name=f"{name}_hip", pos=(x * size, y * size, 0))
    _hinge(spec, hip, f"{name}_1", (1, 0, 0), (-0.8, 0.8), 24.0, size)
    hip.add_geom(size=(0.03 * size, 0, 0), mass=0.3 * size**3, contype=0, conaffinity=0)
    thigh = hip.add_body(name=f"{name}_thigh")
    pitch = (-2.0, 1.0) if flat else (-1.0, 2.5)
    _hinge(spec, thigh, f"{name}_2", (0, 1, 0), pitch, 25.0, size)
    _capsule(thigh, size, 0.2, 0.6)
    calf = thigh.add_body(name=f"{name}_calf", pos=(0, 0, -0.2 * size))
    # Knees of two legs bend forward.
    limits = (-knee[1], -knee[0]) if flat else knee
    _hinge(spec, calf, f"{name}_3", (0, 1, 0), limits, 36.0, size)
    _capsule(calf, size, 0.18, 0.3)
    if not flat:
        calf.add_geom(size=(0.02 * size, 0, 0), pos=(0, 0, -0.2 * size), mass=0.05 * size**3)
        return
    foot = calf.add_body(name=f"{name}_foot", pos=(0, 0, -0.2 * size))
    _hinge(spec, foot, f"{name}_4", (0, 1, 0), (-1.2, 1.2), 20.0, size)
    _box(foot, size, (0.09, 0.04, 0.01), 0.3, (0.03, 0, -0.02))


def _hinge(spec, body, name, axis, limits, effort, size) -> None:
    joint = body.add_joint(name=name, type=HINGE, axis=axis, armature=0.01 * size**5)
    joint.limited, joint.range = True, limits
    motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.ctrllimited, limit = True, effort * size**4
    motor.ctrlrange = (-limit, limit)


def _box(body, size, half, mass, pos=(0, 0, 0)) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[size * h for h in half],
        pos=[size * p for p in pos],
        mass=mass * size**3,
    )


def _capsule(body, size, length, mass) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(0.015 * size, 0, 0),
        fromto=(0, 0, -0.03 * size, 0, 0, -(length - 0.03) * size),
        mass=mass * size**3,
    )
