"""Hostile names of models, runs, trackers and terms in pages: shown as text, as a browser receives them."""

from __future__ import annotations

import html
import importlib
import json
import random
import re
import time
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from .commands import TASK, free_port
from .trials import Broken, Trial, name_of

WHAT = "hostile names of joints, bodies, runs, terms, motions and dumps in pages and notebooks"
TRIALS = 60
LIMIT = 60.0

_PARTS = (
    '<iframe srcdoc="<script>f()</script>">', "<img src=x onerror=f()>", "<script>f()</script>",
    "[a](javascript:f())", "![a](data:x)", "</div>", "</td>", "-->", "<!--", "<svg/onload=f()>", "<https://a.b>",
    "www.a.b", "`", "``", "*", "**", "_", "__", "~~", "|", "\\", "\\|", "{f()}", "&lt;b&gt;", "&#60;b&#62;",
    "'", '"', "$", "#", "a_b", "left_hip*", "hip.", "(rad)", "é", "1", " ", "\n", "\n\n<b>", "\n| a |", "\t",
)  # fmt: skip
# Tags of the pages' own.
_TAGS = {"p", "strong", "table", "thead", "tbody", "tr", "th", "td", "div", "span", "small", "a", "br",
         "details", "summary", "b", "code"}  # fmt: skip
_ATTRIBUTES = {"style", "href", "open"}


def preload() -> None:
    """Import what pages need."""
    for name in (
        "mjlab.scripts.view", "mjlab.scripts.viz_nan", "mjlab.viewer.page_proxy", "websockets.sync.client",
        "mjlab.viewer.viser.viewer", "mjlab.viewer.viser.live", "mjlab.tasks.tracking.mdp.motion_panel",
        "markdown_it",
    ):  # fmt: skip
        importlib.import_module(name)


def prepare(folder: Path) -> None:
    """Return nothing: trials share no data."""


def run(trial: Trial, prepared: Any) -> None:
    """Build a page with hostile names and read what a browser receives."""
    from mjlab.viewer.page_server import serve_page

    build = _PAGES[trial.number % len(_PAGES)]
    names = [_hostile(trial.rng) for _ in range(4)]
    trial.trying(f"{name_of(build)}: {names}")
    server = serve_page(port=free_port())
    try:
        expected = build(server, names)
        shown = _received(server)
    finally:
        server.stop()
    text = " ".join(_text_of(content) for content in shown)
    for name in expected:
        if _words(name) not in _words(text):
            raise Broken(f"{name!r} is not shown as it is, in {text[:1000]!r}")


def _hostile(rng: random.Random) -> str:
    return "".join(rng.choices(_PARTS, k=rng.randrange(1, 5))) + str(rng.randrange(1000))


# Pages. Each returns the names that it shows in Markdown or HTML.


def _model(server: Any, names: list[str]) -> list[str]:
    from mjlab.viewer.viser.model_page import ModelPage

    model = _model_of(names)
    ModelPage(server, names[0], model, lambda: model)
    return names[:2]


def _damaged_model(server: Any, names: list[str]) -> list[str]:
    from mjlab.utils.errors import UserError
    from mjlab.viewer.viser.model_page import ModelPage

    def fail() -> Any:
        raise UserError(names[1])

    ModelPage(server, names[0], _model_of(names), fail).reload()
    return names[:2]


def _dump(server: Any, names: list[str]) -> list[str]:
    from mjlab.utils.nan_guard import NanDump
    from mjlab.viewer.viser.nan_page import NanPage

    model = _model_of(names)
    width = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
    metadata = {
        "dumped_env_ids": [2], "nan_env_ids": [2], "num_envs_total": 4, "num_envs_dumped": 1,
        "detection_step": 1, "state_spec": int(mujoco.mjtState.mjSTATE_INTEGRATION), "state_size": width,
    }  # fmt: skip
    np.savez(
        "dump.npz",
        _metadata=json.dumps(metadata | {"model_file": "m.mjb"}),
        states_step_000000=np.zeros((1, width)),
    )
    NanPage(server, NanDump.load(Path("dump.npz")), model)
    return [names[1]]


def _viewer(server: Any, names: list[str]) -> list[str]:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import MetricsTermCfg, RewardTermCfg
    from mjlab.tasks.registry import load_env_cfg
    from mjlab.viewer.viser.viewer import CheckpointManager, ViserPlayViewer

    def own(env: Any) -> Any:
        return env.episode_length_buf * 0.0

    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs = 2
    cfg.rewards |= {names[0]: RewardTermCfg(func=own, weight=1.0)}
    cfg.metrics |= {names[1]: MetricsTermCfg(func=own)}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    manager = CheckpointManager(
        current_name=names[2], fetch_available=lambda: [(names[2], "1m ago"), ("\udcff", "2m ago")],
        load_checkpoint=lambda name: _raise(OSError(name)), run_name=names[3], run_status=names[1],
        run_url=None if len(names[0]) % 2 else f"https://a.b/{names[0]}",
    )  # fmt: skip
    policy = env.action_manager.action.clone
    viewer = ViserPlayViewer(
        env, lambda obs: policy(), viser_server=server, checkpoint_manager=manager
    )
    viewer.setup()
    viewer.step_simulation()
    viewer.sync_env_to_viewer()
    viewer._checkpoint_panel.load(names[2])
    # A notebook shows the tables of the environment, in ASCII.
    tables = env._repr_html_()
    name = names[0].encode("ascii", "backslashreplace").decode()
    if _words(name) not in _words(_text_of(tables)):
        raise Broken(f"{names[0]!r} is not in the table: {tables[:1000]!r}")
    return [names[0], names[2], names[3]]


def _live(server: Any, names: list[str]) -> list[str]:
    from mjlab.viewer.viser.live import progress_html

    progress = {
        "iteration": 1, "total_iterations": 2, "rows": [(names[1], names[2])], "unit": names[3],
        "evaluations": {}, "goal": None,
    }  # fmt: skip
    server.gui.add_html(progress_html(names[0], progress, 1.0))
    return [names[0], names[2], names[3]]


def _motion(server: Any, names: list[str]) -> list[str]:
    import torch

    from mjlab.tasks.tracking.mdp.motion_panel import MotionPanel

    bodies, turns = torch.zeros(1, 2, 3), torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, 2, 4)
    frame = SimpleNamespace(
        body_names=names[:2], robot_body_pos_w=bodies, body_pos_relative_w=bodies, body_pos_w=bodies,
        body_quat_relative_w=turns, robot_body_quat_w=turns,
    )  # fmt: skip
    command: Any = SimpleNamespace(
        motion=SimpleNamespace(names=[*names[2:], "\udcff"], lengths=[5, 5, 5]), num_envs=1,
        motion_ids=[0], time_steps=[1], matching_frame=frame,
        drawing=SimpleNamespace(offset=np.zeros(3)),
    )  # fmt: skip
    MotionPanel(names[0], server, command, lambda: 0).update()
    return names[:2]


_PAGES: tuple[Callable[[Any, list[str]], list[str]], ...] = (
    _model, _damaged_model, _dump, _viewer, _live, _motion,
)  # fmt: skip


def _raise(error: Exception) -> Any:
    raise error


def _model_of(names: list[str]) -> mujoco.MjModel:
    """Return a model whose only joint, body, actuator and keyframe have the names."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name=names[0])
    body.add_geom(name=names[3], size=[0.1, 0.1, 0.1], type=mujoco.mjtGeom.mjGEOM_BOX)
    body.add_joint(name=names[1])
    spec.add_key(name=names[2], qpos=[0.1])
    spec.add_actuator(name=names[3], trntype=mujoco.mjtTrn.mjTRN_JOINT, target=names[1])
    return spec.compile()


# Client.


def _received(server: Any) -> list[str]:
    """Return the HTML of all Markdown and HTML that a browser receives."""
    import msgspec
    import viser
    import zstandard
    from markdown_it import MarkdownIt
    from websockets.sync.client import connect

    contents: dict[str, str] = {}
    markdown = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    end = time.monotonic() + 10.0
    url = f"ws://127.0.0.1:{server.get_port()}"
    with connect(url, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as connection:  # ty: ignore
        while time.monotonic() < end:
            data = connection.recv(10.0)
            size = int.from_bytes(data[8:16], "little")
            for message in msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + size]))[
                "messages"
            ]:
                parts = message.get("props") or message.get("updates") or {}
                if "_markdown" in parts:
                    contents[message["uuid"]] = markdown.render(parts["_markdown"])
                elif (
                    message["type"] == "GuiHtmlMessage"
                    or message.get("uuid") in contents
                    and "content" in parts
                ):
                    contents[message["uuid"]] = parts["content"]
                if message["type"] == "ReplayDoneMessage":
                    return list(contents.values())
    raise Broken("the page does not finish loading")


class _Reader(HTMLParser):
    """Collects text; raises Broken at tags that no page uses."""

    def __init__(self) -> None:
        super().__init__()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        bad = [name for name, _ in attrs if name not in _ATTRIBUTES]
        links = [value or "" for name, value in attrs if name == "href"]
        if tag not in _TAGS or bad or any(not link.startswith("https://a.b/") for link in links):
            raise Broken(f"live tag {self.get_starttag_text()!r}")

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_comment(self, data: str) -> None:
        raise Broken(f"live comment {data!r}")


def _text_of(content: str) -> str:
    reader = _Reader()
    reader.feed(content)
    reader.close()
    return reader.text


def _words(text: str) -> str:
    """Return text as a browser shows it, without repeated spaces."""
    return re.sub(r"\s+", " ", html.unescape(html.escape(text))).strip().lower()
