"""Spec export: XML, asset files, in-memory files, and fixes of MuJoCo's XML output."""

from __future__ import annotations

import functools
import operator
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import mujoco

from mjlab.utils.os import naming, write_atomically

_ASSETS = "assets"
_XML_NAME = "scene.xml"
_RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_STAND_IN = "mjlab_without_texture"


def export_spec(spec: mujoco.MjSpec, output_dir: Path, *, zip: bool = False) -> None:
    """Write `scene.xml` and its asset files under `assets/`. `spec` is unchanged.

    Textures built from raw pixels, and materials that use them, are omitted, because XML cannot
    represent them. With `zip`, writes the archive `<output_dir>.zip` instead of a folder.

    Raises `ValueError` if a file is not found, or if the spec has been attached to another one.
    """
    if spec.parent is not None:
        # MuJoCo would abort the process.
        raise ValueError(
            f"Spec {spec.modelname!r} is attached to another spec, so MuJoCo cannot write it; write "
            "the parent (`spec.parent`), or a copy made before attaching."
        )
    output_dir = Path(output_dir)
    if not zip:
        _write_folder(spec, output_dir)
        return
    with tempfile.TemporaryDirectory() as temporary:
        # Not named after `output_dir`, whose last part may be "..".
        folder = Path(temporary) / "scene"
        _write_folder(spec, folder)
        archive = shutil.make_archive(str(Path(temporary) / "archive"), "zip", root_dir=folder)
        path = output_dir.with_name(f"{output_dir.name}.zip")
        write_atomically(path, Path(archive).read_bytes())


def _write_folder(spec: mujoco.MjSpec, folder: Path) -> None:
    # All checks precede the first write.
    copy = spec.copy()
    strip_buffer_textures(copy)
    contents: dict[str, bytes] = {}
    names: list[tuple[_FilePlace, str]] = []
    for place in _file_places(copy):
        content = _read(copy, place, spec.modelfiledir)
        names.append((place, _unique_name(place, content, contents)))
        contents[names[-1][1]] = content
    for place, name in names:
        place.rename(name)
    copy.meshdir = copy.texturedir = ""
    copy.assets = contents
    xml = fix_spec_xml(copy.to_xml(), meshdir=_ASSETS if contents else None)
    files = {f"{_ASSETS}/{name}": content for name, content in contents.items()}
    for name, content in (files | {_XML_NAME: xml.encode()}).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with naming(path):
            path.write_bytes(content)


def make_asset_paths_absolute(spec: mujoco.MjSpec, model_dir: str | None = None) -> None:
    """Convert relative paths of files on disk to absolute paths. Changes `spec`.

    Call this before attaching, because attaching discards the folder of a spec. Keys of
    `spec.assets` and paths without a file are unchanged.

    Args:
        spec: Spec to change.
        model_dir: Folder of its XML file. None: `spec.modelfiledir`.
    """
    model_dir = spec.modelfiledir if model_dir is None else model_dir
    for place in _file_places(spec):
        if _asset_key(spec, place) is None and not PurePosixPath(place.path).is_absolute():
            path = Path(model_dir, place.folder, place.path).absolute()
            if path.is_file():
                place.rename(str(path))


def put_files_in_memory(spec: mujoco.MjSpec, prefix: str) -> None:
    """Load all files of a spec into `spec.assets`, as `<prefix><file>`. Changes `spec`.

    Required for merging specs if one of them has in-memory files: attaching such a spec also renames
    files on disk, and a path on disk may match an in-memory file with the same ending.

    Raises `ValueError` if a file is not found.
    """
    contents: dict[str, bytes] = {}
    for place in list(_file_places(spec)):
        content = _read(spec, place, spec.modelfiledir)
        name = _unique_name(place, content, contents)
        contents[name] = content
        place.rename(prefix + name.replace("/", "_"))
    spec.assets = {prefix + name.replace("/", "_"): contents[name] for name in contents}


def fix_spec_xml(xml: str, meshdir: str | None = None) -> str:
    """Return XML written by `MjSpec.to_xml`, fixed so that MuJoCo can load it.

    Removes empty `<default>` elements and merges defaults nested in a default of the same class; both
    result from attaching specs. `meshdir`, if not None, is set as folder of meshes and textures.
    """
    root = ElementTree.fromstring(xml)
    users = [element for element in root.iter() if element.tag != "default"]
    used = {element.get(key) for element in users for key in ("class", "childclass")}
    for default in root.findall("default"):
        _clean_default(default, used)
        if len(default) == 0:
            root.remove(default)
    if meshdir is not None:
        compiler = root.find("compiler")
        if compiler is None:
            compiler = ElementTree.Element("compiler")
            root.insert(0, compiler)
        compiler.attrib.pop("assetdir", None)
        compiler.set("meshdir", meshdir)
        compiler.set("texturedir", meshdir)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _clean_default(default: ElementTree.Element, used: set[str | None]) -> None:
    # An unnamed outermost default is class "main".
    name = default.get("class", "main")
    for child in default.findall("default"):
        _clean_default(child, used)
        inner = child.get("class", "main")
        if inner == name:
            default.remove(child)
            for element in child:
                same = None if element.tag == "default" else default.find(element.tag)
                if same is None:
                    default.append(element)
                else:
                    # The inner value takes precedence.
                    same.attrib.update(element.attrib)
        elif len(child) == 0 and inner not in used:
            # An empty class that is referenced must stay, because it inherits.
            default.remove(child)


def strip_buffer_textures(spec: mujoco.MjSpec) -> None:
    """Delete textures built from raw pixels, and their users, because XML cannot represent them.

    Removes these textures, materials that use them as RGB texture, and references of geoms to these
    materials. Changes `spec`.

    If MuJoCo does not drop a reference, the geoms get a neutral material without a texture.
    """
    no_builtin = mujoco.mjtBuiltin.mjBUILTIN_NONE
    textures = {
        t.name: t
        for t in spec.textures
        if len(t.data) > 0 and not t.file and not any(t.cubefiles) and t.builtin == no_builtin
    }
    materials = {m.name: m for m in spec.materials if m.textures[_RGB_ROLE] in textures}
    geoms = [geom for geom in spec.geoms if geom.material in materials]
    for geom in geoms:
        geom.material = ""
    for element in (*materials.values(), *textures.values()):
        spec.delete(element)
    if not geoms:
        return
    try:
        spec.to_xml()
    except ValueError:
        # A compiled geom keeps the id of its material, and the id may now be out of bounds. An
        # empty material name does not reset the id; another name does. Other errors are raised
        # when the spec is written.
        if spec.material(_STAND_IN) is None:
            spec.add_material(name=_STAND_IN, rgba=(0.5, 0.5, 0.5, 1.0))
        for geom in geoms:
            geom.material = _STAND_IN


def asset_files(spec: mujoco.MjSpec) -> list[Path]:
    """Return the files on disk that a spec refers to: meshes, height fields, textures, skins."""
    paths = (
        Path(spec.modelfiledir, place.folder, place.path)
        for place in _file_places(spec)
        if _asset_key(spec, place) is None
    )
    return [path for path in dict.fromkeys(paths) if path.is_file()]


class _FilePlace:
    """Attribute of an element that holds a file path."""

    def __init__(self, element: Any, path: str, folder: str, write: Callable[[str], None]) -> None:
        self.element = element
        self.path = path
        self.folder = folder
        self._write = write

    def rename(self, path: str) -> None:
        # Unnamed elements are named after their file.
        if not self.element.name:
            self.element.name = PurePosixPath(self.path).stem
        self._write(path)


def _file_places(spec: mujoco.MjSpec) -> Iterator[_FilePlace]:
    def place(element: Any, folder: str) -> _FilePlace:
        write = functools.partial(setattr, element, "file")
        return _FilePlace(element, element.file, folder, write)

    for element in (*spec.meshes, *spec.hfields, *spec.skins):
        if element.file:
            yield place(element, element.compiler.meshdir)
    for texture in spec.textures:
        folder = texture.compiler.texturedir
        if texture.file:
            yield place(texture, folder)
        for side, path in enumerate(texture.cubefiles):
            if path:
                write = functools.partial(operator.setitem, texture.cubefiles, side)
                yield _FilePlace(texture, path, folder, write)


def _read(spec: mujoco.MjSpec, place: _FilePlace, model_dir: str) -> bytes:
    key = _asset_key(spec, place)
    if key is not None:
        content = spec.assets[key]
        return content.encode() if isinstance(content, str) else content
    path = Path(model_dir, place.folder, place.path)
    if not path.is_file():
        raise ValueError(
            f"{type(place.element).__name__} {place.element.name!r}: file {place.path!r} not found, "
            f"neither at {str(path)!r} nor in spec.assets ({sorted(spec.assets)}); add it to "
            "`spec.assets`, or call `make_asset_paths_absolute` on a spec before attaching it."
        )
    return path.read_bytes()


def _asset_key(spec: mujoco.MjSpec, place: _FilePlace) -> str | None:
    """Return the key of `spec.assets` for a path: exact, in its folder, or with the same ending."""
    keys = spec.assets.keys()
    for key in (place.path, str(PurePosixPath(place.folder, place.path))):
        if key in keys:
            return key
    endings = [key for key in keys if key.endswith("/" + place.path)]
    # Of several keys with the same ending, prefer one in the file's folder.
    endings.sort(key=lambda key: (place.folder not in key, key))
    return endings[0] if endings else None


def _unique_name(place: _FilePlace, content: bytes, taken: dict[str, bytes]) -> str:
    """Return a free path for a file below the assets folder, by default its current path."""
    path = PurePosixPath(place.path)
    if path.is_absolute() or ".." in path.parts:
        path = PurePosixPath(path.name)
    candidate, number = path, 1
    while taken.get(str(candidate), content) != content:
        candidate = path.with_name(f"{path.stem}_{number}{path.suffix}")
        number += 1
    return str(candidate)
