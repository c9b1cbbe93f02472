"""Editors of an MjSpec: textures, materials, meshes, geoms, collisions, lights and cameras.

Names are matched by regular expressions at their START (see `mjlab.utils.string`). Geoms that
share a name, unnamed ones among them, are matched together.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from mjlab.compat import accepts_older_fields, older_defaults, set_array_field
from mjlab.utils.errors import check_exists, check_one_of
from mjlab.utils.mujoco import enum_value
from mjlab.utils.string import filter_exp, resolve_field

__all__ = [
    "CameraCfg",
    "CollisionCfg",
    "GeomCfg",
    "LightCfg",
    "MaterialCfg",
    "MeshCfg",
    "SpecCfg",
    "TextureCfg",
    "warn_overlapping_geom_edits",
]
_REQUIRED = ("contype", "conaffinity", "condim", "priority")
_ARRAYS = {"friction": 3, "solref": 2, "solimp": 5}
_PATCHES = (*_ARRAYS, "margin", "gap", "solmix")
_MAX_LISTED = 8
_CUBE_FACES = 6
_LIGHT_FIELDS = (
    *("name", "castshadow", "pos", "dir", "cutoff", "exponent", "diffuse"),
    *("specular", "ambient", "active", "attenuation"),
)
# MuJoCo's enum and the prefix of its members.
_TEXTURE = (mujoco.mjtTexture, "mjTEXTURE_")
_BUILTIN = (mujoco.mjtBuiltin, "mjBUILTIN_")
_MARK = (mujoco.mjtMark, "mjMARK_")
_LIGHT = (mujoco.mjtLightType, "mjLIGHT_")
_CAM_LIGHT = (mujoco.mjtCamLight, "mjCAMLIGHT_")


@dataclass(kw_only=True)
class SpecCfg(ABC):
    """A change to an MjSpec, described by data."""

    @abstractmethod
    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Make the change. Raises `ValueError` if the description is not valid."""

    def validate(self) -> None:
        """Raise `ValueError`, saying which value is not valid and what is allowed."""
        return


@accepts_older_fields
@dataclass
class CollisionCfg(SpecCfg):
    """The collision setup of an entity. Values are given as in `GeomCfg`.

    The four required attributes are always written, so dicts should cover every geom chosen; what
    no pattern names gets contype 1, conaffinity 1, condim 3 or priority 0, with a warning. The
    others are patches.
    """

    geom_names_expr: tuple[str, ...]
    """Patterns that choose the geoms, matched at the start of the name."""
    contype: int | dict[str, int]
    """Collision type bits."""
    conaffinity: int | dict[str, int]
    """Bits of the collision types these geoms collide with."""
    condim: int | dict[str, int]
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int]
    """The geom with the higher priority decides friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Sliding, torsional and rolling friction; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance (m) below which a contact is found."""
    gap: float | dict[str, float] | None = None
    """Distance (m) by which a contact found is inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight, 0 to 1, for averaging the contact parameters of two geoms."""
    disable_other_geoms: bool = True
    """Switch off collisions of every geom that no pattern matches."""
    set_array_field = staticmethod(set_array_field)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Write the setup. Raises `ValueError` if a value is not valid."""
        self.validate()
        geoms, others = _split_geoms(spec, self.geom_names_expr)
        names = tuple(geom.name for geom in geoms)
        required = {field: resolve_field(getattr(self, field), names) for field in _REQUIRED}
        missing = {
            field: [name for name, value in zip(names, values, strict=True) if value is None]
            for field, values in required.items()
        }
        defaults = older_defaults(CollisionCfg, missing)
        for field, values in required.items():
            for geom, value in zip(geoms, values, strict=True):
                setattr(geom, field, defaults[field] if value is None else value)
        for field in _PATCHES:
            _patch(geoms, field, getattr(self, field))
        if self.disable_other_geoms:
            for geom in others:
                geom.contype = geom.conaffinity = 0

    def validate(self) -> None:
        """Raise `ValueError`, naming the field, the pattern and what is allowed."""
        for field in _REQUIRED:
            if getattr(self, field) is None:
                raise ValueError(f"CollisionCfg.{field} is None; it must have a value.")
        _validate_collision(self)


@dataclass
class GeomCfg(SpecCfg):
    """A patch of geoms: what is None, or has no pattern that matches, stays as it is.

    Every attribute is one value for all, or a dict of name pattern (matched at the start of the
    name, the first in dict order counts) to value.
    """

    geom_names_expr: tuple[str, ...]
    """Patterns that choose the geoms, matched at the start of the name."""
    group: int | dict[str, int] | None = None
    """Visualization group, 0 to 5."""
    contype: int | dict[str, int] | None = None
    """Collision type bits."""
    conaffinity: int | dict[str, int] | None = None
    """Bits of the collision types this geom collides with."""
    condim: int | dict[str, int] | None = None
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int] | None = None
    """The geom with the higher priority decides friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Sliding, torsional and rolling friction; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance (m) below which a contact is found."""
    gap: float | dict[str, float] | None = None
    """Distance (m) by which a contact found is inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight, 0 to 1, for averaging the contact parameters of two geoms."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Patch the geoms. Raises `ValueError` if a value is not valid."""
        self.validate()
        geoms, _ = _split_geoms(spec, self.geom_names_expr)
        for field in ("group", *_REQUIRED, *_PATCHES):
            _patch(geoms, field, getattr(self, field))

    def validate(self) -> None:
        """Raise `ValueError`, naming the field, the pattern and what is allowed."""
        check_values(self, "group", lambda value: value in range(6), "from 0 to 5")
        _validate_collision(self)


@dataclass
class MaterialCfg(SpecCfg):
    """Adds a material and, if patterns are given, puts it on geoms."""

    name: str
    """Name of the material."""
    rgba: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Colour and opacity."""
    texuniform: bool = False
    """Repeat the texture per metre instead of per geom."""
    texrepeat: tuple[float, float] = (1.0, 1.0)
    """How often the texture is repeated."""
    reflectance: float = 0.0
    """Reflectance, 0 to 1."""
    texture: str | None = None
    """Name of the texture that gives the colour."""
    geom_names_expr: tuple[str, ...] | None = None
    """Patterns that choose the geoms, matched at the start of the name."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the material. Raises `ValueError` if a value is not valid."""
        self.validate()
        material = spec.add_material(
            name=self.name,
            rgba=self.rgba,
            texuniform=self.texuniform,
            texrepeat=self.texrepeat,
            reflectance=self.reflectance,
        )
        if self.texture is not None:
            material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = self.texture
        if self.geom_names_expr is not None:
            chosen = filter_exp(self.geom_names_expr, tuple(geom.name for geom in spec.geoms))
            for geom in spec.geoms:
                if geom.name in chosen:
                    geom.material = self.name

    def validate(self) -> None:
        """Raise `ValueError` unless both repeats are positive."""
        check_values(self, "texrepeat", lambda value: min(value) > 0, "two positive numbers")


@dataclass
class TextureCfg(SpecCfg):
    """Adds a texture, drawn by MuJoCo (`builtin`) or read from files."""

    name: str
    """Name of the texture."""
    type: Literal["2d", "cube", "skybox"]
    """How it is mapped."""
    builtin: Literal["checker", "gradient", "flat", "none"] = "none"
    """The picture MuJoCo draws."""
    rgb1: tuple[float, float, float] | None = None
    """First colour of the drawn picture; None keeps MuJoCo's."""
    rgb2: tuple[float, float, float] | None = None
    """Second colour of the drawn picture; None keeps MuJoCo's."""
    width: int | None = None
    """Width of the drawn picture in pixels."""
    height: int | None = None
    """Height of the drawn picture in pixels."""
    mark: Literal["edge", "cross", "random", "none"] = "none"
    """Marks drawn on top."""
    markrgb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour of the marks."""
    random: float = 0.01
    """Probability of a dot in each pixel, for random marks."""
    file: str | None = None
    """Image file."""
    cubefiles: tuple[str, ...] | None = None
    """Six image files: right, left, up, down, front, back."""
    gridsize: tuple[int, int] | None = None
    """Rows and columns of the grid of faces in one file."""
    gridlayout: str | None = None
    """Which face each cell of the grid holds, one letter of ".RLUDFB" a cell."""
    nchannel: int = 3
    """Number of colour channels."""
    hflip: bool = False
    """Flip the image horizontally."""
    vflip: bool = False
    """Flip the image vertically."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the texture. Raises `ValueError` if a value is not valid."""
        self.validate()
        texture = spec.add_texture(
            name=self.name,
            type=mujoco_enum(self, "type", _TEXTURE),
            builtin=mujoco_enum(self, "builtin", _BUILTIN),
            mark=mujoco_enum(self, "mark", _MARK),
            markrgb=self.markrgb,
            random=self.random,
            nchannel=self.nchannel,
            hflip=self.hflip,
            vflip=self.vflip,
        )
        for field in ("rgb1", "rgb2", "width", "height", "file", "gridsize"):
            value = getattr(self, field)
            if value is not None:
                setattr(texture, field, value)
        for face, path in enumerate(self.cubefiles or ()):
            texture.cubefiles[face] = path
        for cell, letter in enumerate(self.gridlayout or ""):
            texture.gridlayout[cell] = letter

    def validate(self) -> None:
        """Raise `ValueError` for a texture without a source, a size or a face it needs."""
        for field, enum in (("type", _TEXTURE), ("builtin", _BUILTIN), ("mark", _MARK)):
            mujoco_enum(self, field, enum)
        for field in ("width", "height"):
            check_values(self, field, lambda value: value > 0, "positive")
        drawn = self.builtin != "none"
        if drawn and (self.width is None or self.height is None):
            raise ValueError(
                f"TextureCfg {self.name!r} draws {self.builtin!r} but has width {self.width} and "
                f"height {self.height}; both must be given in pixels."
            )
        if not drawn and self.file is None and not self.cubefiles:
            raise ValueError(
                f"TextureCfg {self.name!r} has no source; set `builtin`, `file` or `cubefiles`."
            )
        if self.cubefiles and len(self.cubefiles) != _CUBE_FACES:
            raise ValueError(
                f"TextureCfg {self.name!r} has {len(self.cubefiles)} cubefiles; it needs "
                f"{_CUBE_FACES} (an empty string leaves a face out)."
            )
        one_image = self.file is not None and self.gridsize in (None, (1, 1), [1, 1])
        if self.type == "skybox" and one_image and not drawn:
            raise ValueError(
                f"TextureCfg {self.name!r} is a skybox made from one image, but six faces are "
                "needed: give `gridsize` and `gridlayout`, or six `cubefiles`."
            )


@dataclass
class MeshCfg(SpecCfg):
    """Changes mesh assets."""

    mesh_names_expr: tuple[str, ...]
    """Patterns that choose the meshes, matched at the start of the name."""
    maxhullvert: int | dict[str, int] | None = None
    """Largest number of vertices of the convex hull: -1 for no limit, else more than 3."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Change the meshes. Raises `ValueError` if a value is not valid."""
        self.validate()
        chosen = set(filter_exp(self.mesh_names_expr, tuple(mesh.name for mesh in spec.meshes)))
        meshes = [mesh for mesh in spec.meshes if mesh.name in chosen]
        values = resolve_field(self.maxhullvert, tuple(mesh.name for mesh in meshes))
        for mesh, value in zip(meshes, values, strict=True):
            if value is not None:
                mesh.maxhullvert = value

    def validate(self) -> None:
        """Raise `ValueError`, naming the pattern, for a limit that is not allowed."""
        check_values(
            self,
            "maxhullvert",
            lambda value: value == -1 or value > 3,
            "-1 or more than 3",
        )


@dataclass
class LightCfg(SpecCfg):
    """Adds a light to a body."""

    name: str | None = None
    """Name of the light, if it has one."""
    body: str = "world"
    """Name of the body it belongs to."""
    mode: str = "fixed"
    """fixed, track, trackcom, targetbody or targetbodycom."""
    target: str | None = None
    """Name of the body the last two modes point at."""
    type: Literal["spot", "directional"] = "spot"
    """Kind of light."""
    castshadow: bool = True
    """Whether things it falls on cast shadows."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame, m."""
    dir: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Direction in the body frame."""
    cutoff: float = 45.0
    """Half the opening angle of a spot, degrees."""
    exponent: float = 10.0
    """How fast a spot fades towards its edge."""
    diffuse: tuple[float, float, float] | None = None
    """Diffuse colour; None keeps MuJoCo's."""
    specular: tuple[float, float, float] | None = None
    """Specular colour; None keeps MuJoCo's."""
    ambient: tuple[float, float, float] | None = None
    """Ambient colour; None keeps MuJoCo's."""
    active: bool = True
    """Whether it is on."""
    attenuation: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Constant, linear and quadratic attenuation with distance."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the light. Raises `ValueError`, with the choices, for an unknown body or mode."""
        self.validate()
        light = find_body(self, spec, self.body).add_light(
            mode=mujoco_enum(self, "mode", _CAM_LIGHT),
            type=mujoco_enum(self, "type", _LIGHT),
        )
        if self.target is not None:
            light.targetbody = find_body(self, spec, self.target).name
        for field in _LIGHT_FIELDS:
            value = getattr(self, field)
            if value is not None:
                setattr(light, field, value)

    def validate(self) -> None:
        """Raise `ValueError` for an unknown mode or type, or a mode without its target."""
        check_one_of("LightCfg.type", self.type, ("spot", "directional"))
        _validate_mode(self)


@dataclass
class CameraCfg(SpecCfg):
    """Adds a camera to a body."""

    name: str
    """Name of the camera."""
    body: str = "world"
    """Name of the body it belongs to."""
    mode: str = "fixed"
    """fixed, track, trackcom, targetbody or targetbodycom."""
    target: str | None = None
    """Name of the body the last two modes point at."""
    fovy: float = 45.0
    """Vertical field of view, degrees."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame, m."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z) in the body frame."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the camera. Raises `ValueError`, with the choices, for an unknown body or mode."""
        self.validate()
        camera = find_body(self, spec, self.body).add_camera(
            name=self.name,
            mode=mujoco_enum(self, "mode", _CAM_LIGHT),
            fovy=self.fovy,
            pos=self.pos,
            quat=self.quat,
        )
        if self.target is not None:
            camera.targetbody = find_body(self, spec, self.target).name

    def validate(self) -> None:
        """Raise `ValueError` for an unknown mode, or one without its target."""
        _validate_mode(self)


def warn_overlapping_geom_edits(
    geom_cfgs: Sequence[GeomCfg],
    collision_cfgs: Sequence[CollisionCfg],
    spec: mujoco.MjSpec,
) -> None:
    """Warn (`UserWarning`) where a `CollisionCfg` overwrites what a `GeomCfg` sets.

    Up to eight of them are listed as "geom.attribute".
    """
    patched = _edited_attributes(geom_cfgs, spec)
    overwritten = _edited_attributes(collision_cfgs, spec)
    for cfg in collision_cfgs:
        if cfg.disable_other_geoms:
            _, others = _split_geoms(spec, cfg.geom_names_expr)
            for geom in others:
                overwritten |= {(geom.name, "contype"), (geom.name, "conaffinity")}
    overlap = sorted(patched & overwritten)
    if overlap:
        listed = ", ".join(f"{geom}.{field}" for geom, field in overlap[:_MAX_LISTED])
        more = len(overlap) - _MAX_LISTED
        warnings.warn(
            f"A CollisionCfg overwrites what a GeomCfg sets: {listed}"
            + (f" and {more} more." if more > 0 else "."),
            UserWarning,
            stacklevel=2,
        )


def _edited_attributes(
    cfgs: Sequence[GeomCfg] | Sequence[CollisionCfg], spec: mujoco.MjSpec
) -> set[tuple[str, str]]:
    edited = set()
    for cfg in cfgs:
        geoms, _ = _split_geoms(spec, cfg.geom_names_expr)
        names = tuple(geom.name for geom in geoms)
        for field in (*_REQUIRED, *_PATCHES):
            always = isinstance(cfg, CollisionCfg) and field in _REQUIRED
            values = names if always else resolve_field(getattr(cfg, field), names)
            edited |= {
                (name, field)
                for name, value in zip(names, values, strict=True)
                if value is not None
            }
    return edited


def _split_geoms(
    spec: mujoco.MjSpec, patterns: Sequence[str]
) -> tuple[list[mujoco.MjsGeom], list[mujoco.MjsGeom]]:
    """Return the geoms that a pattern matches, and the others."""
    chosen = set(filter_exp(tuple(patterns), tuple(geom.name for geom in spec.geoms)))
    matched = [geom for geom in spec.geoms if geom.name in chosen]
    return matched, [geom for geom in spec.geoms if geom.name not in chosen]


def _patch(geoms: Sequence[mujoco.MjsGeom], field: str, value: Any) -> None:
    if value is None:
        return
    values = resolve_field(value, tuple(geom.name for geom in geoms))
    for geom, entry in zip(geoms, values, strict=True):
        if entry is None:
            continue
        if field in _ARRAYS:
            getattr(geom, field)[: len(entry)] = entry
        else:
            setattr(geom, field, entry)


def _validate_collision(cfg: GeomCfg | CollisionCfg) -> None:
    for field in ("contype", "conaffinity", "priority", "margin", "gap"):
        check_values(cfg, field, lambda value: value >= 0, "at least 0")
    check_values(cfg, "condim", lambda value: value in (1, 3, 4, 6), "1, 3, 4 or 6")
    check_values(cfg, "solmix", lambda value: 0 <= value <= 1, "from 0 to 1")
    for field, size in _ARRAYS.items():
        check_values(
            cfg,
            field,
            lambda value, size=size: isinstance(value, (tuple, list)) and 1 <= len(value) <= size,
            f"a tuple of 1 to {size} numbers",
        )


def _validate_mode(cfg: LightCfg | CameraCfg) -> None:
    mujoco_enum(cfg, "mode", _CAM_LIGHT)
    if cfg.mode.startswith("target") and cfg.target is None:
        raise ValueError(
            f"{type(cfg).__name__} {cfg.name!r} has mode {cfg.mode!r}, which needs `target`, the "
            "name of the body to point at."
        )


def check_values(owner: SpecCfg, field: str, is_valid: Callable[[Any], bool], allowed: str) -> None:
    """Raise `ValueError` unless each value of a field (scalar, or dict by pattern) is valid."""
    given = getattr(owner, field)
    by_pattern = given if isinstance(given, dict) else {None: given}
    for pattern, value in by_pattern.items():
        if value is not None and not is_valid(value):
            where = "" if pattern is None else f" for pattern {pattern!r}"
            raise ValueError(
                f"{type(owner).__name__}.{field} is {value!r}{where}; it must be {allowed}."
            )


def mujoco_enum(owner: SpecCfg, field: str, enum: tuple[Any, str]) -> int:
    """Return MuJoCo's constant for a field that names it. `ValueError` lists the choices."""
    return enum_value(f"{type(owner).__name__}.{field}", getattr(owner, field), *enum)


def find_body(owner: SpecCfg, spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Return the body of that name ("world" is the world). `ValueError` lists the bodies."""
    check_exists(f"{type(owner).__name__} body", name, [body.name for body in spec.bodies])
    return spec.body(name)
