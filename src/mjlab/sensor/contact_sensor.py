"""Contact sensors: contact count, force, torque, distance, position and frame, and air times.

One MuJoCo `contact` sensor is added per primary. Data has N environments, P primaries and S slots;
column `p * S + s` is slot s of primary p. Contacts fill the slots in order, and empty slots are
zero. Forces and torques are exerted by the primary on its partner: those of a robot at rest sum to
minus its weight, the opposite of Isaac Lab's `net_forces_w`. Values are those of the last substep
simulated; after a reset, those of a full forward. Histories and timers are updated every substep.
Contact histories are newest first, observation histories oldest first.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.compat import offers_older_attributes, suggests_attributes, suggests_fields
from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.utils.errors import WrongStateError, check_one_of
from mjlab.utils.memory import check_memory
from mjlab.utils.mujoco import OBJECT_TYPES
from mjlab.utils.state import stateful
from mjlab.utils.string import compile_pattern, name_list, suggest

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.viewer.debug_visualizer import DebugVisualizer

MatchMode = Literal["geom", "body", "subtree"]
Reduction = Literal["none", "mindist", "maxforce", "netforce"]
SecondaryPolicy = Literal["first", "any", "error"]

FIELD_SIZES = {
    "found": 1,
    "force": 3,
    "torque": 3,
    "dist": 1,
    "pos": 3,
    "normal": 3,
    "tangent": 3,
}
"""Width of each field in one slot, in MuJoCo's order."""

_HISTORY_FIELDS = ("force", "torque", "dist")
_DEBUG_FIELDS = ("found", "force", "pos", "normal", "tangent")

# List of spec elements of each mode.
_ELEMENTS = {"geom": "geoms", "body": "bodies", "subtree": "bodies"}

# Entries of `exclude` with one of these characters are regular expressions.
_REGEX_CHARACTERS = frozenset(r".*+?[]{}()\|^$")

# Debug drawing. Sizes are in units of the model's mean body size, force arrows in m/N as MuJoCo's
# arrows of external forces.
_POINT_COLOR = (0.9, 0.7, 0.1, 1.0)
_POINT_RADIUS = 0.1
_FORCE_COLOR = (0.9, 0.2, 0.2, 0.9)
_FORCE_WIDTH = 0.05
_FORCE_SCALE = 0.005

logger = logging.getLogger(__name__)


@suggests_fields
@dataclass
class ContactSensorCfg(SensorCfg):
    """Contact sensor configuration: contacts of `primary` with `secondary`, or with any geom."""

    primary: ContactMatch
    """Elements whose contacts are measured; one primary per match."""
    secondary: ContactMatch | None = None
    """Contact partner. None: any geom."""
    fields: tuple[str, ...] = ("found", "force")
    """Measured fields, of `found`, `force`, `torque`, `dist`, `pos`, `normal`, `tangent`. Forces and
    torques are exerted by the primary on its partner."""
    reduce: Reduction = "maxforce"
    """Contact selection per primary: `none` (arbitrary order), `mindist`, `maxforce`, or `netforce`
    (sum of all contacts, world frame)."""
    num_slots: int = 1
    """Number of contacts reported per primary."""
    secondary_policy: SecondaryPolicy = "first"
    """Handling of several secondary matches: take the `first`, accept `any` partner, or `error`."""
    track_air_time: bool = False
    """Track air and contact times, independent of `fields`."""
    global_frame: bool = False
    """Rotate force and torque into the world frame. The force of `netforce` is there already."""
    history_length: int = 0
    """Number of substeps of force, torque and dist to keep, newest first. 0: no history."""
    debug: bool = False
    """Draw contact points and forces in viewers."""

    def build(self) -> ContactSensor:
        """Build the sensor."""
        return ContactSensor(self)


@dataclass
class ContactMatch:
    """Selection of geoms, bodies or subtrees."""

    mode: MatchMode
    """Element type: `geom`, `body` (geoms of the body) or `subtree` (geoms of the body and its
    descendants)."""
    pattern: str | tuple[str, ...]
    """With `entity`: regular expressions, matched in full against element names with or without the
    prefix of an attached part (`left/elbow`, `elbow`). Without: literal scene names. May be empty
    until the scene is built."""
    entity: str | None = None
    """Entity name (`terrain` included). None: whole scene."""
    exclude: tuple[str, ...] = ()
    """Names or regular expressions to remove from the matches. An entry with any of
    `.*+?[]{}()\\|^$` is a regular expression that is searched in the name, others are exact."""

    @property
    def patterns(self) -> tuple[str, ...]:
        """`pattern` as a tuple."""
        return (self.pattern,) if isinstance(self.pattern, str) else tuple(self.pattern)


@suggests_attributes
@dataclass
class ContactData:
    """Contact data of N environments. Fields not in `cfg.fields` are None."""

    found: torch.Tensor | None = None
    """Number of matching contacts, (N, P*S). 0 in empty slots."""
    force: torch.Tensor | None = None
    """Contact force of the primary on its partner (N), (N, P*S, 3), in the contact frame (normal,
    tangent, normal x tangent); in the world frame for `netforce` and `global_frame`. A robot at rest
    has minus its weight; the sign is opposite to Isaac Lab's `net_forces_w`."""
    torque: torch.Tensor | None = None
    """Contact torque of the primary on its partner (N m), (N, P*S, 3), in the frame of `force`."""
    dist: torch.Tensor | None = None
    """Signed distance (m), (N, P*S). Negative: penetration."""
    pos: torch.Tensor | None = None
    """Contact position (m), world frame, (N, P*S, 3)."""
    normal: torch.Tensor | None = None
    """Contact normal from primary to secondary, world frame, (N, P*S, 3)."""
    tangent: torch.Tensor | None = None
    """First tangent of the contact frame, world frame, (N, P*S, 3)."""
    current_air_time: torch.Tensor | None = None
    """Time since lift-off (s), (N, P). 0 in contact."""
    last_air_time: torch.Tensor | None = None
    """Duration of the last completed air phase (s), (N, P)."""
    current_contact_time: torch.Tensor | None = None
    """Time since touchdown (s), (N, P). 0 in the air."""
    last_contact_time: torch.Tensor | None = None
    """Duration of the last completed contact phase (s), (N, P)."""
    force_history: torch.Tensor | None = None
    """Force of the last H substeps, newest first, (N, P*S, H, 3). Observation histories are oldest
    first."""
    torque_history: torch.Tensor | None = None
    """Torque of the last H substeps, newest first, (N, P*S, H, 3)."""
    dist_history: torch.Tensor | None = None
    """Distance of the last H substeps, newest first, (N, P*S, H)."""


@offers_older_attributes
class ContactSensor(Sensor[ContactData]):
    """Contact sensor built on MuJoCo's `contact` sensor.

    Each primary has one MuJoCo sensor `<name>_<primary>` with all fields, so the data of all
    primaries is one contiguous block of `sensordata`: primary by primary, slot by slot, field by
    field. One MuJoCo sensor per field would double the cost on both engines.
    """

    earliest_stage = "acc"
    _transient = {
        "_primary_names", "_fields", "_offsets", "_slot_width", "_width", "_start", "_records",
        "_source",
    }  # fmt: skip

    def __init__(self, cfg: ContactSensorCfg) -> None:
        super().__init__()
        self.cfg = cfg
        measured = {*cfg.fields, *(_DEBUG_FIELDS if cfg.debug else ())}
        if cfg.track_air_time:
            measured.add("found")
        if cfg.global_frame:
            measured |= {"normal", "tangent"}
        self._fields = [name for name in FIELD_SIZES if name in measured]
        sizes = [FIELD_SIZES[name] for name in self._fields]
        self._offsets = [sum(sizes[:i]) for i in range(len(sizes))]
        self._slot_width = sum(sizes)
        self._records = cfg.history_length > 0 and any(f in cfg.fields for f in _HISTORY_FIELDS)
        self._primary_names: list[str] = []
        self._start = self._width = 0
        self._sim_data: Any = None
        self._source: torch.Tensor | None = None
        self._history: _SubstepHistory | None = None
        self._clocks: _ContactTimers | None = None

    @property
    def primary_names(self) -> list[str]:
        """Names of the primaries in data order, without entity prefix."""
        return list(self._primary_names)

    @property
    def needs_substep(self) -> bool:
        """True if the sensor keeps a history or air times."""
        return self._records or self.cfg.track_air_time

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """`sensordata`, for a history or air time; nothing if a subclass overrides `update`."""
        overrides_update = type(self).update is not ContactSensor.update
        return ("sensordata",) if self.needs_substep and not overrides_update else ()

    # Building.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add one MuJoCo contact sensor per primary.

        Raises:
            ValueError: unknown reduction or field, pattern without match, ambiguous secondary
                under policy `error`, or a sensor name that is already taken.
        """
        cfg = self.cfg
        owner = f"Contact sensor {cfg.name!r}"
        check_one_of(f"{owner} reduce", cfg.reduce, get_args(Reduction))
        for name in cfg.fields:
            check_one_of(f"{owner} fields", name, FIELD_SIZES)
        primaries = _resolve_match(f"{owner}: primary", cfg.primary, scene_spec, entities)
        secondary = self._resolve_secondary(owner, scene_spec, entities)
        self._primary_names = [primary.name for primary in primaries]
        names = [f"{cfg.name}_{primary}" for primary in self._primary_names]
        # As a key of the scene, the name may hide only an element of another contact sensor.
        hidden = mujoco.mjtSensor.mjSENS_CONTACT
        clashes = sorted(
            sensor.name
            for sensor in scene_spec.sensors
            if sensor.name in names or (sensor.name == cfg.name and sensor.type != hidden)
        )
        if clashes:
            raise ValueError(
                f"{owner}: the scene already has MuJoCo sensors named {clashes}; rename this "
                "sensor."
            )
        field_bits = sum(1 << i for i, name in enumerate(FIELD_SIZES) if name in self._fields)
        # MuJoCo numbers its reductions in this order.
        reduction = get_args(Reduction).index(cfg.reduce)
        for name, primary in zip(names, primaries, strict=True):
            element = scene_spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
            for side, match, found in (
                ("obj", cfg.primary, primary), ("ref", cfg.secondary, secondary),
            ):  # fmt: skip
                if match is not None and found is not None:
                    kind = OBJECT_TYPES[_ELEMENTS[match.mode]]
                    kind = mujoco.mjtObj.mjOBJ_XBODY if match.mode == "subtree" else kind
                    setattr(element, f"{side}type", kind)
                    setattr(element, f"{side}name", found.full_name)
            element.intprm[:3] = [field_bits, reduction, cfg.num_slots]

    def _resolve_secondary(
        self, owner: str, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]
    ) -> _MatchedElement | None:
        cfg = self.cfg
        if cfg.secondary is None or cfg.secondary_policy == "any":
            return None
        found = _resolve_match(f"{owner}: secondary", cfg.secondary, scene_spec, entities)
        if len(found) > 1 and cfg.secondary_policy != "first":
            raise ValueError(
                f"{owner}: secondary pattern {cfg.secondary.pattern!r}: expected one match, got "
                f"{[one.name for one in found]}; narrow the pattern, or set secondary_policy to "
                "'first' or 'any'."
            )
        return found[0]

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Locate the sensor block in `sensordata` and allocate history and timers."""
        cfg = self.cfg
        first = mj_model.sensor(f"{cfg.name}_{self._primary_names[0]}")
        self._start = int(first.adr[0])
        # Columns of the block: primary by primary, slot by slot.
        self._width = len(self._primary_names) * cfg.num_slots * self._slot_width
        self._sim_data = data
        self._source = None
        num_envs = data.qpos.shape[0]
        if self._records:
            self._history = _SubstepHistory(cfg.history_length, num_envs, self._width, device)
        if cfg.track_air_time:
            self._clocks = _ContactTimers(num_envs, len(self._primary_names), device)
        if self.needs_substep:
            # A view first created in the middle of a step would show a newer state than in later
            # steps.
            self._block()

    # Life cycle.

    def update(self, dt: float) -> None:
        """Update history and timers after a physics substep of `dt` seconds."""
        self.invalidate_cache()
        if self.needs_substep:
            self._record(self._block()[None], dt)

    def update_recorded(self, recorded: dict[str, torch.Tensor], dt: float) -> None:
        """Update history and timers after several substeps of `dt` seconds each."""
        self.invalidate_cache()
        self._record(recorded["sensordata"].narrow(-1, self._start, self._width), dt)

    def _record(self, blocks: torch.Tensor, dt: float) -> None:
        """Add blocks (substeps, N, width) to the history and advance the timers."""
        if self._history is not None:
            for block in blocks:
                self._history.record(block)
        if self._clocks is not None:
            # Contacts fill the slots in order: the first slot is nonzero if any slot is.
            column = self._offsets[self._fields.index("found")]
            found = blocks[..., column :: self.cfg.num_slots * self._slot_width]
            for in_contact in found > 0.0:
                self._clocks.update(in_contact, dt)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Clear history and timers of `env_ids` (None: all)."""
        self.invalidate_cache()
        rows = slice(None) if env_ids is None else env_ids
        if self._history is not None:
            self._history.reset(rows)
        if self._clocks is not None:
            self._clocks.reset(rows)

    # Reading.

    def _block(self) -> torch.Tensor:
        """Return the live (N, width) view of the sensor's part of `sensordata`."""
        if self._source is None:
            # Accessing `sensordata` makes the engine copy it out; unread sensors avoid that cost.
            self._source = self._sim_data.sensordata.narrow(1, self._start, self._width)
        return self._source

    def _split(self, block: torch.Tensor, *, to_world: bool) -> dict[str, torch.Tensor]:
        """Return the fields of a block (..., width): (..., P*S) or (..., P*S, 3) each.

        With `to_world`, force and torque F are rotated into the world frame: [n, t, n x t] F.
        """
        slots = block.unflatten(-1, (-1, self._slot_width))
        views = {}
        for name, offset in zip(self._fields, self._offsets, strict=True):
            size = FIELD_SIZES[name]
            views[name] = slots.select(-1, offset) if size == 1 else slots.narrow(-1, offset, size)
        for name in views.keys() & {"force", "torque"} if to_world else ():
            normal, tangent = views["normal"], views["tangent"]
            x, y, z = views[name].unsqueeze(-1).unbind(-2)
            views[name] = x * normal + y * tangent + z * torch.linalg.cross(normal, tangent)
        return views

    def _compute_data(self) -> ContactData:
        # A copy, so that values kept by a term do not change in the next step.
        to_world = self.cfg.global_frame
        values = self._split(self._block().clone(), to_world=to_world)
        data = ContactData(**{name: values[name] for name in self.cfg.fields})
        if self._history is not None:
            recorded = self._split(self._history.newest_first(), to_world=to_world)
            for name in _HISTORY_FIELDS:
                if name in self.cfg.fields:
                    setattr(data, f"{name}_history", recorded[name].movedim(0, 2))
        if self._clocks is not None:
            (
                data.current_air_time,
                data.current_contact_time,
                data.last_air_time,
                data.last_contact_time,
            ) = self._clocks.as_float32()
        return data

    def compute_first_contact(self, dt: float, abs_tol: float = 1e-6) -> torch.Tensor:
        """Return primaries that made contact within the last `dt` seconds, (N, P) bool.

        With `dt` equal to the control timestep and one call per step, each touchdown is reported
        exactly once.

        Raises:
            RuntimeError: `track_air_time` is False.
        """
        time = self._timers("compute_first_contact").contact
        return (time > 0.0) & (time < dt + abs_tol)

    def compute_first_air(self, dt: float, abs_tol: float = 1e-6) -> torch.Tensor:
        """Return primaries that broke contact within the last `dt` seconds, (N, P) bool.

        Raises:
            RuntimeError: `track_air_time` is False.
        """
        time = self._timers("compute_first_air").air
        return (time > 0.0) & (time < dt + abs_tol)

    def _timers(self, method: str) -> _ContactTimers:
        if self._clocks is None:
            raise WrongStateError(
                f"Contact sensor {self.cfg.name!r}: {method} requires air times; set "
                "ContactSensorCfg.track_air_time=True (and initialize the scene)."
            )
        return self._clocks

    # Drawing.

    @property
    def draws(self) -> bool:
        """True if `debug_vis` draws contacts."""
        return self.cfg.debug

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw contact points, and the force acting on each primary, if `cfg.debug`."""
        if not self.cfg.debug:
            return
        # A net force is in the world frame already.
        fields = self._split(self._block(), to_world=self.cfg.reduce != "netforce")
        force = fields["force"]
        size = visualizer.meansize
        visualizer.add_legend(_POINT_COLOR, f"contact points of {self.cfg.name}")
        visualizer.add_legend(_FORCE_COLOR, f"contact forces of {self.cfg.name}")
        for env in visualizer.get_env_indices(force.shape[0]):
            points = fields["pos"][env].double().cpu().numpy()
            forces = force[env].double().cpu().numpy()
            for column in fields["found"][env].cpu().nonzero().flatten().tolist():
                start, label = points[column], f"{self.cfg.name}_{column}"
                visualizer.add_sphere(start, _POINT_RADIUS * size, _POINT_COLOR, label)
                # The force on the primary is the opposite of the sensed force.
                end = start - _FORCE_SCALE * forces[column]
                visualizer.add_arrow(start, end, _FORCE_COLOR, _FORCE_WIDTH * size, label)


@stateful
class _ContactTimers:
    """Air and contact times in float64: float32 drifts by seconds per hour.

    A phase of n substeps is reported as (n + 1) dt: the last substep of a phase is also the first
    substep of the next.
    """

    _transient = {"_running", "_last", "_idle", "_ended", "_contact_is_idle"}

    def __init__(self, num_envs: int, num_primaries: int, device: str) -> None:
        shape = (num_envs, num_primaries)
        # Running air, running contact, last air, last contact.
        self._times = torch.zeros(4, *shape, dtype=torch.float64, device=device)
        self._running, self._last = self._times[:2], self._times[2:]
        # Buffers: idle phases (air, contact), and phases that ended in this substep.
        self._idle = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        self._ended = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        # Air is idle in contact (True), contact is idle in the air (False).
        self._contact_is_idle = torch.tensor([False, True], device=device).view(2, 1, 1)

    def update(self, in_contact: torch.Tensor, dt: float) -> None:
        """Advance by a substep of `dt` seconds that ended with `in_contact`, (N, P) bool."""
        torch.ne(in_contact, self._contact_is_idle, out=self._idle)
        torch.gt(self._running, 0.0, out=self._ended)
        self._ended.logical_and_(self._idle)
        self._running.add_(dt)
        torch.where(self._ended, self._running, self._last, out=self._last)
        self._running.masked_fill_(self._idle, 0.0)

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all durations of some environments to zero."""
        self._times[:, rows] = 0.0

    @property
    def air(self) -> torch.Tensor:
        """Time since lift-off (s), (N, P) float64. 0 in contact."""
        return self._times[0]

    @property
    def contact(self) -> torch.Tensor:
        """Time since touchdown (s), (N, P) float64. 0 in the air."""
        return self._times[1]

    def as_float32(self) -> tuple[torch.Tensor, ...]:
        """Return running air, running contact, last air, last contact (s), (N, P) float32 each."""
        return self._times.float().unbind()


@stateful
class _SubstepHistory:
    """Ring buffer of raw sensor blocks, zero at first; split into fields on read.

    Recording must be cheap, because it happens every substep.
    """

    _transient = {"_slots", "_orders"}

    def __init__(self, length: int, num_envs: int, width: int, device: str) -> None:
        # Values, and two views a slot (1 kB).
        check_memory(
            "ContactSensorCfg history_length",
            length,
            4 * num_envs * width + 1000,
            device,
            "a shorter history",
        )
        self._ring = torch.zeros(length, num_envs, width, dtype=torch.float32, device=device)
        # The newest block; older ones follow it cyclically.
        self._head = 0
        self._slots = list(self._ring.unbind())
        slots = torch.arange(length, device=device).repeat(2)
        self._orders = [slots[head : head + length] for head in range(length)]

    def record(self, block: torch.Tensor) -> None:
        """Replace the oldest block by `block`, (N, width)."""
        self._head = (self._head - 1) % len(self._slots)
        self._slots[self._head].copy_(block)

    def newest_first(self) -> torch.Tensor:
        """Return a copy of the blocks, (length, N, width)."""
        return self._ring.index_select(0, self._orders[self._head])

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all blocks of some environments to zero."""
        self._ring[:, rows] = 0.0


@dataclass(frozen=True)
class _MatchedElement:
    full_name: str
    """Name in the scene."""
    name: str
    """Name in its entity; `full_name` without an entity."""

    @property
    def candidate_names(self) -> tuple[str, str]:
        """Names that a pattern may match: in the entity, and in the attached part."""
        return self.name, self.name.rsplit("/", 1)[-1]

    def is_excluded_by(self, exclude: tuple[str, ...]) -> bool:
        """Return True if an entry of `ContactMatch.exclude` matches the element."""
        return any(
            compile_pattern(entry).search(self.name) is not None
            if _REGEX_CHARACTERS.intersection(entry)
            else entry in self.candidate_names
            for entry in exclude
        )


def _resolve_match(
    owner: str, match: ContactMatch, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]
) -> list[_MatchedElement]:
    """Resolve `match` to elements in spec order; raise on patterns without a match.

    Without an entity, names are literal and elements are in pattern order. `owner` opens messages.
    """
    if not match.patterns or "" in match.patterns:
        raise ValueError(f"{owner} pattern: expected at least one name, got {match.pattern!r}.")
    check_one_of(f"{owner} mode", match.mode, get_args(MatchMode))
    if not match.entity:
        return _resolve_literal(owner, match, scene_spec)
    if match.entity not in entities:
        raise ValueError(
            f"{owner}: unknown entity {match.entity!r}; {suggest(match.entity, entities)}"
        )
    spec = entities[match.entity].spec
    # bodies[0] is the world body.
    elements = list(spec.geoms) if match.mode == "geom" else list(spec.bodies[1:])
    if (unnamed := sum(not element.name for element in elements)) and any(
        compile_pattern(pattern).fullmatch("") for pattern in match.patterns
    ):
        logger.warning(
            "%s: contacts of %d unnamed %s of entity %r are not sensed; name the elements, or use "
            "mode 'body'.",
            owner, unnamed, _ELEMENTS[match.mode], match.entity,
        )  # fmt: skip
    prefix = f"{match.entity}/"
    named = [_MatchedElement(e.name, e.name.removeprefix(prefix)) for e in elements if e.name]
    found = _match_patterns(owner, match, named)
    kept = [one for one in found if not one.is_excluded_by(match.exclude)]
    if not kept:
        raise ValueError(
            f"{owner}: exclude={match.exclude!r} removes all matches of {match.pattern!r}: "
            f"{name_list([one.name for one in found], near=())}."
        )
    return kept


def _resolve_literal(
    owner: str, match: ContactMatch, scene_spec: mujoco.MjSpec
) -> list[_MatchedElement]:
    elements = scene_spec.geoms if match.mode == "geom" else scene_spec.bodies
    names = [element.name for element in elements if element.name]
    for name in match.patterns:
        if name not in names:
            raise ValueError(
                f"{owner}: unknown {match.mode} {name!r} (without ContactMatch.entity, names are "
                f"literal); {suggest(name, names)}"
            )
    if len(set(match.patterns)) != len(match.patterns):
        raise ValueError(f"{owner} pattern: expected distinct names, got {match.pattern!r}.")
    if match.exclude:
        logger.warning("%s: exclude has no effect without ContactMatch.entity.", owner)
    return [_MatchedElement(name, name) for name in match.patterns]


def _match_patterns(
    owner: str, match: ContactMatch, elements: list[_MatchedElement]
) -> list[_MatchedElement]:
    """Return the elements that match exactly one pattern, in spec order."""
    owners: dict[_MatchedElement, str] = {}
    for pattern in match.patterns:
        # A literal name may contain characters that a regular expression reads differently.
        matching = [one for one in elements if one.name == pattern]
        if not matching:
            fullmatch = compile_pattern(pattern).fullmatch
            matching = [one for one in elements if any(map(fullmatch, one.candidate_names))]
        if not matching:
            raise ValueError(
                f"{owner} pattern {pattern!r} matches none of the {_ELEMENTS[match.mode]} of entity "
                f"{match.entity!r} (patterns must match whole names); "
                f"{suggest(pattern, [one.name for one in elements])}"
            )
        for one in matching:
            if one in owners:
                raise ValueError(
                    f"{owner}: patterns {owners[one]!r} and {pattern!r} both match {one.name!r}; "
                    "use patterns that do not overlap."
                )
            owners[one] = pattern
    return [one for one in elements if one in owners]
