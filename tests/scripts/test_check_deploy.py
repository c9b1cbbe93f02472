"""The command `check-deploy`."""

from __future__ import annotations

import json

import pytest

from mjlab.scripts.check_deploy import command
from mjlab.scripts.deploy import command as deploy
from mjlab.utils.errors import UserError


def test_command_prints_and_exits(tmp_path, capsys):
    folder = tmp_path / "bundle"
    deploy(["go1", "--output", str(folder), "--steps", "20"], "deploy")
    command([str(folder)], "check-deploy")
    assert "PASSED" in capsys.readouterr().out
    text = (folder / "contract.json").read_text()
    content = json.loads(text)
    content["actions"][0]["scale"] = [1.0] * 12
    (folder / "contract.json").write_text(json.dumps(content))
    with pytest.raises(SystemExit) as status:
        command([str(folder), "--json"], "check-deploy")
    assert status.value.code == 1
    printed = json.loads(capsys.readouterr().out)
    assert not printed["passed"]
    # `deploy.yaml` differs from the contract, too, whatever the cause.
    causes = {one["cause"] for one in printed["findings"]} - {None}
    assert causes == {"other action scale of some joints"}
    (folder / "contract.json").write_text(text)
    command([str(folder), "--log", str(folder / "golden.csv")], "check-deploy")
    command([str(folder), "--answers", str(folder / "golden.csv")], "check-deploy")
    assert capsys.readouterr().out.count("PASSED") == 2
    # A passport is of the bundle, whatever a log says.
    log, passport = tmp_path / "log.csv", tmp_path / "passport.html"
    table = (folder / "golden.csv").read_text()
    log.write_text(table.replace(",action.0,action.1,", ",action.1,action.0,"))
    flags = ["--stress", "--episodes", "1", "--seconds", "0.02", "--output", str(passport)]
    with pytest.raises(SystemExit):
        command([str(folder), "--log", str(log), *flags], "check-deploy")
    assert "FAILED" in capsys.readouterr().out
    assert "Check: passed" in passport.read_text()


def test_folder_without_contract(tmp_path):
    with pytest.raises(UserError, match="mjlab deploy"):
        command([str(tmp_path)], "check-deploy")
