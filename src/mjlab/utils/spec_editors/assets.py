"""Editors of assets: textures, materials and meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco

from mjlab.utils.spec_editors.base import SpecCfg, check_values, mujoco_enum
from mjlab.utils.string import filter_exp, resolve_field

_TEXTURE_TYPES = {
    "2d": mujoco.mjtTexture.mjTEXTURE_2D,
    "cube": mujoco.mjtTexture.mjTEXTURE_CUBE,
    "skybox": mujoco.mjtTexture.mjTEXTURE_SKYBOX,
}
_BUILTINS = {
    "checker": mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
    "gradient": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
    "flat": mujoco.mjtBuiltin.mjBUILTIN_FLAT,
    "none": mujoco.mjtBuiltin.mjBUILTIN_NONE,
}
_MARKS = {
    "edge": mujoco.mjtMark.mjMARK_EDGE,
    "cross": mujoco.mjtMark.mjMARK_CROSS,
    "random": mujoco.mjtMark.mjMARK_RANDOM,
    "none": mujoco.mjtMark.mjMARK_NONE,
}
_CUBE_FACES = 6


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
            type=mujoco_enum(self, "type", _TEXTURE_TYPES),
            builtin=mujoco_enum(self, "builtin", _BUILTINS),
            mark=mujoco_enum(self, "mark", _MARKS),
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
        for field, choices in (
            ("type", _TEXTURE_TYPES),
            ("builtin", _BUILTINS),
            ("mark", _MARKS),
        ):
            mujoco_enum(self, field, choices)
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
