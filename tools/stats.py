"""Count files, functions, patterns of prose and import circles of `src/mjlab`.

    python tools/stats.py [ROOT] [--json FILE] [--against FILE]

ROOT is a checkout, by default the one of this script. `--json` writes the numbers to a file;
`--against` reads such a file and prints its numbers next to those of ROOT, before and after.

Definitions:

- Code line: line with a token that is neither comment nor docstring. All sizes are in code lines.
- Docstring: string that is a statement, after a `def`, a `class` or a field, or at the top of a module.
- Signature: lines from `def` or `class` to the colon, without decorators.
- Body: lines of functions that are neither imports nor signatures. `bodies (%)` is their share of
  code lines; the rest is imports, signatures, and module-level and class-level declarations.
- Function length: lines of a function with signature and nested functions, without decorators.
- Private function: function at module or class level called `_name`. Dunder methods, nested functions
  and setters of properties do not count.
- Private function called once: private function whose name has one reference in the package, a call.
  References are names and attributes outside import statements. Functions with the same name share their
  references, so a second row resolves names: references to a module-level function are those in its file
  and in files that import it, references to a method those by attribute. Both rows leave out methods that
  several classes define (hooks and overrides), and functions with a decorator that is not in
  `PLAIN_DECORATORS`: a property is a named value, and `@override` or a callback registered by a
  decorator is called from elsewhere.
- Own modules: distinct modules of the package that a file imports: at module level, in functions and under
  `if TYPE_CHECKING`.
- Circle: modules that import each other, directly or through others. Imports at run time are those at module
  level outside `if TYPE_CHECKING`; circles with annotations add the imports inside it. Both are also
  counted with imports in functions added. `from a.b import c` imports `a.b.c` if that is a module,
  else `a.b`.
- Pattern: number of lines that match in the sources (`src/**/*.py`) and in the documentation (`docs/**/*.md`,
  README.md and CHANGELOG.md).
"""

from __future__ import annotations

import argparse
import ast
import bisect
import io
import json
import re
import statistics
import textwrap
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

PACKAGE = "mjlab"
ROOT = Path(__file__).parents[1]

QUESTION = r"(What|Whether|Which|How|Where|When|Who|Whose|Why)\b"
RIDDLE = "|".join(
    (
        r"\banew\b",
        r"(?<![Tt]here )\b(?:is|are) no (?!longer)[a-z]",
        r"\b(?:[Ww]hoever|[Nn]obody|[Ss]omeone|[Ss]omebody)\b",
        r"\bas (?:it is|they are)\b",
        r"\bof (?:its|their|one's) own\b",
        r"\b[Ll]ikewise\b",
        r"\b[Ww]hat there is\b",
    )
)

# Rows of the table of patterns: pattern, and True if the documentation is searched too.
PATTERNS = {
    "docstring opens with a question word": (rf'"""{QUESTION}', False),
    "comment opens with a question word": (r"#\s*(What|Whether|Which|How|Where|Who|When)\b", True),
    "docstring opens with a word in -ing": (r'"""[A-Z][a-z]+ing\b', False),
    "refuse, refusal": (r"\b(refuse[sd]?|refusing|refusal)\b|_refus|\bRefus", True),
    "has to, have to": (r"has to|have to", True),
    "there is no": (r"[Tt]here (is|are) no\b", True),
    "is no X": (r"(?<![Tt]here )\b(is|are) no (?!longer)[a-z]", True),
    "figure": (r"\bfigures?\b", True),
    "where there, none, it ...": (r"\bwhere (there|none|no|it|they|nothing|one)\b", True),
    ", which is": (r", which (is|are|has|have|would|may|does|do|must|the)\b", True),
    "of which, in which ...": (r"\b(of|in|by|with|from|to|for|on|at|against) which\b", True),
    "is told, asked, given ...": (
        r"\b(is|are) (told|asked|given|meant|said|wanted|needed)\b",
        True,
    ),
    "as it is, as they are": (r"as (it is|they are|it was|they were)\b", True),
    "of its own": (r"\bof (its|their|one.s|our|your) own\b", True),
    "anew, afresh": (r"\banew\b|\bafresh\b", True),
    "whoever, nobody, someone": (r"[Ww]hoever|[Nn]obody|[Ss]omebody|[Ss]omeone", True),
    "likewise": (r"\b[Ll]ikewise\b", True),
    "what there is, as far as ...": (r"what there is|those there are|as (far|much|many) as", True),
    "makes no sense": (r"makes? no sense", True),
    "another X in each environment": (r"\b[Aa]nother [\w ]+ in each environment", True),
}
PRONOUN_COMMENT = "comment opens with It, They, That ..."
PRONOUN = r"#\s*(It|They|That|These|Those|Such)\b"

# Decorators that do not change the call of a function.
PLAIN_DECORATORS = {"staticmethod", "classmethod", "contextmanager", "cache", "lru_cache"}

# Upper bounds of rows.
TO_REACH = {
    "private functions per 1,000 lines": 18,
    "private functions called once": 200,
    "most own modules imported": 14,
    "question openings (%)": 1,
    "riddles per 1,000 docstrings": 2,
}

# Columns of the table by package: heading and row of the table of the whole.
COLUMNS = {
    "files": "files",
    "lines": "code lines",
    "imports": "import lines",
    "signatures": "signature lines",
    "raises": "raise lines",
    "bodies %": "bodies (%)",
    "median": "median file",
    "largest": "largest file",
    "function p90": "function length, 90th percentile",
    "private/1000": "private functions per 1,000 lines",
    "once": "private functions called once",
    "questions %": "question openings (%)",
    "riddles/1000": "riddles per 1,000 docstrings",
}

# Kinds of import circles: with imports under `if TYPE_CHECKING`, with imports in functions.
CIRCLES = {
    "at run time": (False, False),
    "at run time, with imports in functions": (False, True),
    "with annotations": (True, False),
    "with annotations and imports in functions": (True, True),
}

# Conditions of blocks for type checkers only.
TYPING_ONLY = ("TYPE_CHECKING", "typing.TYPE_CHECKING")

Function = ast.FunctionDef | ast.AsyncFunctionDef
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
DEFINITION = (*FUNCTION, ast.ClassDef)
IMPORT = (ast.Import, ast.ImportFrom)
T = TypeVar("T")
Numbers = dict[str, float]
Report = dict[str, Any]
Graph = dict[str, set[str]]
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


@dataclass
class Source:
    """Parsed source file."""

    path: Path
    """Path relative to the folder of the package."""
    text: str

    @cached_property
    def module(self) -> str:
        """Dotted name."""
        parts = (PACKAGE, *self.path.with_suffix("").parts)
        return ".".join(parts[:-1] if self.is_init else parts)

    @property
    def is_init(self) -> bool:
        """True for `__init__.py`."""
        return self.path.name == "__init__.py"

    @property
    def package(self) -> str:
        """Top-level folder, or `(top)`."""
        return self.path.parts[0] if len(self.path.parts) > 1 else "(top)"

    @cached_property
    def tree(self) -> ast.Module:
        """Syntax tree."""
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of the tree."""
        return list(ast.walk(self.tree))

    @cached_property
    def tokens(self) -> list[tokenize.TokenInfo]:
        """Tokens in order."""
        return list(tokenize.generate_tokens(io.StringIO(self.text).readline))

    @cached_property
    def docstrings(self) -> list[ast.Constant]:
        """Strings that are statements."""
        return [
            node.value
            for node in self.nodes
            if isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ]

    @cached_property
    def code(self) -> set[int]:
        """Numbers of the code lines."""
        prose = {line for node in self.docstrings for line in _span(node)}
        lines = set()
        for token in self.tokens:
            is_docstring = token.type == tokenize.STRING and token.start[0] in prose
            if token.type not in LAYOUT and not is_docstring:
                lines.update(range(token.start[0], token.end[0] + 1))
        return lines

    @cached_property
    def imports(self) -> set[int]:
        """Code lines of import statements."""
        return self.code & {line for node in self.find(*IMPORT) for line in _span(node)}

    @cached_property
    def signatures(self) -> set[int]:
        """Code lines from `def` or `class` to the colon."""
        starts = [token.start for token in self.tokens if token.type not in LAYOUT]
        lines = set()
        for node in self.find(*DEFINITION):
            colon = starts[bisect.bisect_left(starts, _start(node.body[0])) - 1]
            lines.update(range(node.lineno, colon[0] + 1))
        return self.code & lines

    @cached_property
    def bodies(self) -> set[int]:
        """Code lines of function bodies."""
        inside = {line for node in self.functions for line in _span(node)}
        return (self.code & inside) - self.imports - self.signatures

    @cached_property
    def functions(self) -> list[Function]:
        """Functions, nested ones included."""
        return self.find(*FUNCTION)

    @cached_property
    def lengths(self) -> list[tuple[int, str]]:
        """Code lines and name of each function."""
        return [(len(self.code.intersection(_span(node))), node.name) for node in self.functions]

    @cached_property
    def private(self) -> list[tuple[str, Function]]:
        """Private functions, each with the name of its class or an empty string."""
        found = []
        for owner in [self.tree, *self.find(ast.ClassDef)]:
            name = owner.name if isinstance(owner, ast.ClassDef) else ""
            nodes = (node for node in _statements(owner.body) if isinstance(node, FUNCTION))
            found += [(name, node) for node in nodes if _is_private(node)]
        return found

    @cached_property
    def references(self) -> Counter[str]:
        """Number of references, with keys `name` and `.attribute`."""
        return Counter(key for node in self.nodes if (key := _key(node)))

    @cached_property
    def calls(self) -> Counter[str]:
        """Number of calls, with the keys of `references`."""
        return Counter(key for node in self.find(ast.Call) if (key := _key(node.func)))

    @cached_property
    def imported_names(self) -> set[tuple[str, str]]:
        """Module and name of every `from module import name`."""
        return {
            (self._base(node), alias.name)
            for node in self.find(ast.ImportFrom)
            for alias in node.names
        }

    def own_imports(self, nodes: Iterable[ast.AST], modules: set[str]) -> set[str]:
        """Return those of `modules` that the import statements among `nodes` import."""
        found = set()
        for node in nodes:
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = self._base(node)
                names = (f"{base}.{alias.name}" for alias in node.names)
                found.update(name if name in modules else base for name in names)
        return found & modules

    def _base(self, node: ast.ImportFrom) -> str:
        """Return the absolute name of the module in `from module import ...`."""
        if not node.level:
            return node.module or ""
        parts = self.module.split(".")
        parts = parts[: len(parts) - node.level + self.is_init]
        return ".".join([*parts, *([node.module] if node.module else [])])

    def find(self, *kinds: type[T]) -> list[T]:
        """Return the nodes of these types."""
        return [node for node in self.nodes if isinstance(node, kinds)]


def _span(node: ast.stmt | ast.expr) -> range:
    """Return the lines of a statement or an expression, without decorators."""
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def _key(node: ast.AST) -> str:
    """Return `name` or `.attribute` for a reference, else an empty string."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        return node.id
    return f".{node.attr}" if isinstance(node, ast.Attribute) else ""


def _start(node: ast.stmt) -> tuple[int, int]:
    """Return the line and column of a statement, decorators included."""
    decorators = getattr(node, "decorator_list", [])
    return (decorators[0].lineno, 0) if decorators else (node.lineno, node.col_offset)


def _statements(body: Iterable[ast.stmt], annotations: bool = True) -> Iterator[ast.stmt]:
    """Yield statements with those in `if`, `try`, `with` and loops, but not in functions and classes.

    Args:
        annotations: Include the statements under `if TYPE_CHECKING`.
    """
    for node in body:
        yield node
        if isinstance(node, DEFINITION):
            continue
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test) in TYPING_ONLY
        for name in ("body", "handlers", "orelse", "finalbody", "cases"):
            if name != "body" or annotations or not typing_only:
                yield from _statements(getattr(node, name, []), annotations)


def _is_private(node: Function) -> bool:
    """Return True for `_name`, but not for `__name__` and setters of properties."""
    dunder = node.name.startswith("__") and node.name.endswith("__")
    return node.name.startswith("_") and not dunder and "setter" not in _decorators(node)


def _decorators(node: Function) -> set[str]:
    """Return the last names of a function's decorators."""
    found = set()
    for decorator in node.decorator_list:
        target = decorator.func if isinstance(decorator, ast.Call) else decorator
        found.add(target.attr if isinstance(target, ast.Attribute) else ast.unparse(target))
    return found


def read_sources(root: Path) -> list[Source]:
    """Return the source files of the package of a checkout, in order of their paths."""
    folder = root / "src" / PACKAGE
    paths = sorted(folder.rglob("*.py"))
    if not paths:
        raise SystemExit(f"{folder}: expected Python files, found none.")
    return [Source(path.relative_to(folder), path.read_text()) for path in paths]


# Private functions called once.


@dataclass
class Private:
    """Private function without special decorators."""

    source: Source
    name: str
    line: int
    is_method: bool


def plain_private(sources: list[Source]) -> list[Private]:
    """Return the private functions that can be called once: no hooks, no special decorators."""
    owners = Counter(node.name for source in sources for owner, node in source.private if owner)
    return [
        Private(source, node.name, node.lineno, bool(owner))
        for source in sources
        for owner, node in source.private
        if not _decorators(node) - PLAIN_DECORATORS and not (owner and owners[node.name] > 1)
    ]


def called_once_by_name(sources: list[Source]) -> list[Private]:
    """Return the private functions whose name has one reference in the package, a call."""
    totals = _totals(sources)

    def uses(name: str) -> list[int]:
        return [total[name] + total[f".{name}"] for total in totals]

    return [item for item in plain_private(sources) if uses(item.name) == [1, 1]]


def called_once_resolved(sources: list[Source]) -> list[Private]:
    """Return the private functions that have one reference, a call, with names resolved."""
    totals = _totals(sources)
    importers = defaultdict(list)
    for source in sources:
        for imported in source.imported_names:
            importers[imported].append(source)

    def uses(item: Private) -> list[int]:
        if item.is_method:
            return [total[f".{item.name}"] for total in totals]
        users = [item.source, *importers[item.source.module, item.name]]
        return [total[item.name] for total in _totals(users)]

    return [item for item in plain_private(sources) if uses(item) == [1, 1]]


def _totals(sources: Iterable[Source]) -> tuple[Counter[str], Counter[str]]:
    """Return the references and the calls in files."""
    references, calls = Counter(), Counter()
    for source in sources:
        references.update(source.references)
        calls.update(source.calls)
    return references, calls


# Import circles.


def import_graph(sources: list[Source], annotations: bool, lazy: bool) -> Graph:
    """Return the modules that each module imports.

    Args:
        annotations: Include imports under `if TYPE_CHECKING`.
        lazy: Include imports in functions.
    """
    modules = {source.module for source in sources}
    graph = {}
    for source in sources:
        nodes = list(_statements(source.tree.body, annotations))
        if lazy:
            nodes += [node for function in source.functions for node in _statements(function.body)]
        graph[source.module] = source.own_imports(nodes, modules) - {source.module}
    return graph


def circles(graph: Graph) -> list[list[str]]:
    """Return the strongly connected components of more than one module, largest first."""
    reach = {module: _reachable(graph, module) for module in graph}
    found = {frozenset(n for n in reach[m] if m in reach[n]) for m in graph if m in reach[m]}
    return sorted((sorted(members) for members in found), key=lambda names: (-len(names), names))


def _reachable(graph: Graph, start: str) -> set[str]:
    """Return the modules that `start` imports, directly or through others."""
    found, todo = set(), [start]
    while todo:
        new = graph[todo.pop()] - found
        found |= new
        todo += new
    return found


# Patterns of prose.


def count_patterns(root: Path, sources: list[Source]) -> dict[str, list[int | None]]:
    """Return the lines that match each pattern, in the sources and in the documentation.

    None: the pattern does not apply to the documentation.
    """
    code = [line for source in sources for line in source.text.splitlines()]
    pages = [*sorted((root / "docs").rglob("*.md")), root / "README.md", root / "CHANGELOG.md"]
    docs = [
        line
        for page in pages
        if page.is_file() and "_build" not in page.parts
        for line in page.read_text().splitlines()
    ]
    found: dict[str, list[int | None]] = {}
    for label, (pattern, in_docs) in PATTERNS.items():
        match = re.compile(pattern).search
        found[label] = [sum(map(bool, map(match, code))), None]
        if in_docs:
            found[label][1] = sum(map(bool, map(match, docs)))
    found[PRONOUN_COMMENT] = [sum(map(pronoun_comments, sources)), None]
    return found


def pronoun_comments(source: Source) -> int:
    """Return the number of comments that open with a pronoun, not counting their further lines."""
    comments = [token for token in source.tokens if token.type == tokenize.COMMENT]
    whole = {token.start[0] for token in comments if not token.line[: token.start[1]].strip()}
    return sum(
        bool(re.match(PRONOUN, token.string))
        for token in comments
        if not {token.start[0], token.start[0] - 1} <= whole
    )


# Numbers of a set of files.


def measure(sources: list[Source], once: dict[str, list[Private]], modules: set[str]) -> Numbers:
    """Return the rows of the table for these files.

    Args:
        once: Private functions called once in the whole package, by row.
        modules: All modules of the package.
    """
    lines = sum(len(source.code) for source in sources)
    raises = [(source, node) for source in sources for node in source.find(ast.Raise)]
    private = sum(len(source.private) for source in sources)
    paths = {source.path for source in sources}
    return {
        "files": len(sources),
        "code lines": lines,
        "import lines": sum(len(source.imports) for source in sources),
        "signature lines": sum(len(source.signatures) for source in sources),
        "body lines": sum(len(source.bodies) for source in sources),
        "bodies (%)": share(100, sum(len(source.bodies) for source in sources), lines),
        "raise statements": len(raises),
        "raise lines": sum(len(source.code.intersection(_span(node))) for source, node in raises),
        **measure_lengths(sources),
        "private functions": private,
        "private functions per 1,000 lines": share(1000, private, lines),
        **{row: sum(item.source.path in paths for item in found) for row, found in once.items()},
        **measure_docstrings(sources),
        **{row: count for row, (count, _) in largest(sources, modules).items()},
    }


def measure_lengths(sources: list[Source]) -> Numbers:
    """Return the median and the 90th percentile of the lengths of files and functions."""
    files = [len(source.code) for source in sources]
    modules = [len(source.code) for source in sources if not source.is_init]
    functions = sorted(length for source in sources for length, _ in source.lengths)
    return {
        "median file": statistics.median(files),
        "median file without __init__": statistics.median(modules or [0]),
        "functions": len(functions),
        "function length, median": statistics.median(functions or [0]),
        "function length, 90th percentile": functions[len(functions) * 9 // 10] if functions else 0,
    }


def measure_docstrings(sources: list[Source]) -> Numbers:
    """Return the number of docstrings and the rates of question openings and riddles."""
    docstrings = [
        " ".join(str(node.value).split()) for source in sources for node in source.docstrings
    ]
    questions = sum(bool(re.match(QUESTION, text)) for text in docstrings)
    riddles = sum(len(re.findall(RIDDLE, text)) for text in docstrings)
    return {
        "docstrings": len(docstrings),
        "question openings": questions,
        "question openings (%)": share(100, questions, len(docstrings)),
        "riddles": riddles,
        "riddles per 1,000 docstrings": share(1000, riddles, len(docstrings)),
    }


def largest(sources: list[Source], modules: set[str]) -> dict[str, tuple[int, str]]:
    """Return the rows that are maxima: the number, and the file or function it belongs to."""
    lines, functions, imports = [(0, "")], [(0, "")], [(0, "")]
    for source in sources:
        lines.append((len(source.code), str(source.path)))
        functions += [(length, f"{source.path} {name}") for length, name in source.lengths]
        imports.append((len(source.own_imports(source.nodes, modules)), str(source.path)))
    without = [item for item in imports if not item[1].endswith("__init__.py")]
    return {
        "largest file": max(lines),
        "longest function": max(functions),
        "most own modules imported": max(imports),
        "most own modules without __init__": max(without),
    }


def share(scale: int, part: int, whole: int) -> float:
    """Return `scale * part / whole`, or 0 if `whole` is 0."""
    return round(scale * part / whole, 2) if whole else 0


def report(root: Path) -> Report:
    """Return all numbers of a checkout."""
    sources = read_sources(root)
    modules = {source.module for source in sources}
    once = {
        "private functions called once": called_once_by_name(sources),
        "private functions called once, resolved": called_once_resolved(sources),
    }
    rows = measure(sources, once, modules)
    found = {
        kind: circles(import_graph(sources, annotations, lazy))
        for kind, (annotations, lazy) in CIRCLES.items()
    }
    for kind, groups in found.items():
        rows[f"import circles {kind}"] = len(groups)
        rows[f"files in import circles {kind}"] = sum(map(len, groups))
    packages = defaultdict(list)
    for source in sources:
        packages[source.package].append(source)
    return {
        "rows": rows,
        "names": {row: name for row, (_, name) in largest(sources, modules).items()},
        "packages": {name: measure(packages[name], once, modules) for name in sorted(packages)},
        "patterns": count_patterns(root, sources),
        "circles": found,
        "called once": {
            row: [f"{item.source.path}:{item.line} {item.name}" for item in items]
            for row, items in once.items()
        },
    }


# Output.


def print_report(after: Report, before: Report | None) -> None:
    """Print the tables, with the numbers of `before`, if any, next to those of `after`."""
    columns = [before, after] if before else [after]
    headings = ["before", "after"] if before else ["number"]
    rows = []
    for row in after["rows"]:
        numbers = [show(column["rows"].get(row)) for column in columns]
        rows.append([row, *numbers, show(TO_REACH.get(row)), after["names"].get(row, "")])
    print_table(["", *headings, "below", ""], rows)

    print_table(["package", *COLUMNS], list(package_rows(after, before)))

    rows = []
    for label in after["patterns"]:
        pairs = [column["patterns"].get(label, (None, None)) for column in columns]
        rows.append(
            [label, *(show(number) for place in zip(*pairs, strict=True) for number in place)]
        )
    places = [f"{place} {heading}" for place in ("src", "docs") for heading in headings]
    print_table(["lines with pattern", *places], rows)

    print_circles(after["circles"])


def print_circles(found: dict[str, list[list[str]]]) -> None:
    """Print the members of the circles of each kind, each circle once."""
    printed = []
    for kind, groups in found.items():
        new = [members for members in groups if members not in printed]
        above = f", {len(groups) - len(new)} of them listed above" if len(new) < len(groups) else ""
        print(f"Import circles {kind}: {len(groups)}{above}")
        for members in new:
            text = ", ".join(name.removeprefix(f"{PACKAGE}.") for name in members)
            print(textwrap.fill(f"{len(members)}: {text}", 100, subsequent_indent="   "))
        printed += new
        print()


def package_rows(after: Report, before: Report | None) -> Iterator[list[str]]:
    """Yield the rows of the table by package, with cells `before -> after` for changed numbers."""
    old = before["packages"] if before else {}
    for name in sorted({*old, *after["packages"]}):
        cells = [name]
        for row in COLUMNS.values():
            now = show(after["packages"].get(name, {}).get(row))
            was = show(old.get(name, {}).get(row)) if before else now
            cells.append(now if was == now else f"{was or '-'} -> {now or '-'}")
        yield cells


def print_table(headings: list[str], rows: list[list[str]]) -> None:
    """Print a table: text of the first column, and of a column without heading, to the left."""
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    for cells in [headings, *rows]:
        line = [
            cell.rjust(width) if heading and i else cell.ljust(width)
            for i, (cell, width, heading) in enumerate(zip(cells, widths, headings, strict=True))
        ]
        print("  ".join(line).rstrip())
    print()


def show(number: float | None) -> str:
    """Return a number for a table: integers in full, others with one decimal."""
    if number is None:
        return ""
    return f"{number:,.0f}" if number == int(number) else f"{number:,.1f}"


def main() -> None:
    """Print the numbers of a checkout."""
    summary = (__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("root", metavar="ROOT", type=Path, nargs="?", default=ROOT)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers to FILE")
    parser.add_argument("--against", type=Path, metavar="FILE", help="numbers from before")
    args = parser.parse_args()
    before = json.loads(args.against.read_text()) if args.against else None
    after = report(args.root)
    if args.json:
        args.json.write_text(json.dumps(after, indent=1) + "\n")
    print_report(after, before)


if __name__ == "__main__":
    main()
