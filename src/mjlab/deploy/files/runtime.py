"""Run the policy of this folder on a robot. Needs numpy and onnxruntime; read it, and rewrite it.

    policy = Policy.load(".")
    while not policy.is_ready:             # from a standing pose to the first pose of the policy
        send(policy.hand_over(measure()))  # then wait until the period is over
    policy.reset(measurements=measure())
    while True:
        send(policy.step(measure(), command))

`measure()` returns a dict of `time` (s, monotonic) and of all measurements that `contract.json` lists.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime


@dataclass
class Targets:
    """Motor commands of a period: torque = kp (position - q) + kd (velocity - q') + effort."""

    names: list
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    period: float
    is_damping: bool = False
    reason: str = ""


def rotation(q):
    """Return the matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = map(float, q)
    first = (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w))
    second = (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w))
    third = (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y))
    return np.array((first, second, third))


def reading(inputs, term):
    """Return factor * x - offset of the chosen components."""
    x = inputs[0] if term["columns"] is None else inputs[0][term["columns"]]
    x = x if term["factor"] is None else term["factor"] * x
    return x if term["offset"] is None else x - term["offset"]


def pose_error(inputs, term):
    """Return translation and rotation vector from a pose to the commanded pose."""
    place, (w, x, y, z), goal = inputs
    times_conjugate = np.array(((w, x, y, z), (-x, w, -z, y), (-y, z, w, -x), (-z, -y, x, w)))
    turn = times_conjugate @ goal[3:]
    turn = -turn if turn[0] < 0 else turn
    sine = np.linalg.norm(turn[1:])
    ratio = 2 * np.arctan2(sine, turn[0]) / sine if sine > 1e-9 else 2.0
    return np.concatenate((goal[:3] - place, ratio * turn[1:]))


# Formulas of the observation terms: f(values of the inputs, term) -> value.
TERMS = {
    **dict.fromkeys(("reading", "command", "last_action"), reading),
    "cos_sin": lambda i, term: np.array((np.cos(x := reading(i, term)), np.sin(x))).ravel(),
    "gravity": lambda i, term: -rotation(i[0])[2],
    "position_in_frame": lambda i, term: rotation(i[2]).T @ (i[0] - i[1]),
    "vector_in_frame": lambda i, term: rotation(i[1]).T @ i[0],
    "orientation_in_frame": lambda i, term: (rotation(i[1]).T @ rotation(i[0]))[:, :2].ravel(),
    "pose_error": pose_error,
    # A term of your own: "my_package.mdp:wheel_speed": lambda inputs, term: ...
}


class Policy:
    """Policy with its contract, memory, clocks and limits: faults damp until `reset`."""

    @classmethod
    def load(cls, folder, limits=True):
        """Read `contract.json` and `policy.onnx`. Without limits, targets are those of the policy."""
        folder, options = Path(folder), onnxruntime.SessionOptions()
        # More threads than one make the slowest steps a hundred times slower.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        contract = json.loads((folder / "contract.json").read_text(encoding="utf-8"))
        session = onnxruntime.InferenceSession(str(folder / contract["policy"]["file"]), options)
        return cls(contract, session.run, folder, limits)

    def __init__(self, contract, network, folder=".", limits=True):
        """Prepare the terms; `network` answers as `session.run` of onnxruntime does."""
        if (contract["schema"], contract["version"]) != ("mjlab-contract", 1):
            raise ValueError("contract.json: expected schema mjlab-contract, version 1.")
        self.contract, self.network, self._limited, self._handed = contract, network, limits, None
        self.period, joints = contract["rates"]["step_dt"], contract["joints"]
        self.names, keys = [joint["name"] for joint in joints], ("kp", "kd", "default_pos")
        self.kp, self.kd, self.default = (np.array([j[key] for j in joints]) for key in keys)
        lists = {k: np.array(v) for k, v in contract["limits"].items() if isinstance(v, list)}
        self.limits = {**contract["limits"], **lists}
        self._clip, inputs = contract["policy"]["clip"], contract["policy"]["inputs"]
        self.inputs = {entry["name"]: np.zeros(entry["shape"], np.float32) for entry in inputs}
        self._memory = {e["output"]: e["name"] for e in inputs if e["kind"] == "memory"}
        self._outputs = [contract["policy"]["output"], *self._memory]
        self.formulas = {}  # By input and name of the term.
        self._terms = [self._term(o, dict(t)) for o in contract["observations"] for t in o["terms"]]
        self._actions = [self._action(dict(action)) for action in contract["actions"]]
        self._commands = {command["name"]: command for command in contract["commands"]}
        self._given = {f"command/{n}": n for n, c in self._commands.items() if c["kind"] == "given"}
        self._motions = [c for c in contract["commands"] if c["kind"] == "motion"]
        self._entries = {entry["name"]: entry for entry in contract["measurements"]}
        self._turns = {n for n, entry in self._entries.items() if entry.get("is_quaternion")}
        self._entries |= {f"command/{name}": entry for name, entry in self._commands.items()}
        self.motion = next((dict(np.load(Path(folder) / c["file"])) for c in self._motions), {})
        self.values, self.action = {}, np.zeros(contract["policy"]["size"], np.float32)
        self.reset()

    def _term(self, observation, term):
        """Add the formula of a term; return key, settings, slot in the input, size in a history."""
        key, formula = (observation["input"], term["name"]), TERMS.get(term["kind"])
        self.formulas[key] = formula or TERMS.get(term["function"])
        if self.formulas[key] is None:
            raise ValueError(f"Term {term['name']!r}: add {term['function']!r} to TERMS.")
        term |= {k: term[k] and np.array(term[k]) for k in ("offset", "scale")}
        term["inputs"] = ["last_action"] if term["kind"] == "last_action" else term["inputs"]
        place = (0, *(slice(None),) * observation["axis"], slice(term["start"], term["stop"]))
        slot = self.inputs[observation["input"]][place]
        return key, term, slot, term["size"] if term["history"]["length"] else 0

    def _action(self, action):
        """Return an action term with arrays and the places of its joints."""
        if action["kind"] == "custom":
            raise ValueError(f"Action {action['name']!r} is a {action['class']}: compute it here.")
        keys = action.keys() & {"scale", "offset", "open", "closed"}
        action |= {key: np.array(action[key]) for key in keys}
        action["field"] = action["kind"].rpartition("_")[2]  # position, velocity or effort
        clip = action.get("clip") or [[None, None]] * len(action["joints"])
        action["low"], action["high"] = np.array(clip, float).T  # None: NaN, which fmin ignores.
        action["index"] = [self.names.index(name) for name in action["joints"]]
        return action

    def reset(self, motion=0, measurements=None):
        """Clear memory, clocks and faults. A motion begins where the robot is, if it is measured."""
        self.reason, self._time, self._repeated, self._is_first = "", np.nan, 0, True
        self.is_ready, self._start, self._clocks = False, None, {}  # Phase and amplitude by clock.
        # The first jump of targets is that from the last of the hand-over.
        self.action, self._sent, self._handed = np.zeros_like(self.action), self._handed, None
        for entry in self._motions:
            start, length = (entry["motions"][motion][key] for key in ("start", "length"))
            self.frame, self._last = start + entry["start_frame"] - 1, start + length - 1
            self.default = self.motion["joint_pos"][self.frame].astype(float)
            self._anchor = self._aligned(entry, self.frame, measurements or {})
        for name in self._memory.values():
            self.inputs[name][:] = 0.0

    def _aligned(self, entry, frame, robot):
        """Return the path of the motion's anchor, turned and moved over the ground to the robot."""
        data, anchor = self.motion, entry["anchor_index"]
        places, turns = data["body_pos_w"][:, anchor], data["body_quat_w"][:, anchor]
        place = robot.get(entry.get("anchor_pos"), places[frame])
        turn = robot.get(entry.get("anchor_quat"), turns[frame])
        crossed = turns[:, ::-1] * (-1, -1, 1, 1)  # Products of the unit z and each quaternion.
        half = np.arctan2(crossed[frame] @ turn, turns[frame] @ turn)
        cos, sin = np.cos(half), np.sin(half)
        moved = places @ rotation((cos, 0, 0, sin)).T
        return moved + (place - moved[frame]) * (1, 1, 0), cos * turns + sin * crossed

    def step(self, measurements, command=None):
        """Return the motor commands of a period; `command` is of the only given one, or a dict."""
        values = self._checked(measurements)
        self.add_commands(values, command)
        values["last_action"] = self.action
        for key, term, slot, history in self._terms:
            self.values[key] = value = self.formulas[key]([values[n] for n in term["inputs"]], term)
            value = value if term["clip"] is None else np.clip(value, *term["clip"])
            value = value if term["scale"] is None else value * term["scale"]
            if not history:
                slot[:] = value
            elif self._is_first:
                slot.reshape(-1, history)[:] = value
            else:
                slot[:-history], slot[-history:] = slot[history:].copy(), value
        self._is_first, self.action = False, self.infer(self.inputs)
        return (self.damp if self.reason else self.targets)(values["joint_pos"])

    def infer(self, inputs):
        """Return the answer of the network, within the clip of raw actions, and keep its memory."""
        (action,), *memory = self.network(self._outputs, inputs)
        if self._limited and not all(np.isfinite(x.sum()) for x in (action, *inputs.values())):
            self.reason = self.reason or "a command or the answer of the policy is not finite"
        for name, value in zip(self._memory.values(), memory, strict=True):
            self.inputs[name][:] = value
        return action if self._clip is None else action.clip(-self._clip, self._clip)

    def hand_over(self, measurements, seconds=2.0, tolerance=0.3):
        """Move to the first pose in `seconds`; ready within `tolerance`: a Go1 sags by 0.23 rad."""
        q, self._handed = self._checked(measurements)["joint_pos"], None
        if self.reason:
            return self.damp(q)
        begin, pose = self._start = self._start or (self._time, q)
        share = min((self._time - begin) / seconds, 1.0)
        self.is_ready = share == 1.0 and bool(np.abs(q - self.default).max() < tolerance)
        to = self.commanded(pose + share * (self.default - pose))
        self._handed = np.concatenate([getattr(to, a["field"])[a["index"]] for a in self._actions])
        return to

    def damp(self, q):
        """Return commands that only brake: no stiffness, targets at the measured positions."""
        q, zero = np.where(np.isfinite(q), q, self.default), np.zeros(len(self.names))
        return Targets(self.names, q, zero, zero, zero, self.kd, self.period, True, self.reason)

    def commanded(self, position):
        """Return commands of joint positions, with the gains of the contract."""
        velocity, effort = np.zeros((2, len(self.names)))
        return Targets(self.names, position, velocity, effort, self.kp, self.kd, self.period)

    def _sized(self, name, value):
        """Return a measurement or command as an array; raise ValueError for a wrong size."""
        value, entry = np.asarray(value, float), self._entries.get(name)
        if entry is not None and value.size != entry["size"]:
            raise ValueError(f"{name}: expected {entry['size']} numbers, got {value.size}.")
        return value if entry is None else value.reshape(entry["shape"])

    def _checked(self, measurements):
        """Return the values; set `reason` if they are stale, not finite, or beyond the limits."""
        values = {k: self._sized(k, v) for k, v in measurements.items() if k != "time"}
        limits, last, self._time = self.limits, self._time, float(measurements["time"])
        if self.reason or not self._limited:
            return values
        gap = self.period if np.isnan(last) else self._time - last
        self._repeated = self._repeated + 1 if gap <= 0 else 0
        age = max(gap, self._repeated * self.period)
        if not age <= limits["max_age"]:
            self.reason = f"no new measurement for {age:.3f} s"
        elif not np.isfinite(self._time + sum(value.sum() for value in values.values())):
            self.reason = "a measurement is not finite"
        elif (np.abs(values["joint_vel"]) > limits["joint_speed"]).any():
            self.reason = "a joint is faster than limits.joint_speed"
        elif any(abs(np.linalg.norm(values[k]) - 1) > 0.05 for k in values.keys() & self._turns):
            self.reason = "a quaternion is not of length 1"
        elif limits["tilt"] is not None and limits["tilt_from"] is not None:
            _, x, y, _ = values[limits["tilt_from"]]
            if 1 - 2 * (x * x + y * y) < np.cos(limits["tilt"]):
                self.reason = "the robot is tilted by more than limits.tilt"
        return values

    def add_commands(self, values, command):
        """Add given commands, gait clocks and motions to `values`."""
        if not isinstance(command, dict):
            command = dict.fromkeys(self._given.values(), command) if len(self._given) == 1 else {}
        for key, name in self._given.items():
            values[key] = self._sized(key, np.asarray(command[name], float))
        for name, entry in self._commands.items():
            if entry["kind"] == "gait_clock":
                values[f"command/{name}"] = self._clock(entry, values)
            elif entry["kind"] == "motion":
                self._play(f"command/{name}", values)

    def _clock(self, entry, values):
        """Return (A sin, A cos) of a gait clock, after advancing it; float32, as in training."""
        fade, f32 = entry["fade_s"], np.float32
        clock = self._clocks.setdefault(entry["name"], np.array((entry["start"], 0), f32))
        x, y, yaw = values.get(f"command/{entry['velocity_command']}", (np.inf, 0, 0))
        stands = np.hypot(x, y) + abs(yaw) < entry.get("standing_threshold", 0)
        if not self._is_first:
            clock[0] = np.fmod(clock[0] + f32(entry["frequency"] * self.period), f32(1))
            change = f32(-self.period if stands else self.period) / f32(fade or 1.0)
            clock[1] = np.clip(clock[1] + change, f32(0), f32(1))
        amplitude = clock[1] if fade > 0 else f32(not stands)
        phase = clock[0] * f32(2 * np.pi)
        return np.array((amplitude * np.sin(phase), amplitude * np.cos(phase)))

    def _play(self, key, values):
        """Add the next frame of the motion; its last frame is held."""
        self.frame = t = min(self.frame + 1, self._last)
        values[key] = np.concatenate([self.motion[k][t] for k in ("joint_pos", "joint_vel")])
        values[f"{key}/anchor_pos"], values[f"{key}/anchor_quat"] = (x[t] for x in self._anchor)
        if "time_step" in self.inputs:
            self.inputs["time_step"][:] = t

    def targets(self, joint_pos):
        """Return the motor commands of the last action at measured positions, within the limits."""
        parts = []
        for action in self._actions:
            raw = self.action[action["start"] : action["stop"]]
            if action["kind"] == "binary_joint_position":
                target = np.where(raw < 0, action["closed"], action["open"])
            else:
                target = raw * action["scale"] + action["offset"]
            target = np.fmax(np.fmin(target, action["high"]), action["low"])
            is_relative = action["kind"] == "relative_joint_position"
            parts.append(target + is_relative * joint_pos[action["index"]])
        self.target = sent = np.concatenate(parts)
        if self._limited:
            sent = sent.clip(self.limits["target_low"], self.limits["target_high"])
            if self._sent is not None:
                sent = sent.clip(*(self._sent + np.outer((-1, 1), self.limits["target_step"])))
        self._sent, commands = sent, self.commanded(self.default.copy())
        for a in self._actions:
            getattr(commands, a["field"])[a["index"]] = sent[a["target_start"] : a["target_stop"]]
        return commands
