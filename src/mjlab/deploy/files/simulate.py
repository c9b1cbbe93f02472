"""Run the policy of this folder in plain MuJoCo. Needs numpy, onnxruntime and mujoco.

    python simulate.py                       # in MuJoCo's viewer; arrow keys, Q and E command
    python simulate.py --seconds 10 --command 0.5 0 0    # without a window

`Simulation` is a robot for `runtime.py`: `measure()` and `apply(targets)`. It holds the scene as evaluated.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np
from runtime import Policy

HERE = Path(__file__).resolve().parent


def load_model(folder):
    """Return the model of the scene, with the numbers that XML rounds."""
    model = mujoco.MjModel.from_xml_path(str(Path(folder) / "scene" / "scene.xml"))
    for name, value in np.load(Path(folder) / "scene" / "exact.npz").items():
        holder, field = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
        if value.ndim == 0:
            setattr(holder, field, float(value))
        else:
            getattr(holder, field)[:] = value
    return model


class Simulation:
    """Scene in plain MuJoCo: raw measurements out, motor commands in."""

    def __init__(self, contract, model):
        """Find the elements of the contract in the model."""
        self.contract, self.model, self.data = contract, model, mujoco.MjData(model)
        joints = [model.joint(joint["scene_name"]) for joint in contract["joints"]]
        self.qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self.qvel = np.array([int(joint.dofadr[0]) for joint in joints])
        names = [joint["scene_name"] for joint in contract["joints"]]
        # Joint of each control; -1: not a joint of the robot.
        self.joint_of = [
            names.index(a["joint"]) if a["joint"] in names else -1 for a in contract["actuators"]
        ]
        self.reset()

    def reset(self):
        """Place the robot in its initial pose, at rest, with all joints at their defaults."""
        mujoco.mj_resetData(self.model, self.data)
        if self.model.nkey:
            # The keyframe is that of the initial state.
            mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.nkey - 1)
        self.data.qpos[self.qpos] = [joint["default_pos"] for joint in self.contract["joints"]]
        mujoco.mj_forward(self.model, self.data)

    def set_state(self, **fields):
        """Set fields of the state (qpos, qvel, act, ...), and compute what derives from them."""
        for name, value in fields.items():
            getattr(self.data, name)[:] = value
        mujoco.mj_forward(self.model, self.data)

    def measure(self):
        """Return all measurements of the current state, and `time`.

        Quantities that kinematics do not give (scans, images) are left out.
        """
        found = {"time": self.data.time}
        for measurement in self.contract["measurements"]:
            source = measurement["source"]
            if source["kind"] != "trace":
                found[measurement["name"]] = self._read(source)
        return found

    def compute(self, measured):
        """Return the measurements that kinematics give: from joints, and the orientation of the root."""
        robot, data = self.contract["robot"], self.data
        data.qpos[self.qpos], data.qvel[self.qvel] = measured["joint_pos"], measured["joint_vel"]
        if robot["is_floating"]:
            root = int(self.model.body(robot["root_body"]).jntadr[0])
            start = int(self.model.jnt_qposadr[root]) + 3
            data.qpos[start : start + 4] = measured["root_quat"]
        mujoco.mj_forward(self.model, data)
        entries = (e for e in self.contract["measurements"] if e["availability"] == "computed")
        return {entry["name"]: self._read(entry["source"]) for entry in entries}

    def _read(self, source):
        model, data, kind = self.model, self.data, source["kind"]
        if kind in ("joint_pos", "joint_vel"):
            joints = [model.joint(name) for name in source["joints"]]
            if kind == "joint_pos":
                return data.qpos[[int(joint.qposadr[0]) for joint in joints]]
            return data.qvel[[int(joint.dofadr[0]) for joint in joints]]
        if kind == "sensor":
            return data.sensor(source["sensor"]).data.copy()
        if kind in ("body_pos", "body_quat"):
            body = data.body(source["body"])
            return (body.xpos if kind == "body_pos" else body.xquat).copy()
        if kind in ("body_lin_vel_b", "body_ang_vel_b"):
            velocity = self._velocity(
                mujoco.mjtObj.mjOBJ_XBODY, model.body(source["body"]).id, True
            )
            return velocity[3:] if kind == "body_lin_vel_b" else velocity[:3]
        if kind == "site_lin_vel_w":
            site = model.site(source["site"]).id
            return self._velocity(mujoco.mjtObj.mjOBJ_SITE, site, False)[3:]
        if kind in ("site_pos", "site_quat"):
            return self._pose("site", source["site"])[kind == "site_quat"]
        place, quat = self._pose(source["type"], source["name"])
        root, root_quat = self._pose("body", source["root"])
        inverse, relative = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, root_quat)
        if kind == "frame_pos_b":
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, place - root, inverse)
            return turned
        mujoco.mju_mulQuat(relative, inverse, quat)
        return relative

    def _pose(self, kind, name):
        """Return position and quaternion of a body, site or geom."""
        element = getattr(self.data, kind)(name)
        if kind == "body":
            return element.xpos.copy(), element.xquat.copy()
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, element.xmat)
        return element.xpos.copy(), quat

    def _velocity(self, kind, index, is_local):
        """Return angular and linear velocity of an element."""
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, kind, index, velocity, int(is_local))
        return velocity

    def apply(self, targets):
        """Run one control step with motor commands, and compute what the next measurements read."""
        for _ in range(self.contract["rates"]["decimation"]):
            self.write_controls(targets)
            mujoco.mj_step(self.model, self.data)
        # Sensors are otherwise those before the last physics step.
        mujoco.mj_forward(self.model, self.data)

    def write_controls(self, targets):
        """Write the controls of one physics step, in the order of the scene."""
        for k, (actuator, j) in enumerate(
            zip(self.contract["actuators"], self.joint_of, strict=True)
        ):
            if j < 0:
                continue
            law, gear = actuator["law"], actuator.get("gear", 1.0)
            if law == "position" and targets.is_damping:
                # A servo without stiffness: its target follows the joint.
                control = gear * self.data.qpos[self.qpos[j]]
            elif law in ("position", "velocity"):
                control = gear * getattr(targets, law)[j]
            elif law == "effort":
                control = targets.effort[j] / gear
            elif law == "pd":
                error = targets.position[j] - self.data.qpos[self.qpos[j]]
                speed = targets.velocity[j] - self.data.qvel[self.qvel[j]]
                control = targets.kp[j] * error + targets.kd[j] * speed + targets.effort[j]
                limit = actuator["effort"]
                control = control if limit is None else np.clip(control, -limit, limit)
            else:
                raise ValueError(
                    f"Actuator {actuator['name']!r} has a law of its own: write it here."
                )
            self.data.ctrl[k] = control


class Keys:
    """Command changed by keys, within the ranges of the training."""

    STEPS = {265: (0, 1), 264: (0, -1), 263: (1, 1), 262: (1, -1), 81: (2, 1), 69: (2, -1)}

    def __init__(self, command):
        """Start at zero, a pose without turn, or mid-range; `command` is an entry of the contract."""
        components = command["components"] or [{"range": None}] * command["size"]
        ranges = [component["range"] or (-1.0, 1.0) for component in components]
        self.low, self.high = np.array(ranges).T
        middle = (self.low + self.high) / 2
        self.value = np.where((self.low <= 0) & (self.high >= 0), 0.0, middle)
        self.value[3:4] = 1.0 if command["size"] == 7 else self.value[3:4]
        self.start = self.value.copy()

    def press(self, key):
        """Change the command: arrows, Q and E by a tenth of the range, backspace to the start."""
        if key == 259:
            self.value[:] = self.start
        if key in self.STEPS and self.STEPS[key][0] < len(self.value):
            k, sign = self.STEPS[key]
            moved = self.value[k] + sign * 0.1 * (self.high[k] - self.low[k])
            self.value[k] = np.clip(moved, self.low[k], self.high[k])
            print("command", np.round(self.value, 2))


def play(policy, simulation, command, seconds, viewer=None):
    """Play for `seconds`; return False if the policy ended in damping."""
    policy.reset(measurements=simulation.measure())
    start, targets = time.perf_counter(), None
    for k in range(round(seconds / policy.period)):
        targets = policy.step(simulation.measure(), command())
        simulation.apply(targets)
        if viewer is not None:
            if not viewer.is_running():
                break
            viewer.sync()
            time.sleep(max(0.0, start + (k + 1) * policy.period - time.perf_counter()))
        if targets.is_damping:
            print(f"Damping after {k * policy.period:.2f} s: {targets.reason}.")
            return False
    return True


def begin(simulation):
    """Start an episode: a floating robot at its default, an arm and its objects as in the golden trace."""
    simulation.reset()
    if not simulation.contract["robot"]["is_floating"]:
        trace = np.load(HERE / simulation.contract["golden"]["file"])
        state = {key.removeprefix("state/"): trace[key][0] for key in trace if "state/" in key}
        simulation.set_state(**state)


def main():
    """Play the policy, in the viewer or without."""
    parser = argparse.ArgumentParser(description="Run the policy of this folder in plain MuJoCo.")
    parser.add_argument("--seconds", type=float, help="duration without a window (s)")
    parser.add_argument(
        "--command", type=float, nargs="*", help="constant command, the first of the contract"
    )
    options = parser.parse_args()
    policy = Policy.load(HERE)
    simulation = Simulation(policy.contract, load_model(HERE))
    traced = [m["name"] for m in policy.contract["measurements"] if m["source"]["kind"] == "trace"]
    if traced:
        raise SystemExit(f"Measure these yourself in Simulation.measure: {', '.join(traced)}.")
    given = [command for command in policy.contract["commands"] if command["kind"] == "given"]
    keys = [Keys(command) for command in given]
    if options.command:
        size = len(keys[0].value) if keys else 0
        if len(options.command) != size:
            parser.error(f"--command: expected {size} numbers, got {len(options.command)}")
        keys[0].value[:] = options.command

    def command():
        return {entry["name"]: key.value for entry, key in zip(given, keys, strict=True)}

    begin(simulation)
    if options.seconds is not None:
        stands = play(policy, simulation, command, options.seconds)
        place = simulation.data.body(policy.contract["robot"]["root_body"]).xpos
        print(f"position of the robot after {simulation.data.time:.2f} s: {np.round(place, 3)}")
        raise SystemExit(0 if stands else 1)
    import mujoco.viewer

    on_key = keys[0].press if keys else None
    with mujoco.viewer.launch_passive(
        simulation.model, simulation.data, key_callback=on_key
    ) as viewer:
        while viewer.is_running():
            begin(simulation)
            play(policy, simulation, command, 1e9, viewer)


if __name__ == "__main__":
    main()
