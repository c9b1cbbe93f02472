"""Contact sensors: what touches what, how hard, where, and for how long."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.compat import offers_older_attributes
from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.utils.state import stateful
from mjlab.utils.string import compile_pattern, name_list

if TYPE_CHECKING:
    import mujoco
    import torch

    from mjlab.entity import Entity
    from mjlab.viewer.debug_visualizer import DebugVisualizer


# MERGED mjlab.sensor.contact_sensor: How long something has been touching, or not: the clocks of feet.


@stateful
class ContactClocks:
    """Durations of the running and of the last completed phases, of contact and of air.

    Time is kept in double precision, because single precision rounds every increment: the clock of
    a foot that has stood for an hour would be off by seconds, and at the end of a day it stands
    still.
    """

    _transient = {"_running", "_last", "_idle", "_ended", "_contact_is_idle", "_zero"}

    def __init__(self, num_envs: int, num_things: int, device: str) -> None:
        """Start `num_things` things in each environment in no phase: all durations are zero."""
        shape = (num_envs, num_things)
        self._times = torch.zeros(4, *shape, dtype=torch.float64, device=device)
        self._running, self._last = self._times[:2], self._times[2:]
        # Scratch: which of air and contact does not run now, and which of them has just ended.
        self._idle = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        self._ended = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        # Air is idle in contact (True), contact is idle in the air (False).
        self._contact_is_idle = torch.tensor([False, True], device=device).view(2, 1, 1)
        self._zero = torch.zeros((), dtype=torch.float64, device=device)

    def update(self, in_contact: torch.Tensor, dt: float) -> None:
        """Advance by a substep of `dt` seconds, after which `in_contact` (N, P) bool are touching.

        The substep in which a phase ends counts as part of it, and as the first one of the next: n
        substeps in the air are reported as (n + 1) dt.
        """
        torch.ne(in_contact, self._contact_is_idle, out=self._idle)
        torch.gt(self._running, 0.0, out=self._ended)
        self._ended.logical_and_(self._idle)
        self._running.add_(dt)
        torch.where(self._ended, self._running, self._last, out=self._last)
        # Faster than `masked_fill_`.
        torch.where(self._idle, self._zero, self._running, out=self._running)

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all durations of some environments to zero."""
        self._times[:, rows] = 0.0

    @property
    def air(self) -> torch.Tensor:
        """(N, P) float64 duration of the running phase of air, s; 0 in contact."""
        return self._times[0]

    @property
    def contact(self) -> torch.Tensor:
        """(N, P) float64 duration of the running phase of contact, s; 0 in the air."""
        return self._times[1]

    def in_single_precision(self) -> tuple[torch.Tensor, ...]:
        """Return running air, running contact, last air, last contact, each (N, P) float32, s."""
        return self._times.float().unbind()


# MERGED mjlab.sensor.contact_sensor: Where in `sensordata` a contact sensor's values are, and in which frame.

FIELD_SIZES = {
    "found": 1,
    "force": 3,
    "torque": 3,
    "dist": 1,
    "pos": 3,
    "normal": 3,
    "tangent": 3,
}
"""Values of each field in one slot, in MuJoCo's order of the fields."""


class ContactLayout:
    """One block of `sensordata`: primary by primary, in each slot by slot, in each field by field."""

    def __init__(self, fields: Iterable[str], num_primaries: int, num_slots: int) -> None:
        wanted = set(fields)
        self.num_primaries = num_primaries
        self.num_slots = num_slots
        self.start = 0
        """Column of `sensordata` at which the block begins."""
        self._columns: dict[str, tuple[int, int]] = {}
        column = 0
        for name, size in FIELD_SIZES.items():
            if name in wanted:
                self._columns[name] = (column, size)
                column += size
        self._width_of_slot = column
        self.width = num_primaries * num_slots * column
        """Number of columns."""

    @property
    def field_bits(self) -> int:
        """The fields as MuJoCo's contact sensor takes them: one bit each."""
        return sum(1 << bit for bit, name in enumerate(FIELD_SIZES) if name in self._columns)

    def split(self, block: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return views of the fields of a block (..., width): (..., P S) or (..., P S, 3) each."""
        slots = block.unflatten(-1, (self.num_primaries * self.num_slots, self._width_of_slot))
        return {
            name: slots.select(-1, column) if size == 1 else slots.narrow(-1, column, size)
            for name, (column, size) in self._columns.items()
        }

    def found_first(self, block: torch.Tensor) -> torch.Tensor:
        """Return the view (..., P) of `found` in the first slot of each primary.

        Contacts fill the slots in order, so it tells whether there is any.
        """
        column, _ = self._columns["found"]
        return block[..., column :: self.num_slots * self._width_of_slot]


def to_world(vector: torch.Tensor, normal: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """Rotate (..., 3) from a contact frame, given by its first two axes, into the world frame.

    F_w = [n t n x t] F_c. Empty slots are zero before and after.
    """
    x, y, z = vector.unsqueeze(-1).unbind(-2)
    return x * normal + y * tangent + z * torch.linalg.cross(normal, tangent)


# MERGED mjlab.sensor.contact_sensor: Drawing of contacts: a ball at each point, an arrow along each force.

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


# MERGED mjlab.sensor.contact_sensor: What a contact sensor measured at the last few physics substeps.


@stateful
class ContactHistory:
    """A ring of raw blocks of sensor data, zero before anything was recorded.

    Blocks are kept as they come, and are taken apart only when somebody reads them: recording has
    to be cheap, because it happens at every substep.
    """

    _transient = {"_slots", "_orders"}

    def __init__(self, length: int, num_envs: int, width: int, device: str) -> None:
        """Make room for `length` blocks of shape (num_envs, width)."""
        # `_head` is the newest block; older ones follow it cyclically.
        self._ring = torch.zeros(length, num_envs, width, dtype=torch.float32, device=device)
        self._head = 0
        self._slots = list(self._ring.unbind())
        slots = torch.arange(length, device=device)
        self._orders = [slots.roll(-head) for head in range(length)]

    def record(self, block: torch.Tensor) -> None:
        """Add a block (N, width), in the place of the oldest one."""
        self._head = (self._head - 1) % len(self._slots)
        self._slots[self._head].copy_(block)

    def newest_first(self) -> torch.Tensor:
        """Return a copy of the blocks, (length, N, width)."""
        return self._ring.index_select(0, self._orders[self._head])

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all blocks of some environments to zero."""
        self._ring[:, rows] = 0.0


# MERGED mjlab.sensor.contact_sensor: Which geoms, bodies or subtrees of the scene a `ContactMatch` means.

logger = logging.getLogger(__name__)
_KINDS = {"geom": "geoms", "body": "bodies", "subtree": "bodies"}

# An entry of `exclude` with one of these characters is a regular expression.
_REGEX_CHARACTERS = frozenset(r".*+?[]{}()\|^$")


@dataclass(frozen=True)
class Matched:
    """An element of the scene."""

    full_name: str
    """Name in the scene."""
    name: str
    """Name in its entity; `full_name` where no entity was given."""

    def known_as(self) -> tuple[str, str]:
        """The names that a pattern may match: in the entity, and in the part it belongs to."""
        return self.name, self.name.rsplit("/", 1)[-1]


def find_matches(
    sensor: str,
    role: str,
    match: ContactMatch,
    scene_spec: mujoco.MjSpec,
    entities: dict[str, Entity],
) -> list[Matched]:
    """Return what `match`, the `role` (primary or secondary) of a sensor, means; never nothing.

    Elements of an entity come in the order of the spec, names of the scene in the order given.

    Raises:
        ValueError: no such entity; no pattern, or an empty one; a pattern that matches nothing
            (with names that are close); a name that two patterns match; everything excluded.
    """
    where = f"Contact sensor {sensor!r}: {role}"
    if not match.patterns or "" in match.patterns:
        raise ValueError(f"{where} pattern: expected at least one name, got {match.pattern!r}.")
    if not match.entity:
        return _find_literal(where, match, scene_spec)
    if match.entity not in entities:
        raise ValueError(
            f"{where} refers to the entity {match.entity!r}. The scene has: {sorted(entities)}."
            f"{_close_names(match.entity, entities)}"
        )
    prefix = f"{match.entity}/"
    elements = _elements(entities[match.entity].spec, match.mode)
    candidates = [Matched(e.name, e.name.removeprefix(prefix)) for e in elements if e.name]
    found = _matched_by_patterns(where, match, candidates)
    _warn_about_unnamed(where, match, elements)
    kept = [one for one in found if not _is_excluded(one, match.exclude)]
    if not kept:
        raise ValueError(
            f"{where}: exclude={match.exclude!r} leaves nothing of what {match.pattern!r} matches: "
            f"{name_list([one.name for one in found], near=())}."
        )
    return kept


def _elements(spec: mujoco.MjSpec, mode: str) -> list[Any]:
    # The first body of a spec is the world, which is nobody's.
    return list(spec.geoms) if mode == "geom" else list(spec.bodies[1:])


def _find_literal(where: str, match: ContactMatch, scene_spec: mujoco.MjSpec) -> list[Matched]:
    elements = scene_spec.geoms if match.mode == "geom" else scene_spec.bodies
    names = [element.name for element in elements if element.name]
    for name in match.patterns:
        if name not in names:
            raise ValueError(
                f"{where} names the {match.mode} {name!r}, which the scene does not have. Without "
                f"ContactMatch.entity, a name is taken literally.{_close_names(name, names)} "
                f"It has: {name_list(names, near=())}."
            )
    if len(set(match.patterns)) != len(match.patterns):
        raise ValueError(f"{where} names an element twice: {match.pattern!r}.")
    if match.exclude:
        logger.warning("%s: exclude has no effect without ContactMatch.entity.", where)
    return [Matched(name, name) for name in match.patterns]


def _matched_by_patterns(
    where: str, match: ContactMatch, candidates: Sequence[Matched]
) -> list[Matched]:
    owners: dict[Matched, str] = {}
    for pattern in match.patterns:
        matching = _matching(pattern, candidates)
        if not matching:
            names = [candidate.name for candidate in candidates]
            raise ValueError(
                f"{where} pattern {pattern!r} matches none of the {_KINDS[match.mode]} of entity "
                f"{match.entity!r}. A pattern must match a whole name."
                f"{_close_names(pattern, names)} It has: {name_list(names, near=())}."
            )
        for candidate in matching:
            if candidate in owners:
                raise ValueError(
                    f"{where}: {candidate.name!r} is matched by both {owners[candidate]!r} and "
                    f"{pattern!r}. Each name may be matched by one pattern only."
                )
            owners[candidate] = pattern
    return [candidate for candidate in candidates if candidate in owners]


def _matching(pattern: str, candidates: Sequence[Matched]) -> list[Matched]:
    # A name that is meant literally may contain what a regular expression reads otherwise.
    exact = [candidate for candidate in candidates if candidate.name == pattern]
    if exact:
        return exact
    regex = compile_pattern(pattern)
    return [c for c in candidates if any(regex.fullmatch(name) for name in c.known_as())]


def _is_excluded(candidate: Matched, exclude: Iterable[str]) -> bool:
    return any(
        compile_pattern(entry).search(candidate.name) is not None
        if _REGEX_CHARACTERS.intersection(entry)
        else entry in candidate.known_as()
        for entry in exclude
    )


def _warn_about_unnamed(where: str, match: ContactMatch, elements: Sequence[Any]) -> None:
    """Say which elements a pattern that matches everything cannot reach."""
    unnamed = sum(1 for element in elements if not element.name)
    if unnamed and any(compile_pattern(p).fullmatch("") for p in match.patterns):
        logger.warning(
            "%s: %d %s of entity %r have no name, so their contacts are not sensed. Name them, or "
            "use mode 'body'.",
            where, unnamed, _KINDS[match.mode], match.entity,
        )  # fmt: skip


def _close_names(name: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(names), n=3)
    return f" Close names: {', '.join(close)}." if close else ""


MatchMode = Literal["geom", "body", "subtree"]
Reduction = Literal["none", "mindist", "maxforce", "netforce"]
SecondaryPolicy = Literal["first", "any", "error"]
_OBJECT_TYPES = {
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "subtree": mujoco.mjtObj.mjOBJ_XBODY,
}
_HISTORY_FIELDS = ("force", "torque", "dist")

# What drawing needs, whether or not the user asked for it.
_DEBUG_FIELDS = ("found", "force", "pos", "normal", "tangent")


@dataclass
class ContactMatch:
    """Elements of the scene whose contacts are meant."""

    mode: MatchMode
    """What the names are of: `geom`, `body` (all geoms of that body), `subtree` (all geoms of that
    body and of the bodies below it)."""
    pattern: str | tuple[str, ...]
    """With `entity`: regular expressions that must match a whole name in the entity. A name inside
    an attached part, such as `left/elbow`, is matched as `left/elbow` and as `elbow`. Without
    `entity`: full names in the scene, taken literally. It may be empty until the scene is built."""
    entity: str | None = None
    """The entity, `terrain` included; None looks in the whole scene."""
    exclude: tuple[str, ...] = ()
    """Names of the entity to leave out of what `pattern` matches. An entry with any of
    `.*+?[]{}()\\|^$` is a regular expression that is searched in the name, others are exact."""

    def __post_init__(self) -> None:
        if self.mode not in get_args(MatchMode):
            raise ValueError(
                f"ContactMatch.mode is {self.mode!r}; choose from: {', '.join(get_args(MatchMode))}."
            )

    @property
    def patterns(self) -> tuple[str, ...]:
        """The patterns, also where there is only one."""
        return (self.pattern,) if isinstance(self.pattern, str) else tuple(self.pattern)


@dataclass
class ContactSensorCfg(SensorCfg):
    """Describes a sensor of the contacts of some elements, with anything or with one other element.

    Every primary has `num_slots` slots, into which `reduce` sorts its contacts. Empty slots are
    zero.
    """

    primary: ContactMatch
    """Whose contacts are sensed: each element that matches is one primary."""
    secondary: ContactMatch | None = None
    """Contact partner: one element, see `secondary_policy`. None: anything."""
    fields: tuple[str, ...] = ("found", "force")
    """What to measure, of: found, force, torque, dist, pos, normal, tangent."""
    reduce: Reduction = "maxforce"
    """Which contacts fill the slots: `none` any of them, in no order to rely on; `mindist` the
    deepest; `maxforce` the strongest; `netforce` one sum of all, in the world frame."""
    num_slots: int = 1
    """Contacts reported for each primary."""
    secondary_policy: SecondaryPolicy = "first"
    """If the secondary patterns match several elements: take the `first`, ignore the secondary and
    sense contacts with `any`thing, or raise an `error`."""
    track_air_time: bool = False
    """Measure how long each primary has been in contact and in the air. Needs the field found."""
    global_frame: bool = False
    """Rotate force and torque from each contact's frame into the world frame. Needs the fields
    normal and tangent. The sum of `netforce` is in the world frame anyway."""
    history_length: int = 0
    """Number of physics substeps for which force, torque and dist are kept; 0 for none."""
    debug: bool = False
    """Draw contact points and forces in the viewers."""

    def __post_init__(self) -> None:
        self._check_choice("reduce", self.reduce, get_args(Reduction))
        self._check_choice("secondary_policy", self.secondary_policy, get_args(SecondaryPolicy))
        if not self.fields or len(set(self.fields)) != len(self.fields):
            self._refuse(f"fields={self.fields!r} must name at least one field, and none twice")
        for name in self.fields:
            self._check_choice("fields", name, tuple(FIELD_SIZES))
        if self.num_slots < 1:
            self._refuse(f"num_slots={self.num_slots} must be at least 1")
        if self.history_length < 0:
            self._refuse(f"history_length={self.history_length} must not be negative")
        if self.track_air_time and "found" not in self.fields:
            self._refuse("track_air_time=True needs 'found' among the fields")
        self._check_global_frame()

    def _check_global_frame(self) -> None:
        if not self.global_frame:
            return
        if self.reduce == "netforce":
            self._refuse(
                "global_frame=True cannot be combined with reduce='netforce', whose sum is in the "
                "world frame already; leave global_frame out"
            )
        missing = [name for name in ("normal", "tangent") if name not in self.fields]
        if missing:
            self._refuse(f"global_frame=True needs {' and '.join(missing)} among the fields")

    def _check_choice(self, field: str, value: str, allowed: tuple[str, ...]) -> None:
        if value not in allowed:
            self._refuse(f"{field} has {value!r}; choose from: {', '.join(allowed)}")

    def _refuse(self, problem: str) -> None:
        raise ValueError(f"Contact sensor {self.name!r}: {problem}.")

    def build(self) -> ContactSensor:
        """Build the sensor."""
        return ContactSensor(self)


@dataclass
class ContactData:
    """What a contact sensor measures, in N environments; None where it was not asked for.

    Column i S + s is slot s of primary i, with P primaries of S slots each. All belong to the
    simulation's derived quantities: one substep old after a step, current after `forward`. Forces
    and torques are what the primary does to the secondary.
    """

    found: torch.Tensor | None = None
    """(N, P S) number of contacts that match, in each slot that is filled; 0 in empty ones."""
    force: torch.Tensor | None = None
    """(N, P S, 3) force in N, in the contact frame (normal, tangent, normal x tangent); in the world
    frame for `netforce` and `global_frame`."""
    torque: torch.Tensor | None = None
    """(N, P S, 3) torque in N m, in the same frame."""
    dist: torch.Tensor | None = None
    """(N, P S) distance in m; negative where they penetrate."""
    pos: torch.Tensor | None = None
    """(N, P S, 3) contact point in the world, m."""
    normal: torch.Tensor | None = None
    """(N, P S, 3) unit vector in the world, from the primary to the secondary."""
    tangent: torch.Tensor | None = None
    """(N, P S, 3) unit vector in the world, the second axis of the contact frame."""
    current_air_time: torch.Tensor | None = None
    """(N, P) time since the primary left, s; 0 in contact."""
    last_air_time: torch.Tensor | None = None
    """(N, P) length of the last phase of air that has ended, s."""
    current_contact_time: torch.Tensor | None = None
    """(N, P) time since the primary touched, s; 0 in the air."""
    last_contact_time: torch.Tensor | None = None
    """(N, P) length of the last phase of contact that has ended, s."""
    force_history: torch.Tensor | None = None
    """(N, P S, H, 3) force after each of the last H substeps, the newest first."""
    torque_history: torch.Tensor | None = None
    """(N, P S, H, 3) torque, likewise."""
    dist_history: torch.Tensor | None = None
    """(N, P S, H) distance, likewise."""


@offers_older_attributes
class ContactSensor(Sensor[ContactData]):
    """Senses contacts by MuJoCo's contact sensors, on either engine.

    For every primary it adds one MuJoCo sensor `<sensor>_<primary>`, which measures all fields: one
    for each field would cost both engines as much again. They lie side by side in `sensordata`, so
    that all reading and recording is of one block.

    Contacts are those of the last substep, in observations too; after a reset they are those of the
    new state, while history and air times are empty.
    """

    earliest_stage = "acc"
    _transient = {"_primary_names", "_layout", "_fields", "_records", "_source"}

    def __init__(self, cfg: ContactSensorCfg) -> None:
        super().__init__()
        self.cfg = cfg
        drawn = _DEBUG_FIELDS if cfg.debug else ()
        self._fields = tuple(dict.fromkeys((*cfg.fields, *drawn)))
        self._records = cfg.history_length > 0 and any(f in cfg.fields for f in _HISTORY_FIELDS)
        self._primary_names: list[str] = []
        self._layout = ContactLayout(self._fields, 0, cfg.num_slots)
        self._sim_data: Any = None
        self._source: torch.Tensor | None = None
        self._history: ContactHistory | None = None
        self._clocks: ContactClocks | None = None

    @property
    def primary_names(self) -> list[str]:
        """Names of the primaries, in the order of the data, without the prefix of their entity."""
        return list(self._primary_names)

    @property
    def needs_substep(self) -> bool:
        """Whether contacts between substeps count: for a history and for air time they do."""
        return self._records or self.cfg.track_air_time

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """`sensordata`, for a history or air time; nothing if a subclass overrides `update`."""
        overrides_update = type(self).update is not ContactSensor.update
        return ("sensordata",) if self.needs_substep and not overrides_update else ()

    # Building.

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the MuJoCo sensors.

        Raises:
            ValueError: a pattern matches nothing, or, under the policy `error`, several secondary
                elements; or the spec has a sensor of one of the names.
        """
        cfg = self.cfg
        primaries = find_matches(cfg.name, "primary", cfg.primary, scene_spec, entities)
        secondary = self._find_secondary(scene_spec, entities)
        self._primary_names = [primary.name for primary in primaries]
        self._layout = ContactLayout(self._fields, len(primaries), cfg.num_slots)
        taken = {sensor.name for sensor in scene_spec.sensors}
        names = (cfg.name, *map(self._element_name, self._primary_names))
        if clashes := sorted(taken.intersection(names)):
            raise ValueError(
                f"Contact sensor {cfg.name!r}: the scene already has MuJoCo sensors of the names "
                f"{clashes}. Rename this sensor."
            )
        for primary in primaries:
            self._add_element(scene_spec, primary, secondary)

    def _find_secondary(
        self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]
    ) -> Matched | None:
        cfg = self.cfg
        if cfg.secondary is None or cfg.secondary_policy == "any":
            return None
        found = find_matches(cfg.name, "secondary", cfg.secondary, scene_spec, entities)
        if len(found) > 1 and cfg.secondary_policy == "error":
            raise ValueError(
                f"Contact sensor {cfg.name!r}: secondary pattern {cfg.secondary.pattern!r} matches "
                f"{[one.name for one in found]}. Narrow it to one, or set secondary_policy to "
                "'first' or 'any'."
            )
        return found[0]

    def _element_name(self, primary: str) -> str:
        return f"{self.cfg.name}_{primary}"

    def _add_element(
        self, scene_spec: mujoco.MjSpec, primary: Matched, secondary: Matched | None
    ) -> None:
        cfg = self.cfg
        element = scene_spec.add_sensor(
            name=self._element_name(primary.name), type=mujoco.mjtSensor.mjSENS_CONTACT
        )
        element.objtype = _OBJECT_TYPES[cfg.primary.mode]
        element.objname = primary.full_name
        if secondary is not None and cfg.secondary is not None:
            element.reftype = _OBJECT_TYPES[cfg.secondary.mode]
            element.refname = secondary.full_name
        # MuJoCo numbers its reductions in this order.
        reduction = get_args(Reduction).index(cfg.reduce)
        element.intprm[:3] = [self._layout.field_bits, reduction, cfg.num_slots]

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Find the sensor's block of `sensordata`, and start history and clocks."""
        cfg = self.cfg
        first = mj_model.sensor(self._element_name(self._primary_names[0]))
        self._layout.start = int(first.adr[0])
        self._sim_data = data
        self._source = None
        num_envs = data.qpos.shape[0]
        if self._records:
            width = self._layout.width
            self._history = ContactHistory(cfg.history_length, num_envs, width, device)
        if cfg.track_air_time:
            self._clocks = ContactClocks(num_envs, len(self._primary_names), device)
        if self.needs_substep:
            # Read in the middle of a step for the first time, it would show a newer state than it
            # does from then on.
            self._block()

    # Life cycle.

    def update(self, dt: float) -> None:
        """Record what the last physics substep, of `dt` seconds, has measured."""
        self.invalidate_cache()
        if self.needs_substep:
            self._record(self._block()[None], dt)

    def update_recorded(self, recorded: dict[str, torch.Tensor], dt: float) -> None:
        """Record what several substeps, of `dt` seconds each, have measured."""
        self.invalidate_cache()
        start = self._layout.start
        self._record(recorded["sensordata"][..., start : start + self._layout.width], dt)

    def _record(self, blocks: torch.Tensor, dt: float) -> None:
        """Add the blocks (substeps, N, width) to the history, and advance the clocks."""
        if self._history is not None:
            for block in blocks:
                self._history.record(block)
        if self._clocks is not None:
            for in_contact in self._layout.found_first(blocks) > 0.0:
                self._clocks.update(in_contact, dt)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Clear history and clocks of these environments; None means all."""
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
            # Asking for `sensordata` makes the engine copy it out, so only a sensor in use does.
            end = self._layout.start + self._layout.width
            self._source = self._sim_data.sensordata[:, self._layout.start : end]
        return self._source

    def _compute_data(self) -> ContactData:
        # A copy, so that what a term keeps of one step does not change in the next.
        values = self._fields_of(self._block().clone())
        data = ContactData(**{name: values[name] for name in self.cfg.fields})
        if self._history is not None:
            recorded = self._fields_of(self._history.newest_first())
            for name in _HISTORY_FIELDS:
                if name in self.cfg.fields:
                    setattr(data, f"{name}_history", recorded[name].movedim(0, 2))
        if self._clocks is not None:
            (
                data.current_air_time,
                data.current_contact_time,
                data.last_air_time,
                data.last_contact_time,
            ) = self._clocks.in_single_precision()
        return data

    def _fields_of(self, block: torch.Tensor) -> dict[str, torch.Tensor]:
        values = self._layout.split(block)
        if self.cfg.global_frame:
            for name in ("force", "torque"):
                if name in values:
                    values[name] = to_world(values[name], values["normal"], values["tangent"])
        return values

    def compute_first_contact(self, dt: float, abs_tol: float = 1e-6) -> torch.Tensor:
        """Return (N, P) bool: whether each primary has touched within the last `dt` seconds.

        Asked once in every environment step, with its length, it tells of each landing once.

        Raises:
            RuntimeError: the sensor does not track air time.
        """
        contact = self._tracked("compute_first_contact").contact
        return (contact > 0.0) & (contact < dt + abs_tol)

    def compute_first_air(self, dt: float, abs_tol: float = 1e-6) -> torch.Tensor:
        """Return (N, P) bool: whether each primary has left within the last `dt` seconds.

        Raises:
            RuntimeError: the sensor does not track air time.
        """
        air = self._tracked("compute_first_air").air
        return (air > 0.0) & (air < dt + abs_tol)

    def _tracked(self, method: str) -> ContactClocks:
        if self._clocks is None:
            raise RuntimeError(
                f"Contact sensor {self.cfg.name!r}: {method} needs air times. Set "
                "ContactSensorCfg.track_air_time=True (and initialize the scene)."
            )
        return self._clocks

    @property
    def draws(self) -> bool:
        """Whether viewers draw the contacts, as the config says."""
        return self.cfg.debug

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw contact points and forces, where the config says `debug`."""
        if self.cfg.debug:
            draw_contacts(visualizer, self._layout.split(self._block()), self.cfg)
