"""Foot observations against values known by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from stand_ins import StandInEnv, contacts

from mjlab.tasks.velocity import mdp


def test_feet_are_observed_as_their_sensors_measure_them():
    scan = SimpleNamespace(data=SimpleNamespace(heights=torch.tensor([[0.1, 0.2]])))
    found, air = torch.tensor([[0.0, 3.0]]), torch.tensor([[0.4, 0.0]])
    env: Any = StandInEnv(1, scan=scan, feet=contacts(found=found, current_air_time=air))
    assert torch.equal(mdp.foot_height(env, "scan"), scan.data.heights)
    assert torch.equal(mdp.foot_air_time(env, "feet"), air)
    assert mdp.foot_contact(env, "feet").tolist() == [[0.0, 1.0]]


def test_contact_forces_are_observed_on_a_logarithmic_scale_foot_by_foot():
    force = torch.tensor([[[0.0, math.e - 1, 1.0 - math.e], [100.0, -100.0, 0.0]]])
    env: Any = StandInEnv(1, feet=contacts(force=force))
    observed = mdp.foot_contact_forces(env, "feet")
    log = math.log(101.0)
    assert observed.tolist() == [pytest.approx([0.0, 1.0, -1.0, log, -log, 0.0])]
