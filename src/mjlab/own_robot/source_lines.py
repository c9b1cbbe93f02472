"""File and line of the elements of a model: MJCF with its included files, or URDF.

MuJoCo's compiled model has no lines, and its spec has them for the main MJCF file only. So the source
is read a second time, as XML, and elements are found by kind and name; unnamed ones by their place in
the body.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco

from mjlab.utils.errors import UserError

_SUFFIXES = (".xml", ".urdf")
# Kind by tag, in a body (MJCF).
_IN_BODY = {
    "body": "body",
    "joint": "joint",
    "freejoint": "joint",
    "geom": "geom",
    "site": "site",
}
_KINDS = {
    mujoco.MjsBody: "body",
    mujoco.MjsJoint: "joint",
    mujoco.MjsGeom: "geom",
    mujoco.MjsSite: "site",
    mujoco.MjsActuator: "actuator",
    mujoco.MjsKey: "key",
}
_LISTS = {"body": "bodies", "joint": "joints", "geom": "geoms", "site": "sites"}


def shown(file: Path) -> Path:
    """Return a path relative to the working folder if the file is below it."""
    here = Path.cwd()
    return file.relative_to(here) if file.is_relative_to(here) else file


@dataclass(frozen=True)
class Line:
    """Line of a file."""

    file: Path
    """Path as given, or as included."""
    number: int
    """Line number, from 1."""

    def __str__(self) -> str:
        return f"{shown(self.file)}:{self.number}"


@dataclass
class _Node:
    """XML element with its line."""

    tag: str
    attributes: dict[str, str]
    line: Line
    children: list[_Node] = field(default_factory=list)

    def iter(self) -> Iterator[_Node]:
        """Yield this element and all below it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.iter()


class SourceLines:
    """Lines of the elements of a model file.

    Args:
        path: MJCF or URDF.

    Raises:
        UserError: the file, or one that it includes, is not XML.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.root = _read(path, path.parent)
        self._named: dict[tuple[str, str], _Node] = {}
        self._in_order: dict[str, list[_Node]] = {"actuator": [], "key": []}
        self._in_body: dict[int, dict[str, list[_Node]]] = {}
        self._world = _Node("worldbody", {}, self.root.line)
        (self._index_urdf if self.root.tag == "robot" else self._index_mjcf)()

    def of(self, element: Any) -> Line | None:
        """Return the line of an element of a compiled spec: body, joint, geom, site, actuator or keyframe.

        An unnamed one that cannot be told from its neighbors has the line of its body. None: not
        in the file, as an element that a program added.
        """
        node = self._find(element)
        return None if node is None else node.line

    def of_tag(self, tag: str, attribute: str = "") -> Line | None:
        """Return the line of the last element with a tag, and with an attribute; None without one."""
        nodes = [
            node
            for node in self.root.iter()
            if node.tag == tag and (not attribute or attribute in node.attributes)
        ]
        return nodes[-1].line if nodes else None

    def contains(self, spec: mujoco.MjSpec) -> bool:
        """Return True if the file has the model name, and all named bodies, of a spec."""
        name = self.root.attributes.get("name" if self.root.tag == "robot" else "model", "")
        names = [body.name for body in spec.bodies[1:] if body.name]
        is_same = not name or name == spec.modelname
        return is_same and all(("body", body) in self._named for body in names)

    def _find(self, element: Any) -> _Node | None:
        kind = _KINDS[type(element)]
        if (kind, element.name) in self._named:
            return self._named[kind, element.name]
        if kind in self._in_order:
            nodes = self._in_order[kind]
            return nodes[element.id] if 0 <= element.id < len(nodes) else None
        parent = element.parent
        owner = self._world if parent.name == "world" else self._find(parent)
        if owner is None:
            return None
        siblings = getattr(parent, _LISTS[kind])
        nodes = self._in_body.get(id(owner), {}).get(kind, [])
        if len(nodes) != len(siblings):
            return None if owner is self._world else owner
        return nodes[[one.id for one in siblings].index(element.id)]

    def _index_mjcf(self) -> None:
        for section in self.root.children:
            if section.tag == "worldbody":
                self._index_body(self._world, section)
            elif section.tag in ("actuator", "keyframe"):
                kind = "key" if section.tag == "keyframe" else "actuator"
                self._in_order[kind] += section.children
                for node in section.children:
                    self._name(kind, node)

    def _index_body(self, body: _Node, holder: _Node) -> None:
        """Index what `holder`, a body or a frame in it, holds."""
        lists = self._in_body.setdefault(id(body), {kind: [] for kind in _LISTS})
        for node in holder.children:
            kind = _IN_BODY.get(node.tag)
            if kind is not None:
                lists[kind].append(node)
                self._name(kind, node)
            if kind == "body":
                self._index_body(node, node)
            elif node.tag in ("frame", "replicate"):
                self._index_body(body, node)

    def _index_urdf(self) -> None:
        for node in self.root.children:
            if node.tag == "link":
                self._name("body", node)
                geoms = [one for one in node.children if one.tag in ("visual", "collision")]
                # MuJoCo reads a link's visual geoms first.
                geoms.sort(key=lambda one: one.tag == "collision")
                self._in_body[id(node)] = {"geom": geoms}
            elif node.tag == "joint":
                self._name("joint", node)

    def _name(self, kind: str, node: _Node) -> None:
        if name := node.attributes.get("name"):
            self._named.setdefault((kind, name), node)


def find_source(spec: mujoco.MjSpec) -> SourceLines | None:
    """Return the lines of the file that a spec was read from; None if it was built otherwise.

    A spec knows the folder of its file, so the file is the one in it with the spec's model name and
    bodies.
    """
    folder = Path(spec.modelfiledir)
    if not spec.modelfiledir or not folder.is_dir():
        return None
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _SUFFIXES:
            try:
                lines = SourceLines(path)
            except UserError:
                continue
            if lines.contains(spec):
                return lines
    return None


def element_path(element: Any) -> str:
    """Return the place of an element of a compiled spec in its tree, such as `trunk/FL_hip/geom[2]`."""
    kind = _KINDS[type(element)]
    if kind in ("actuator", "key"):
        return f"{kind} {element.name or element.id!r}"
    name, parent = element.name, element.parent
    if not name:
        siblings = [one.id for one in getattr(parent, _LISTS[kind])]
        name = f"{kind}[{siblings.index(element.id)}]"
    if parent is None or parent.name in ("", "world"):
        return name
    return f"{element_path(parent)}/{name}" if kind == "body" else f"{parent.name}/{name}"


def _read(path: Path, folder: Path) -> _Node:
    """Return the root of an XML file, with the content of included files in place."""
    parser, stack = expat.ParserCreate(), [_Node("", {}, Line(path, 1))]

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = _Node(tag, attributes, Line(path, parser.CurrentLineNumber))
        if tag == "include" and "file" in attributes:
            # Beside the main file, in some versions beside the including one.
            names = [folder / attributes["file"], path.parent / attributes["file"]]
            found = next((name for name in names if name.is_file()), None)
            if found is not None:
                stack[-1].children += _read(found, folder).children
        else:
            stack[-1].children.append(node)
        stack.append(node)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, RecursionError) as error:
        raise UserError(f"{path}: not an XML file: {error}") from error
    return stack[0].children[0]
