"""Names, commands, flags and links in the pages of the documentation exist."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import pytest

from mjlab.cli.main import ALIASES, COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]

_COMMAND = re.compile(r"\buv run (?:--(?:extra|group) \S+ |--\S+ )*([\w-]+)")
_FLAG = re.compile(r"(?<![\w-])--([a-z][\w.-]*[a-z])")
_OBJECT = re.compile(r"^\.\. auto\w+:: (\S+)$", re.MULTILINE)
_COMMAND_LINE = re.compile(
    r"\b(train-seeds|train|demo|describe|play|(?<=mjlab )share|evaluate|profile-env|export-scene|viz-nan|visualize_terrain"
    r"|csv_to_npz|verify|(?<=mjlab )check)"
    r"((?: [^\s`#]+)*)"
)
_MAKE = re.compile(r"\bmake ([a-z-]+)")

# Flags of `train` that stand for any field of the configs, and those of other programs.
_ELSEWHERE = {"help", "seeds", "keyword", "output", "tag", "title", "group"}
_INSTALLERS = {"extra", "overrides", "no-deps", "no-index", "only-binary", "find-links", "target"}
_INSTALLERS |= {"dest", "python-version", "implementation", "platform"}
_INSTALLERS |= {"python-platform", "no-header", "no-annotate"}
_INSTALLERS |= {
    "torch-backend",
    "upgrade-package",
    "editable",
    "python",
    "no-config",
    "no-hashes",
    "no-emit-project",
    "no-emit-package",
}
# Slurm and Ray.
_QUEUES = {"open-mode", "requeue", "signal", "time", "array", "nodes", "ntasks-per-node", "gpus"}
_QUEUES |= {"gpus-per-node", "address", "submission-id", "no-wait", "entrypoint-num-gpus", "follow"}
_QUEUES |= {"runtime-env-json"}
# TensorBoard, ruff, sphinx-build, and the commands of Isaac Lab.
_OTHERS = {
    "logdir",
    "project",
    "check",
    "fix",
    "preview",
    "select",
    "keep-going",
    "headless",
    "task",
    "aside",
}
# `simulate.py` of a bundle, and programs that read one.
_OTHERS |= {"command", "config", "manifest", "onnx", "yaml"}
_OPTUNA = {"state", "study-name", "trial-number"}
_TORCHRUN = {"nnodes", "node-rank", "nproc-per-node", "rdzv-backend", "rdzv-endpoint", "rdzv-id"}


_TITLE = re.compile(r"mjlab(\.\w+)*")
_ENTRY = re.compile(r"^(#{1,2}) (.+)|^\.\. auto(\w+):: (\S+)", re.MULTILINE)


def _documented(page: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the entries of an API page: package to import from, module and name."""
    package = title = ""
    for level, heading, kind, path in _ENTRY.findall(page.read_text()):
        if level == "#":
            package = title = heading
        elif level:
            package = heading if _TITLE.fullmatch(heading) else title
        elif kind == "module":
            module = importlib.import_module(path)
            own = [n for n, v in vars(module).items() if getattr(v, "__module__", "") == path]
            public = [name for name in own if not name.startswith("_")]
            yield from ((package, path, name) for name in getattr(module, "__all__", public))
        else:
            yield package, *path.rsplit(".", 1)


def _ids(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _code(text: str) -> str:
    return "\n".join(re.findall(r"```.*?```|`[^`\n]+`", text, re.DOTALL))


@pytest.mark.parametrize("page", PAGES, ids=_ids)
def test_commands_are_console_scripts(page: Path) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    commands = set(_COMMAND.findall(page.read_text(encoding="utf-8")))
    others = {"python", "tensorboard", "pytest", "ruff", "ty", "lint-imports", "sphinx-build"}
    others |= {"optuna"}
    assert commands <= {*scripts, *others}


def test_commands_to_type_are_spelled_alike() -> None:
    """`uv run mjlab X`, in pages and in what the package prints, not the scripts of earlier releases."""
    scripts = "|".join({name.replace("_", "-") for name in ALIASES} | set(ALIASES))
    script = re.compile(rf"uv run (--\S+ (?!python)\S+ )?({scripts})(?![\w.-])")
    folders = ("docs", "src", "examples", "benchmarks", "tools")
    files = [
        p for f in folders for s in ("md", "py", "txt", "ipynb") for p in (ROOT / f).rglob(f"*.{s}")
    ]
    found = [str(path) for path in files if script.search(path.read_text(encoding="utf-8"))]
    assert not found


def test_examples_in_the_help_are_commands() -> None:
    names = {command.name for command in COMMANDS}
    assert {line.split()[0] for command in COMMANDS for line in command.examples} <= names


def test_the_front_page_is_short_and_light() -> None:
    page = ROOT / "README.md"
    text = page.read_text(encoding="utf-8")
    clips = [ROOT / name for name in re.findall(r"\(([^)]+\.webp)\)", text)]
    assert text.count("\n") < 90
    assert 0 < sum(clip.stat().st_size for clip in clips) < 1_500_000


def test_badges_say_what_is_true() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    badges = dict(re.findall(r"^\[!\[(\w+): ([^]]+)\]\(docs/images/badge_", text, re.MULTILINE))
    for name, statement in badges.items():
        badge = ROOT / "docs" / "images" / f"badge_{name}.svg"
        assert f"{name}: {statement}" in badge.read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert badges["license"].replace(" ", "-") == project["license"]
    assert (ROOT / badges["cite"]).exists()
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name in ("tests", "docs"):
        assert f"\n{badges[name].removeprefix('make ')}:" in makefile


@pytest.mark.parametrize("page", PAGES, ids=_ids)
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(_MAKE.findall(_code(page.read_text(encoding="utf-8")))) <= targets


def test_commands_of_the_targets_are_those_of_the_makefile() -> None:
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `make ([\w-]+)` \| (?:`([^`]+)`|the lines below)", page, re.MULTILINE)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    makefile = makefile.replace("$(DEV)", "$(UV) run --group dev").replace("$(UV)", "uv")
    targets = set(re.findall(r"^([a-z-]+):.*##", makefile, re.MULTILINE))
    assert targets - {"help"} == dict(rows).keys()
    for target, command in rows:
        recipe = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
        assert recipe is not None
        text = recipe[1].replace("$(PYTHON)", "python").replace("$(DEVICE)", "cuda:0")
        assert command in text, target


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=_ids)
def test_links_have_a_text_and_lead_to_files_and_headings(page: Path) -> None:
    """On GitHub as well as in the built documentation, which fills in titles and knows labels."""
    links = re.findall(
        r"\[([^\]\n]*)\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]*))?\)", page.read_text("utf-8")
    )
    for text, target, anchor in links:
        linked = page.parent / target if target else page
        assert text, (target, anchor)
        assert linked.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)", linked.read_text("utf-8"), re.MULTILINE)
            slugs = {
                re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings
            }
            assert anchor in slugs, (target, anchor)


def test_llms_txt_lists_every_page_by_its_title() -> None:
    text = (ROOT / "docs" / "llms.txt").read_text("utf-8")
    listed = {target: title for title, target in re.findall(r"^- \[(.+)\]\((\S+)\): .", text, re.M)}
    titles = {
        page.relative_to(ROOT / "docs").as_posix(): re.findall(
            r"^# (.*)", page.read_text("utf-8"), re.M
        )[0]
        for page in PAGES
    }
    del titles["index.md"]
    assert listed == titles


@cache
def _flags_of() -> dict[str, list[object]]:
    """Each command's flags: configs, whose fields they are, and sets of names."""
    from mjlab.scripts.check import CheckConfig
    from mjlab.scripts.check_deploy import CheckDeployConfig
    from mjlab.scripts.csv_to_npz import CsvToNpzConfig
    from mjlab.scripts.describe import DescribeConfig
    from mjlab.scripts.evaluate import EvaluateConfig
    from mjlab.scripts.export_scene import ExportSceneConfig
    from mjlab.scripts.fit_actuators import FitActuatorsConfig
    from mjlab.scripts.new_robot import NewRobotConfig
    from mjlab.scripts.play import PlayConfig
    from mjlab.scripts.profile_env import ProfileConfig
    from mjlab.scripts.publish import PublishConfig
    from mjlab.scripts.share import ShareConfig
    from mjlab.scripts.train import TrainConfig
    from mjlab.scripts.verify import VerifyConfig
    from mjlab.scripts.visualize_terrain import VisualizeTerrainConfig
    from mjlab.scripts.viz_nan import VizNanConfig
    from mjlab.tasks.tracking.options import MotionOptions

    train = TrainConfig.from_task("Mjlab-Cartpole-Swingup")
    others = [
        TrainConfig.from_task("Mjlab-Cartpole-Swingup", learner=learner)
        for learner in ("sac", "distillation")
    ]
    play = PlayConfig(env=train.env)
    return {
        # With the flags that motion tracking brings itself.
        "train": [train, *others, MotionOptions()],
        "train-seeds": [train, *others, {"seeds": None}],
        "demo": [play],
        "describe": [DescribeConfig(env=train.env), MotionOptions()],
        "play": [play, MotionOptions()],
        "share": [ShareConfig(env=train.env), MotionOptions()],
        "evaluate": [EvaluateConfig(env=train.env), MotionOptions()],
        "csv_to_npz": [CsvToNpzConfig()],
        "profile-env": [ProfileConfig(env=train.env)],
        "export-scene": [ExportSceneConfig()],
        "fit-actuators": [FitActuatorsConfig()],
        "new-robot": [NewRobotConfig()],
        "visualize_terrain": [VisualizeTerrainConfig()],
        "viz-nan": [VizNanConfig()],
        "verify": [VerifyConfig()],
        "check": [CheckConfig()],
        "check-deploy": [CheckDeployConfig()],
        "publish": [PublishConfig()],
    }


def _flags_of_gpu() -> set[str]:
    command = [sys.executable, str(ROOT / "benchmarks/gpu.py"), "--help"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return set(_FLAG.findall(said))


def _flags_of_sweep() -> set[str]:
    from mjlab.scripts.sweep import SweepFlags

    return {field.name.replace("_", "-") for field in fields(SweepFlags)}


def _has(config: object, path: list[str]) -> bool:
    if not path:
        return True
    name = path[0].replace("-", "_")
    if isinstance(config, dict):
        # Without entries, a task names its own, such as the metrics of `trigger_below`.
        return not config or (name in config and _has(config[name], path[1:]))
    if not is_dataclass(config) or name not in {field.name for field in fields(config)}:
        return False
    return _has(getattr(config, name), path[1:])


def _unknown(command: str, text: str) -> set[str]:
    """Return the flags in `text` that `command` does not have."""
    configs = _flags_of()[command]
    return {
        flag
        for flag in _FLAG.findall(text)
        if flag != "help" and not any(_has(config, flag.split(".")) for config in configs)
    }


def test_flags_are_fields_of_the_commands() -> None:
    unknown = set()
    elsewhere = (
        _ELSEWHERE
        | _TORCHRUN
        | _INSTALLERS
        | _OTHERS
        | _QUEUES
        | _OPTUNA
        | _flags_of_gpu()
        | _flags_of_sweep()
    )
    for page in PAGES:
        code = _code(page.read_text(encoding="utf-8"))
        flags = set.intersection(*(_unknown(command, code) for command in _flags_of()))
        unknown |= {f"{page.name}: --{flag}" for flag in flags - elsewhere}
    assert not unknown


def test_flags_on_a_command_line_are_of_that_command() -> None:
    """Command lines, and the tables of flags in the sections of `docs/reference/command_line.md`."""
    wrong = set()
    for page in [*PAGES, ROOT / "README.md", ROOT / "src/mjlab/demo/README.md"]:
        code = _code(page.read_text(encoding="utf-8")).replace("\\\n", " ")
        for command, rest in _COMMAND_LINE.findall(code):
            wrong |= {f"{page.name}: {command} --{flag}" for flag in _unknown(command, rest)}
    text = (ROOT / "docs" / "reference" / "command_line.md").read_text(encoding="utf-8")
    for command, section in re.findall(r"^## ([\w-]+)\n(.*?)(?=^## |\Z)", text, re.M | re.S):
        if command not in _flags_of():
            continue
        for row in re.findall(r"^\| (`--.*?) \|", section, re.MULTILINE):
            wrong |= {f"table of {command}: --{flag}" for flag in _unknown(command, row)}
    assert not wrong


def test_documented_objects_exist() -> None:
    named = [name for page in PAGES for name in _OBJECT.findall(page.read_text(encoding="utf-8"))]
    assert len(named) > 100
    for name in named:
        assert _resolve(name) is not None


def _resolve(name: str) -> object:
    try:
        return importlib.import_module(name)
    except ImportError:
        module, _, attribute = name.rpartition(".")
        return getattr(importlib.import_module(module), attribute)


API = [page for page in PAGES if page.parent.name == "api" and page.name != "index.md"]


@pytest.mark.parametrize("page", API, ids=[page.stem for page in API])
def test_names_are_imported_from_the_title_above(page: Path) -> None:
    entries = list(_documented(page))
    assert entries
    for package, module, name in entries:
        found = getattr(importlib.import_module(package), name)
        assert found is getattr(importlib.import_module(module), name)


def test_the_randomization_table_is_that_of_the_code() -> None:
    from mjlab.envs.mdp import dr

    text = (ROOT / "docs" / "how-to" / "randomization.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(\w+)` \| `(\w+)`[^|]*\| [^|]+ \| ([^|]+) \| (\w*) ?\|$", text, re.MULTILINE
    )
    signs = {"abs": "=", "scale": "*", "add": "+"}
    expected = {
        (
            row.name,
            row.field,
            "rotation" if row.rotation else f"`{row.operation}`, `{signs[row.operation]}U`",
            "yes" if row.recompute else "",
        )
        for row in (function.row for function in vars(dr).values() if hasattr(function, "row"))
    }
    assert set(rows) == expected
    functions = {getattr(dr, name).__name__ for name in dr.__all__ if name[0].islower()}
    assert functions <= set(re.findall(r"`(\w+)`", text))
