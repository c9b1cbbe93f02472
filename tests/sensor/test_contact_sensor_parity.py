"""Both engines sense the same contacts."""

from __future__ import annotations

import pytest
import torch

from mjlab.sensor import ContactData
from mjlab.sensor.contact_sensor import FIELD_SIZES

from .contact_scenes import LOPSIDED, TERRAIN, body, build, geom, sense

ALL_FIELDS = tuple(FIELD_SIZES)
REDUCTIONS = ("none", "mindist", "maxforce", "netforce")
PARITY_TOLERANCE = 2e-3
ROLES = {
    "box_first": (geom("box"), TERRAIN),
    "ground_first": (body("terrain", "terrain"), geom("box")),
    "anything": (geom("box"), None),
}


def sensors():
    cfgs = []
    for role, (primary, secondary) in ROLES.items():
        for reduce in REDUCTIONS:
            cfg = sense(primary, secondary, fields=ALL_FIELDS, reduce=reduce, num_slots=4)
            cfg.name = f"{role}_{reduce}"
            cfgs.append(cfg)
            if reduce != "netforce":
                rotated = sense(
                    primary, secondary, fields=ALL_FIELDS, reduce=reduce, num_slots=4,
                    global_frame=True,
                )  # fmt: skip
                rotated.name = f"{role}_{reduce}_world"
                cfgs.append(rotated)
    return cfgs


@pytest.fixture(scope="module")
def scenes():
    """The same state on both engines: a box that slides and turns on four unequal contacts."""
    native, native_scene = build(*sensors(), box=LOPSIDED)
    warp, warp_scene = build(*sensors(), box=LOPSIDED, engine="warp")
    native.step(nstep=100)
    native.data.qvel[:, 0] += 0.02
    native.data.qvel[:, 5] += 0.05
    native.data.qvel[1, 1] += 0.03
    for name in ("qpos", "qvel", "qacc_warmstart"):
        getattr(warp.data, name).copy_(getattr(native.data, name))
    for sim, scene in ((native, native_scene), (warp, warp_scene)):
        sim.data.sensordata.fill_(float("nan"))
        sim.forward()
        assert (scene["box_first_none"].data.found == 4).all()
    return native_scene, warp_scene


def in_one_order(data: ContactData) -> ContactData:
    """Sort the slots of each environment by position, where their order is not determined."""
    keys = data.pos[..., 0] * 7 + data.pos[..., 1]
    order = keys.argsort(dim=1)
    sort = lambda value: value.gather(  # noqa: E731
        1, order if value.dim() == 2 else order.unsqueeze(-1).expand_as(value)
    )
    return ContactData(**{name: sort(getattr(data, name)) for name in ALL_FIELDS})


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("reduce", REDUCTIONS)
@pytest.mark.parametrize("frame", ["", "_world"])
def test_every_field_agrees(scenes, role, reduce, frame):
    if reduce == "netforce" and frame:
        pytest.skip("a net force is in the world frame anyway")
    native, warp = (scene[f"{role}_{reduce}{frame}"].data for scene in scenes)
    if reduce == "none":
        native, warp = in_one_order(native), in_one_order(warp)
    for name in ALL_FIELDS:
        expected, actual = getattr(native, name), getattr(warp, name)
        scale = expected.abs().max()
        if name == "torque":
            # Forces of both signs act at up to 0.1 m from the point, and nearly cancel.
            scale = scale.clamp(min=0.1 * native.force.abs().max())
        scale = scale.clamp(min=1e-3)
        error = ((actual - expected).abs() / scale).max()
        assert error < PARITY_TOLERANCE, (name, expected[0], actual[0])
    if reduce != "netforce":
        assert native.force.abs().sum() > 1.0
    assert torch.isfinite(warp.force).all()
