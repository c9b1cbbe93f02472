"""Effort limits, rotor inertias and gains of position actuators.

A joint has the stiffness of the file's servo, unless that is far below the rule (`STAND_IN`). Rule for a
leg joint: the effort limit per rad, or the static torque of the standing pose per `STATIC_SAG`,
whichever is larger, and at most (`STABLE` / dt)^2 I with the inertia I at the joint, so that the
oscillation is resolved by the time step. Joints that sag by more than `MAX_SAG` in simulation get more. Joints
that serve alike get the largest of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import nnls

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, actuated_joint, drives, like_joints
from mjlab.own_robot.guess import JointGuess, Question, Reason
from mjlab.own_robot.posture import sole_points

MAX_SAG = 0.15
"""Greatest deflection of a leg joint under the robot's weight (rad)."""
STATIC_SAG = 0.14
"""Deflection that gains are computed for (rad)."""
STABLE = 0.5
"""Greatest product of a joint's angular frequency and the time step."""
TIMESTEP = 0.005
"""Time step of the velocity tasks (s)."""
STAND_IN = 0.2
"""Share of the rule's stiffness below which the gain of a file's servo is a stand-in: 0.05 of the
Berkeley Humanoid's ankles, 1 N m/rad with an effort of 20 N m; Apollo's neck has 0.26."""
ARM_ERROR = 0.1
"""Position error at which the joint of an arm has its effort limit (rad)."""
SWAY_MARGIN = 2.5
"""Stiffness of hips against swaying, as a multiple of the smallest stable one, m g h over the legs: the
Aliengo sinks by 24 % at 2, by 18 % at 3."""
MAX_EFFORT = 3.0
"""Effort limit that is plausible, as a multiple of weight x height."""
DAMPING_RATIO = 0.7
"""Damping ratio with the inertia at the joint."""
SETTLE_TIME = 1.5
"""Time in which a robot settles on its legs (s)."""
DROP = 0.05
"""Height from which a robot is dropped on its feet, the largest of the velocity tasks' resets (m)."""
MAX_ROUNDS = 8
"""Rounds of raising the stiffness of joints that sag."""


def find_efforts(
    model: mujoco.MjModel,
    size: float,
    main_joints: tuple[str, ...] = (),
    answers: dict[str, float] | None = None,
) -> tuple[JointGuess, list[Question]]:
    """Return the effort limit of each joint (N m, N), with questions about doubtful ones.

    Args:
        model: Robot.
        size: Height of the trunk, or reach of the arm (m).
        main_joints: Joints of the legs or of the arm, whose motors hardly are all the same.
        answers: Effort limits set by the user, by joint.
    """
    answers = answers or {}
    weight = float(model.body_mass.sum()) * 9.81
    stand_in = 0.25 * weight * size
    limits, reasons = {}, {}
    doubtful: dict[str, list[str]] = {}
    for joint in geo.joint_ids(model):
        name, limit = model.joint(joint).name, file_effort(model, joint)
        if limit is not None and limit <= MAX_EFFORT * weight * size:
            limits[name], reasons[name] = limit, _FILE_EFFORT
            continue
        why = "no limit in the file" if limit is None else f"above {MAX_EFFORT:g} x weight x height"
        limits[name] = stand_in
        reasons[name] = Reason(f"{why}: a quarter of weight x height", "asked")
        if name not in answers:
            doubtful.setdefault(why, []).append(name)
    guess, questions = JointGuess(limits, reasons).answered(answers), []
    if doubtful:
        names = [name for found in doubtful.values() for name in found]
        key = "effort" if len(names) > 1 else f"effort.{names[0]}"
        text = "; ".join(f"{_some(found)}: {why}" for why, found in doubtful.items())
        questions.append(Question(key, f"effort limit of {text}", f"{stand_in:.3g} N m"))
    elif (same := _same_limits(guess.value, main_joints, answers)) is not None:
        text = f"effort limit: {same:g} N m for all of {_some(list(main_joints))}, like a stand-in"
        questions.append(Question("effort", text, f"{same:g} N m"))
        asked = Reason(f"{_FILE_EFFORT.rule}, the same for all", "asked")
        guess = JointGuess(guess.value, guess.reasons | dict.fromkeys(main_joints, asked))
    return guess, questions


_FILE_EFFORT = Reason(
    "tightest of forcerange, actuatorfrcrange and a motor's ctrlrange x gear", "file"
)


def _same_limits(
    limits: dict[str, float], joints: tuple[str, ...], answers: dict[str, float]
) -> float | None:
    """Return the limit that all joints share; None if they differ or one is an answer."""
    values = {limits[name] for name in joints}
    return values.pop() if len(values) == 1 and not set(joints) & set(answers) else None


def _some(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def file_effort(model: mujoco.MjModel, joint: int) -> float | None:
    """Return the tightest effort limit that the file has; None without one."""
    limits = []
    if model.jnt_actfrclimited[joint]:
        limits.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    for actuator in range(model.nu):
        if actuated_joint(model, actuator) != joint:
            continue
        gear = abs(float(model.actuator_gear[actuator, 0]))
        is_motor = int(model.actuator_biastype[actuator]) == mujoco.mjtBias.mjBIAS_NONE
        if model.actuator_forcelimited[actuator]:
            limits.append(gear * float(np.abs(model.actuator_forcerange[actuator]).max()))
        if is_motor and model.actuator_ctrllimited[actuator]:
            gain = abs(float(model.actuator_gainprm[actuator, 0]))
            limits.append(gear * gain * float(np.abs(model.actuator_ctrlrange[actuator]).max()))
    return min(limits, default=None)


def rotor_inertias(
    model: mujoco.MjModel,
    effort: dict[str, float],
    is_arm: bool,
    answers: dict[str, float] | None = None,
) -> tuple[JointGuess, list[Question]]:
    """Return the armature of each joint (kg m^2, kg), with a question where the file has 0."""
    answers = answers or {}
    # 1.1e-4 to 2.5e-4 kg m^2 per N m on Go1 and G1; 1e-3 on UR5e and Panda, with gears of 100.
    share = 1e-3 if is_arm else 2e-4
    inertias, reasons = {}, {}
    for joint in geo.joint_ids(model):
        name = model.joint(joint).name
        own = float(model.dof_armature[model.jnt_dofadr[joint]])
        inertias[name] = own or share * effort[name]
        reasons[name] = (
            Reason("armature of the file", "file")
            if own
            else Reason(f"0 in the file: {share:g} s^2 x effort limit", "asked")
        )
    guess = JointGuess(inertias, reasons).answered(answers)
    missing = [name for name, reason in guess.reasons.items() if reason.source == "asked"]
    if not missing:
        return guess, []
    low, high = min(inertias[n] for n in missing), max(inertias[n] for n in missing)
    question = Question(
        "armature" if len(missing) > 1 else f"armature.{missing[0]}",
        f"rotor inertia times squared gear ratio of {_some(missing)}: 0 in the file",
        f"{share:g} s^2 x effort limit: {low:.2g} to {high:.2g} kg m^2",
    )
    return guess, [question]


def joint_inertias(
    model: mujoco.MjModel, joint_pos: dict[str, float], armature: dict[str, float]
) -> dict[str, float]:
    """Return the inertia at each joint in a pose: diagonal of the mass matrix (kg m^2, kg)."""
    data = mujoco.MjData(model)
    geo.set_pose(model, data, joint_pos)
    mujoco.mj_makeM(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return {
        name: float(mass[dof, dof]) - float(model.dof_armature[dof]) + armature[name]
        for name in joint_pos
        for dof in [model.jnt_dofadr[model.joint(name).id]]
    }


def static_torques(
    model: mujoco.MjModel, anatomy: Anatomy, joint_pos: dict[str, float]
) -> dict[str, float]:
    """Return the torque that holds each joint in the pose (N m, N).

    Of a legged robot, the ground pushes vertically on the soles with the forces (non-negative least
    squares) that carry the trunk.
    """
    data = mujoco.MjData(model)
    geo.set_pose(model, data, joint_pos)
    gravity = model.opt.gravity.copy()
    if not gravity.any():
        model.opt.gravity[2] = -9.81
    mujoco.mj_comVel(model, data)
    mujoco.mj_rne(model, data, 0, data.qfrc_bias)
    model.opt.gravity[:] = gravity
    torque = data.qfrc_bias.copy()  # (nv,)
    free = geo.free_joint(model)
    if free is not None and anatomy.feet.value:
        jacobians = []
        for foot in anatomy.feet.value:
            for point in sole_points(model, data, foot):
                jacobian = np.zeros((3, model.nv))
                mujoco.mj_jac(model, data, jacobian, None, point, model.body(foot.link).id)
                jacobians.append(jacobian[2])
        lift = np.array(jacobians).T  # (nv, P)
        root = slice(int(model.jnt_dofadr[free]), int(model.jnt_dofadr[free]) + 6)
        # Of many solutions, the one with even forces: a small penalty on their squares.
        weight = 1e-2 * np.eye(lift.shape[1])
        rows = np.vstack([lift[root], weight])
        force, _ = nnls(rows, np.concatenate([torque[root], np.zeros(lift.shape[1])]))
        torque = torque - lift @ force
    return {name: float(torque[model.jnt_dofadr[model.joint(name).id]]) for name in joint_pos}


def servo_stiffness(model: mujoco.MjModel) -> dict[str, float]:
    """Return the stiffness of each position servo of the file (N m/rad, N/m)."""
    kinds = drives(model)
    found = {}
    for actuator in range(model.nu):
        joint = actuated_joint(model, actuator)
        if joint is not None and kinds[model.joint(joint).name] == "position":
            gear = float(model.actuator_gear[actuator, 0])
            found[model.joint(joint).name] = -float(model.actuator_biasprm[actuator, 1]) * gear**2
    return found


def find_gains(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    anatomy: Anatomy,
    joint_pos: dict[str, float],
    height: float,
    effort: dict[str, float],
    armature: dict[str, float],
    answers: dict[str, float] | None = None,
) -> tuple[JointGuess, JointGuess, list[Question]]:
    """Return stiffness (N m/rad, N/m) and damping (N m s/rad, N s/m) of each joint, with questions."""
    answers = answers or {}
    legged = anatomy.kind.value == "legged"
    inertia = joint_inertias(model, joint_pos, armature)
    groups = like_joints(anatomy, list(joint_pos), answers)
    stiffness = _file_or_rule(model, anatomy, joint_pos, height, effort, inertia, answers)
    stiffness = stiffness.alike(groups).answered(answers)
    questions = []
    if legged:
        legs = _Legs(spec, model, anatomy, joint_pos, height, effort, armature, inertia, groups)
        stiffness = _hold_weight(legs, stiffness, answers)
        if len(anatomy.legs.value) >= 4 and set(anatomy.leg_joints) - answers.keys():
            stiffness, questions = _stand_on_feet(legs, stiffness, answers)
    return stiffness, _damping(stiffness.value, inertia, legged).alike(groups), questions


@dataclass(frozen=True)
class _Legs:
    """Legged robot that settles on the ground in simulation; see `find_gains`."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    anatomy: Anatomy
    joint_pos: dict[str, float]
    height: float
    effort: dict[str, float]
    armature: dict[str, float]
    inertia: dict[str, float]
    groups: list[tuple[str, ...]]

    def simulated(self, *, free: bool) -> mujoco.MjModel:
        """Return the model with servos, on a rail if not `free`."""
        return rail_model(
            self.spec, self.model, self.anatomy, self.effort, self.armature, free=free
        )

    def damping(self, stiffness: dict[str, float]) -> dict[str, float]:
        """Return the damping with a stiffness."""
        return _damping(stiffness, self.inertia, legged=True).alike(self.groups).value


def _most(inertia: float) -> float:
    """Return the stiffness whose oscillation the time step resolves."""
    return (STABLE / TIMESTEP) ** 2 * inertia


def _file_or_rule(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    joint_pos: dict[str, float],
    height: float,
    effort: dict[str, float],
    inertia: dict[str, float],
    answers: dict[str, float],
) -> JointGuess:
    """Return the stiffness of each joint's servo in the file, or by the rule of this module."""
    legged = anatomy.kind.value == "legged"
    error = 1.0 if legged else ARM_ERROR
    torque, own = static_torques(model, anatomy, joint_pos), servo_stiffness(model)
    sway = _sway_stiffness(model, anatomy, height)
    stiffness, reasons = {}, {}
    for name in joint_pos:
        wanted, rule = max(
            (effort[name] / error, f"effort limit per {'' if legged else f'{ARM_ERROR:g} '}rad"),
            (abs(torque[name]) / STATIC_SAG, f"torque of the weight per {STATIC_SAG:g} rad"),
            (sway.get(name, 0.0), f"{SWAY_MARGIN:g} x weight x height / legs, against swaying"),
        )
        reason = Reason(rule)
        if own.get(name, 0.0) * 0.2 > abs(torque[name]):
            if own[name] < STAND_IN * min(wanted, _most(inertia[name])) and name not in answers:
                reason = Reason(f"{rule}; the file's servo has less than {STAND_IN:g} of it")
            else:
                wanted, reason = own[name], Reason("servo of the file", "file")
        if wanted > _most(inertia[name]):
            step = f"a time step of {1e3 * TIMESTEP:g} ms"
            reason = Reason(f"the most that {step} resolves; wanted: {reason.rule}")
        stiffness[name], reasons[name] = min(wanted, _most(inertia[name])), reason
    return JointGuess(stiffness, reasons)


def _hold_weight(legs: _Legs, stiffness: JointGuess, answers: dict[str, float]) -> JointGuess:
    """Raise the stiffness of leg joints until none sags in simulation by more than `MAX_SAG`."""
    railed = legs.simulated(free=False)
    for _ in range(MAX_ROUNDS):
        values = dict(stiffness.value)
        sag = settle(railed, legs.joint_pos, legs.height, values, legs.damping(values))
        low = {
            name
            for name in legs.anatomy.leg_joints
            if sag[name] > 0.5 * (STATIC_SAG + MAX_SAG) and name not in answers
        }
        if not low:
            break
        for name in low:
            raised = values[name] * min(sag[name] / STATIC_SAG, 2.0)
            # Up to w dt = 1 the joint is stable, though not well resolved.
            values[name] = min(raised, 4.0 * _most(legs.inertia[name]))
        rule = f"raised until the weight bends it by less than {MAX_SAG:g} rad in simulation"
        reasons = stiffness.reasons | dict.fromkeys(low, Reason(rule))
        stiffness = JointGuess(values, reasons).alike(legs.groups).answered(answers)
    return stiffness


def _stand_on_feet(
    legs: _Legs, stiffness: JointGuess, answers: dict[str, float]
) -> tuple[JointGuess, list[Question]]:
    """Stiffen the legs until nothing but the feet touches the ground; ask if no trial stands."""
    joints = set(legs.anatomy.leg_joints) - answers.keys()
    # Like joints stay alike, so the smallest bound of them counts.
    ceiling = {
        name: 4.0 * min(_most(legs.inertia[other]) for other in group)
        for group in legs.groups
        for name in group
    }
    trials = (stiffened(stiffness.value, 1.15**step, ceiling, joints) for step in range(MAX_ROUNDS))
    found = _first_that_stands(legs, trials)
    if found is None:
        text = "stiffness of the legs: other bodies than the feet touch the ground"
        most = f"up to {1.15 ** (MAX_ROUNDS - 1):.2g} times as stiff, or as the time step allows"
        used = "what holds the trunk on a vertical rail"
        return stiffness, [Question("stiffness", f"{text}, {most}", used)]
    factor = max(found[name] / stiffness.value[name] for name in joints)
    raised = {
        name: Reason(f"{reason.rule}; up to x {factor:.2f}, so that only feet touch the ground")
        for name, reason in stiffness.reasons.items()
        if found[name] > stiffness.value[name]
    }
    return JointGuess(found, stiffness.reasons | raised), []


def stiffened(
    stiffness: dict[str, float], factor: float, ceiling: dict[str, float], joints: set[str]
) -> dict[str, float]:
    """Return the stiffness with that of `joints` times `factor`, raised to `ceiling` at most."""
    raised = {
        name: float(f"{max(stiffness[name], min(factor * stiffness[name], ceiling[name])):.3g}")
        for name in joints
    }
    return stiffness | raised


def _first_that_stands(legs: _Legs, trials: Iterable[dict[str, float]]) -> dict[str, float] | None:
    """Return the first stiffness with which the robot stands on its feet alone; None if none does.

    Without a rail, the trunk pitches and sways too: knees of the HyQReal2 that sag by 0.14 rad on the rail
    give way by 0.22 rad, so that its thighs touch the ground.
    """
    model = legs.simulated(free=True)
    fallen = {model.body(name).id for name in legs.anatomy.fall_bodies.value}
    for trial in trials:
        set_gains(model, trial, legs.damping(trial))
        if not _touches(model, fallen, legs.joint_pos, legs.height + DROP):
            return trial
    return None


def _touches(
    model: mujoco.MjModel, bodies: set[int], joint_pos: dict[str, float], height: float
) -> bool:
    """Return True if one of `bodies` touches the ground within `SETTLE_TIME` of standing."""
    data = mujoco.MjData(model)
    geo.set_pose(model, data, joint_pos, height)
    for name, position in joint_pos.items():
        data.ctrl[model.actuator(name).id] = position
    for _ in range(round(SETTLE_TIME / (4 * model.opt.timestep))):
        mujoco.mj_step(model, data, 4)
        if bodies & {int(model.geom_bodyid[g]) for g in data.contact.geom.ravel()}:
            return True
    return False


def _sway_stiffness(model: mujoco.MjModel, anatomy: Anatomy, height: float) -> dict[str, float]:
    """Return the stiffness with which the hips keep four and more legs from swaying over (N m/rad).

    Legs that turn by q about point feet lower the trunk's weight m g by h q^2 / 2, against the work
    k q^2 / 2 in each hip: stable if the sum of k is above m g h. Two legs balance by stepping.
    """
    legs = anatomy.legs.value
    if len(legs) < 4:
        return {}
    weight = 9.81 * float(model.body_subtreemass[model.body(anatomy.trunk.value).id])
    smallest = SWAY_MARGIN * weight * height / len(legs)
    # All joints above the knee, the last but the ankle's.
    return {name: smallest for leg in legs for name in leg.joints[:2]}


def _damping(stiffness: dict[str, float], inertia: dict[str, float], legged: bool) -> JointGuess:
    """Return 2 z sqrt(k I) with the damping ratio z, within the published range of damping over k.

    Published for legs: 1/40 s of Spot and H1, 1/32 of the B2, 1/20 of the Aliengo, 1/16 of the Go1 and G1;
    for arms up to 1/5 s of the UR5e.
    """
    longest = 20.0 if legged else 5.0
    values = {
        name: float(
            np.clip(2.0 * DAMPING_RATIO * np.sqrt(kp * inertia[name]), kp / 40.0, kp / longest)
        )
        for name, kp in stiffness.items()
    }
    rule = f"damping ratio {DAMPING_RATIO:g}, between 1/40 and 1/{longest:g} s of the stiffness"
    return JointGuess.of(values, rule)


def settle(
    model: mujoco.MjModel,
    joint_pos: dict[str, float],
    height: float,
    stiffness: dict[str, float],
    damping: dict[str, float],
) -> dict[str, float]:
    """Return the deflection of each joint (rad, m) after the robot has settled on its legs.

    Args:
        model: Robot on a rail; see `rail_model`.
        joint_pos: Initial position and target of each joint.
        height: Initial height of the trunk (m).
        stiffness: Stiffness of each joint.
        damping: Damping of each joint.
    """
    set_gains(model, stiffness, damping)
    data = mujoco.MjData(model)
    geo.set_pose(model, data, joint_pos, height)
    for name, position in joint_pos.items():
        data.ctrl[model.actuator(name).id] = position
    if geo.free_joint(model) is None:
        data.qpos[model.jnt_qposadr[model.joint(RAIL).id]] = height
    mujoco.mj_step(model, data, round(SETTLE_TIME / model.opt.timestep))
    return {
        name: abs(float(data.qpos[model.jnt_qposadr[model.joint(name).id]]) - position)
        for name, position in joint_pos.items()
    }


RAIL = "trunk_rail"
"""Slide joint that takes the place of the free joint."""


def rail_model(
    spec: mujoco.MjSpec,
    compiled: mujoco.MjModel,
    anatomy: Anatomy,
    effort: dict[str, float],
    armature: dict[str, float],
    *,
    free: bool = False,
) -> mujoco.MjModel:
    """Return the robot on level ground with a position servo per joint.

    Args:
        spec: Robot.
        compiled: `spec`, compiled.
        anatomy: Parts of the robot.
        effort: Effort limit of each joint.
        armature: Armature of each joint.
        free: Keep the free joint; else the trunk slides on a vertical rail.
    """
    spec = spec.copy()
    for elements in (spec.keys, spec.actuators, spec.sensors, spec.pairs):
        for element in list(elements):
            spec.delete(element)
    _drop_visuals(spec, compiled, set(anatomy.colliding.value))
    if not free:
        _put_on_rail(spec.body(anatomy.trunk.value), spec)
    for geom in spec.geoms:
        # The ground collides with the robot; the robot, not with itself.
        geom.contype, geom.conaffinity = 0, 1
        if geom.name in {name for foot in anatomy.feet.value for name in foot.sole}:
            geom.condim = max(3, geom.condim)
    spec.worldbody.add_geom(
        name="rail_ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(5.0, 5.0, 0.1),
        contype=1,
        conaffinity=0,
        friction=(1.0, 0.005, 0.0001),
    )
    for joint in spec.joints:
        if joint.name not in armature:
            continue
        joint.armature = armature[joint.name]
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        # Not what the default class has for the file's actuators.
        actuator.gear = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        actuator.ctrllimited, actuator.ctrlrange = False, (0.0, 0.0)
        actuator.set_to_position(kp=1.0, kv=1.0)
        limit = effort[joint.name]
        actuator.forcelimited, actuator.forcerange = True, (-limit, limit)
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = (0.0, 0.0, -9.81)
    return spec.compile()


def _put_on_rail(trunk: mujoco.MjsBody, spec: mujoco.MjSpec) -> None:
    """Replace the free joint of the trunk by a vertical slide."""
    for joint in list(trunk.joints):
        spec.delete(joint)
    trunk.pos, trunk.quat = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    # Not what the default class has for the robot's joints.
    trunk.add_joint(
        name=RAIL,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(0.0, 0.0, 1.0),
        pos=(0.0, 0.0, 0.0),
        limited=False,
        range=(0.0, 0.0),
        actfrclimited=False,
        actfrcrange=(0.0, 0.0),
        armature=0.0,
        damping=0.0,
        frictionloss=0.0,
        stiffness=0.0,
    )


def set_gains(
    model: mujoco.MjModel, stiffness: dict[str, float], damping: dict[str, float]
) -> None:
    """Write the gains of position servos named like their joints."""
    for name, kp in stiffness.items():
        actuator = model.actuator(name).id
        model.actuator_gainprm[actuator, 0] = kp
        model.actuator_biasprm[actuator, 1:3] = -kp, -damping[name]


def _drop_visuals(spec: mujoco.MjSpec, compiled: mujoco.MjModel, kept: set[str]) -> None:
    """Delete all geoms but `kept`, with their meshes: these take seconds to compile."""
    for body in spec.bodies[1:]:
        own = compiled.body(body.name)
        # Masses that came from geoms.
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = float(own.mass[0]), own.ipos, own.iquat
        body.inertia, body.fullinertia = own.inertia, np.full(6, np.nan)
    for geom in list(spec.geoms):
        if geom.name not in kept:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
