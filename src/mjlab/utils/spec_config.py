"""MjSpec editors: textures, materials, meshes, geoms, collisions, lights and cameras.

Regular expressions match at the START of names (see `mjlab.utils.string`). Geoms with the same
name, and unnamed geoms, are matched together.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from mjlab.utils.errors import check_exists
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
_ALWAYS_WRITTEN = ("contype", "conaffinity", "condim", "priority")
_ARRAYS = {"friction": 3, "solref": 2, "solimp": 5}
_PATCHES = (*_ARRAYS, "margin", "gap", "solmix")
_MAX_LISTED = 8
_CUBE_FACES = 6
_LIGHT_FIELDS = (
    *("name", "castshadow", "pos", "dir", "cutoff", "exponent", "diffuse"),
    *("specular", "ambient", "active", "attenuation"),
)
_TEXTURE_FIELDS = (
    *("markrgb", "random", "nchannel", "hflip", "vflip", "rgb1", "rgb2"),
    *("width", "height", "file", "gridsize"),
)
# MuJoCo enum and prefix of its members.
_TEXTURE = (mujoco.mjtTexture, "mjTEXTURE_")
_BUILTIN = (mujoco.mjtBuiltin, "mjBUILTIN_")
_MARK = (mujoco.mjtMark, "mjMARK_")
_LIGHT = (mujoco.mjtLightType, "mjLIGHT_")
_CAM_LIGHT = (mujoco.mjtCamLight, "mjCAMLIGHT_")


@dataclass(kw_only=True)
class SpecCfg(ABC):
    """Declarative edit of an MjSpec."""

    @abstractmethod
    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Apply the edit. Raises `ValueError` for invalid values."""

    def validate(self) -> None:
        """Check the fields. MuJoCo checks most of them when it compiles the spec."""
        return


@dataclass
class CollisionCfg(SpecCfg):
    """Collision setup of an entity. Values have the form of `GeomCfg`.

    The first four attributes are always written, so dicts should cover every selected geom; unmatched
    geoms get the default, with a warning. The other attributes are patches.
    """

    geom_names_expr: tuple[str, ...]
    """Patterns of geom names, matched at the start of the name."""
    contype: int | dict[str, int] = 1
    """Collision type bits."""
    conaffinity: int | dict[str, int] = 1
    """Bit mask of contypes that these geoms collide with."""
    condim: int | dict[str, int] = 3
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int] = 0
    """Priority. The geom with the higher priority sets friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Friction: sliding, torsional, rolling; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance threshold (m) of contact detection."""
    gap: float | dict[str, float] | None = None
    """Part of the margin (m) within which detected contacts are inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight in [0, 1] for averaging the contact parameters of two geoms."""
    disable_other_geoms: bool = True
    """Disable collisions of all unmatched geoms."""

    @staticmethod
    def set_array_field(field: Any, values: Sequence[float] | None) -> None:
        """Write `values` to the first elements of an array field of a spec. None: unchanged."""
        if values is not None:
            field[: len(values)] = values

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Apply the setup."""
        geoms, others = _split_geoms(spec, self.geom_names_expr)
        names = tuple(geom.name for geom in geoms)
        filled = []
        for field in _ALWAYS_WRITTEN:
            default = getattr(CollisionCfg, field)
            values = resolve_field(getattr(self, field), names)
            for geom, value in zip(geoms, values, strict=True):
                setattr(geom, field, default if value is None else value)
            unmatched = [name for name, value in zip(names, values, strict=True) if value is None]
            if unmatched:
                more = " and others" if len(unmatched) > _MAX_LISTED else ""
                filled.append(f"{field} of {unmatched[:_MAX_LISTED]}{more} is {default}")
        if filled:
            warnings.warn(
                f"CollisionCfg: no pattern matches some geoms, so {', '.join(filled)}; add a last pattern "
                "'.*'.",
                UserWarning,
                stacklevel=2,
            )
        for field in _PATCHES:
            _patch(geoms, field, getattr(self, field))
        if self.disable_other_geoms:
            for geom in others:
                geom.contype = geom.conaffinity = 0


@dataclass
class GeomCfg(SpecCfg):
    """Patch of geoms. Attributes that are None or unmatched are unchanged.

    Attributes are one value for all geoms, or a dict of values by name pattern (matched at the start
    of the name; the first match in dict order wins).
    """

    geom_names_expr: tuple[str, ...]
    """Patterns of geom names, matched at the start of the name."""
    group: int | dict[str, int] | None = None
    """Visualization group, in [0, 5]."""
    contype: int | dict[str, int] | None = None
    """Collision type bits."""
    conaffinity: int | dict[str, int] | None = None
    """Bit mask of contypes that these geoms collide with."""
    condim: int | dict[str, int] | None = None
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int] | None = None
    """Priority. The geom with the higher priority sets friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Friction: sliding, torsional, rolling; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance threshold (m) of contact detection."""
    gap: float | dict[str, float] | None = None
    """Part of the margin (m) within which detected contacts are inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight in [0, 1] for averaging the contact parameters of two geoms."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Patch the geoms."""
        geoms, _ = _split_geoms(spec, self.geom_names_expr)
        for field in ("group", *_ALWAYS_WRITTEN, *_PATCHES):
            _patch(geoms, field, getattr(self, field))


@dataclass
class MaterialCfg(SpecCfg):
    """Material to add and, with `geom_names_expr`, to assign to geoms."""

    name: str
    """Material name."""
    rgba: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Color and opacity."""
    texuniform: bool = False
    """Texture repetitions are per meter instead of per geom."""
    texrepeat: tuple[float, float] = (1.0, 1.0)
    """Number of texture repetitions along x and y."""
    reflectance: float = 0.0
    """Reflectance, in [0, 1]."""
    texture: str | None = None
    """Name of the color texture."""
    geom_names_expr: tuple[str, ...] | None = None
    """Patterns of geom names, matched at the start of the name."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the material."""
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


@dataclass
class TextureCfg(SpecCfg):
    """Texture to add, generated by MuJoCo (`builtin`) or loaded from files."""

    name: str
    """Texture name."""
    type: Literal["2d", "cube", "skybox"]
    """Texture mapping."""
    builtin: Literal["checker", "gradient", "flat", "none"] = "none"
    """Builtin image."""
    rgb1: tuple[float, float, float] | None = None
    """First color of the builtin image. None: MuJoCo's default."""
    rgb2: tuple[float, float, float] | None = None
    """Second color of the builtin image. None: MuJoCo's default."""
    width: int | None = None
    """Width of the builtin image (pixels)."""
    height: int | None = None
    """Height of the builtin image (pixels)."""
    mark: Literal["edge", "cross", "random", "none"] = "none"
    """Marks on top of the builtin image."""
    markrgb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Color of the marks."""
    random: float = 0.01
    """Probability of a dot per pixel, for random marks."""
    file: str | None = None
    """Image file."""
    cubefiles: tuple[str, ...] | None = None
    """Six image files: right, left, up, down, front, back."""
    gridsize: tuple[int, int] | None = None
    """Rows and columns of the grid of faces in one file."""
    gridlayout: str | None = None
    """Face of each grid cell, one letter of ".RLUDFB" per cell."""
    nchannel: int = 3
    """Number of color channels."""
    hflip: bool = False
    """Flip the image horizontally."""
    vflip: bool = False
    """Flip the image vertically."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the texture. Raises `ValueError` for an unknown type, image or mark, with the available ones."""
        self.validate()
        texture = spec.add_texture(
            name=self.name,
            type=mujoco_enum(self, "type", _TEXTURE),
            builtin=mujoco_enum(self, "builtin", _BUILTIN),
            mark=mujoco_enum(self, "mark", _MARK),
        )
        _set_given(texture, self, _TEXTURE_FIELDS)
        for face, path in enumerate((self.cubefiles or ())[:_CUBE_FACES]):
            texture.cubefiles[face] = path
        for cell, letter in enumerate(self.gridlayout or ""):
            texture.gridlayout[cell] = letter

    def validate(self) -> None:
        """Warn of missing and unused faces."""
        if self.cubefiles and len(self.cubefiles) != _CUBE_FACES:
            warnings.warn(
                f"TextureCfg {self.name!r} cubefiles: expected {_CUBE_FACES} files, got "
                f"{len(self.cubefiles)}; missing faces are blank, and others are not used.",
                UserWarning,
                stacklevel=2,
            )


@dataclass
class MeshCfg(SpecCfg):
    """Edit of mesh assets."""

    mesh_names_expr: tuple[str, ...]
    """Patterns of mesh names, matched at the start of the name."""
    maxhullvert: int | dict[str, int] | None = None
    """Maximum number of vertices of the convex hull, at least 4. -1: no limit."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Edit the meshes. Raises `ValueError` for an invalid `maxhullvert`."""
        self.validate()
        chosen = set(filter_exp(self.mesh_names_expr, tuple(mesh.name for mesh in spec.meshes)))
        meshes = [mesh for mesh in spec.meshes if mesh.name in chosen]
        values = resolve_field(self.maxhullvert, tuple(mesh.name for mesh in meshes))
        for mesh, value in zip(meshes, values, strict=True):
            if value is not None:
                mesh.maxhullvert = value

    def validate(self) -> None:
        """Raise `ValueError` for an invalid `maxhullvert`: MuJoCo would end the process."""
        values = (
            self.maxhullvert if isinstance(self.maxhullvert, dict) else {".*": self.maxhullvert}
        )
        for pattern, value in values.items():
            if value is not None and value != -1 and value < 4:
                raise ValueError(
                    f"MeshCfg.maxhullvert for pattern {pattern!r}: expected -1 or an integer > 3, got "
                    f"{value!r}."
                )


@dataclass
class LightCfg(SpecCfg):
    """Light to add to a body."""

    name: str | None = None
    """Light name. None: unnamed."""
    body: str = "world"
    """Name of the parent body."""
    mode: str = "fixed"
    """Mode: `fixed`, `track`, `trackcom`, `targetbody` or `targetbodycom`."""
    target: str | None = None
    """Name of the target body, for modes `targetbody` and `targetbodycom`."""
    type: Literal["spot", "directional"] = "spot"
    """Light type."""
    castshadow: bool = True
    """Cast shadows."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame (m)."""
    dir: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Direction in the body frame."""
    cutoff: float = 45.0
    """Cutoff angle of a spotlight: half the opening angle (degrees)."""
    exponent: float = 10.0
    """Exponent of the falloff of a spotlight toward its edge."""
    diffuse: tuple[float, float, float] | None = None
    """Diffuse color. None: MuJoCo's default."""
    specular: tuple[float, float, float] | None = None
    """Specular color. None: MuJoCo's default."""
    ambient: tuple[float, float, float] | None = None
    """Ambient color. None: MuJoCo's default."""
    active: bool = True
    """Switch the light on."""
    attenuation: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Constant, linear and quadratic attenuation with distance."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the light. Raises `ValueError` for an unknown body or mode, with the available ones."""
        self.validate()
        light = find_body(self, spec, self.body).add_light(
            mode=mujoco_enum(self, "mode", _CAM_LIGHT),
            type=mujoco_enum(self, "type", _LIGHT),
        )
        if self.target is not None:
            light.targetbody = find_body(self, spec, self.target).name
        _set_given(light, self, _LIGHT_FIELDS)

    def validate(self) -> None:
        """Warn of a target mode without `target`."""
        _warn_without_target(self)


@dataclass
class CameraCfg(SpecCfg):
    """Camera to add to a body."""

    name: str
    """Camera name."""
    body: str = "world"
    """Name of the parent body."""
    mode: str = "fixed"
    """Mode: `fixed`, `track`, `trackcom`, `targetbody` or `targetbodycom`."""
    target: str | None = None
    """Name of the target body, for modes `targetbody` and `targetbodycom`."""
    fovy: float = 45.0
    """Vertical field of view (degrees)."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame (m)."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z) in the body frame."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the camera. Raises `ValueError` for an unknown body or mode, with the available ones."""
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
        """Warn of a target mode without `target`."""
        _warn_without_target(self)


def _set_given(element: Any, cfg: SpecCfg, fields: Sequence[str]) -> None:
    """Set attributes of a spec element to those of the fields that are not None."""
    for field in fields:
        value = getattr(cfg, field)
        if value is not None:
            setattr(element, field, value)


def warn_overlapping_geom_edits(
    geom_cfgs: Sequence[GeomCfg],
    collision_cfgs: Sequence[CollisionCfg],
    spec: mujoco.MjSpec,
) -> None:
    """Warn (`UserWarning`) if a `CollisionCfg` overwrites values set by a `GeomCfg`.

    Lists up to eight of them as "geom.attribute".
    """
    patched = _edited_attributes(geom_cfgs, spec)
    overwritten = _edited_attributes(collision_cfgs, spec)
    for cfg in collision_cfgs:
        if cfg.disable_other_geoms:
            _, others = _split_geoms(spec, cfg.geom_names_expr)
            overwritten |= {(geom.name, f) for geom in others for f in ("contype", "conaffinity")}
    overlap = sorted(patched & overwritten)
    if overlap:
        listed = ", ".join(f"{geom}.{field}" for geom, field in overlap[:_MAX_LISTED])
        if len(overlap) > _MAX_LISTED:
            listed += f" and {len(overlap) - _MAX_LISTED} more"
        message = f"A CollisionCfg overwrites values set by a GeomCfg: {listed}."
        warnings.warn(message, UserWarning, stacklevel=2)


def _edited_attributes(
    cfgs: Sequence[GeomCfg] | Sequence[CollisionCfg], spec: mujoco.MjSpec
) -> set[tuple[str, str]]:
    edited = set()
    for cfg in cfgs:
        geoms, _ = _split_geoms(spec, cfg.geom_names_expr)
        names = tuple(geom.name for geom in geoms)
        for field in (*_ALWAYS_WRITTEN, *_PATCHES):
            always = isinstance(cfg, CollisionCfg) and field in _ALWAYS_WRITTEN
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
    """Return matched geoms and other geoms."""
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
            CollisionCfg.set_array_field(getattr(geom, field), entry)
        else:
            setattr(geom, field, entry)


def _warn_without_target(cfg: LightCfg | CameraCfg) -> None:
    if cfg.mode.startswith("target") and cfg.target is None:
        warnings.warn(
            f"{type(cfg).__name__} {cfg.name!r}: mode {cfg.mode!r} has no effect without `target`, the "
            "name of the target body.",
            UserWarning,
            stacklevel=2,
        )


def mujoco_enum(owner: SpecCfg, field: str, enum: tuple[Any, str]) -> int:
    """Return the MuJoCo constant named by a field. Raises `ValueError` listing the valid names."""
    return enum_value(f"{type(owner).__name__}.{field}", getattr(owner, field), *enum)


def find_body(owner: SpecCfg, spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Return the body called `name` ("world": world body). Raises `ValueError` listing the bodies."""
    check_exists(f"{type(owner).__name__} body", name, [body.name for body in spec.bodies])
    return spec.body(name)
