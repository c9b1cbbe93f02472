"""`plot-seeds`: seeds as curves with their spread, and as a table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from mjlab.scripts.plot_seeds import common_goal, distinct_seeds, seeds_table

RETURN = "Train/exploring_return"
EACH = "Perf/collection_time"


@pytest.fixture
def make_run(tmp_path: Path):
    """Write the folder of a run whose return at iteration i is `slope * i`."""

    def make(
        name: str,
        seed: int | None,
        iterations: range,
        slope: float = 10.0,
        solved: int | None = None,
        **info: object,
    ) -> Path:
        from torch.utils.tensorboard import SummaryWriter

        folder = tmp_path / name
        writer = SummaryWriter(str(folder))
        for i in iterations:
            writer.add_scalar(RETURN, slope * i, i)
            writer.add_scalar(EACH, 1.0, i)
        if solved is not None:
            writer.add_scalar("Confirmation/mean_return", 950.0, solved - 1)
        writer.close()
        (folder / "run.json").write_text(json.dumps(info))
        evaluation = {"solved_return": 900.0, "num_episodes": 256}
        agent = {"evaluation": evaluation} | ({} if seed is None else {"seed": seed})
        (folder / "params").mkdir()
        (folder / "params" / "agent.yaml").write_text(yaml.safe_dump(agent))
        return folder

    return make


def test_the_parts_of_a_run_are_one_seed(make_run, capsys):
    first = make_run("1", 4, range(12))
    last = make_run("2", 4, range(10, 20), resumed="1/model_9.pt")
    for given in ([last], [first, last], [last, first], [last, last]):
        (seed,) = distinct_seeds("", given)
        assert seed.iterations == 20
        assert seed.curves[RETURN][0].tolist() == list(range(20))
        assert [part.name for part in seed.parts] == ["1", "2"]
    assert not capsys.readouterr().err


def test_a_part_that_is_gone_is_named(make_run, capsys):
    last = make_run("2", 4, range(10, 20), resumed="gone/model_9.pt")
    (seed,) = distinct_seeds("", [last])
    assert seed.curves[RETURN][0].tolist() == list(range(10, 20))
    assert "gone/model_9.pt" in capsys.readouterr().err


def test_runs_of_one_seed_are_one(make_run, capsys):
    short, long = make_run("a", 1, range(5)), make_run("b", 1, range(9))
    other = make_run("c", 2, range(9))
    seeds = distinct_seeds("walk", [long, short, other])
    assert [seed.run.folder for seed in seeds] == [long, other]
    told = capsys.readouterr().err
    assert "Seed 1 of 'walk' has 2 runs" in told
    assert str(short) in told
    # Seeds that are unknown may be distinct.
    unknown = [make_run(name, None, range(5)) for name in "de"]
    assert len(distinct_seeds("", unknown)) == 2


def test_resumes_with_another_seed_are_distinct(make_run):
    make_run("1", 4, range(12))
    five = make_run("2", 5, range(12, 20), resumed="1/model_11.pt")
    six = make_run("3", 6, range(12, 20), resumed="1/model_11.pt")
    assert [seed.numbers for seed in distinct_seeds("", [five, six])] == [(4, 5), (4, 6)]


def test_other_differences_than_the_seed_are_told(make_run, capsys):
    def told_of(*gammas: float, **info: object) -> str:
        folders = []
        for k, gamma in enumerate(gammas):
            settings = {"agent.gamma": gamma, "agent.max_iterations": k} if k else {}
            folder = make_run(
                f"{gammas}{k}{info}", k, range(3), settings=settings, task=info.get(f"task{k}")
            )
            agent = {"seed": k, "gamma": gamma, "max_iterations": k}
            (folder / "params" / "agent.yaml").write_text(yaml.safe_dump(agent))
            folders.append(folder)
        assert len(distinct_seeds("", folders)) == len(gammas)
        return capsys.readouterr().err

    assert "differ in agent.gamma," in told_of(0.9, 0.8, 0.9)
    # The value of the task, given as a flag.
    assert not told_of(0.9, 0.9)
    assert "differ in task," in told_of(0.9, 0.9, task0="A", task1="B")
    assert not told_of(0.9, 0.9, task0="A")


def test_the_table_has_values_where_all_seeds_have_data(make_run):
    groups = {
        "fast": distinct_seeds(
            "fast",
            [
                make_run("1", 1, range(20), slope=10.0, solved=20),
                make_run("2", 2, range(30), slope=20.0, solved=30),
            ],
        ),
        "slow": distinct_seeds("slow", [make_run("3", 1, range(40), slope=1.0)]),
    }
    fast, slow = seeds_table(groups, RETURN).records()
    assert fast["seeds"] == "1, 2"
    assert fast["at"] == 20
    assert fast["return"] == pytest.approx(15.0 * 19)
    assert fast["std"] == pytest.approx(10.0 * 19 / 2**0.5)
    assert fast["solved"] == "2 of 2"
    assert fast["solved at"] == "20 to 30 (median 25)"
    assert (slow["seeds"], slow["iterations"], slow["solved"]) == ("1", "40", "0 of 1")
    assert slow["std"] is None


def test_a_goal_is_drawn_if_all_runs_have_it(make_run):
    one, two = (make_run(str(k), k, range(3)) for k in (1, 2))
    assert common_goal(distinct_seeds("", [one, two]), RETURN) == 900.0
    assert common_goal(distinct_seeds("", [one, two]), "Train/mean_reward") is None
    agent = {"seed": 2, "evaluation": {"solved_return": 800.0}}
    (two / "params" / "agent.yaml").write_text(yaml.safe_dump(agent))
    assert common_goal(distinct_seeds("", [one, two]), RETURN) is None


def test_groups_are_drawn_and_listed(run, make_run, tmp_path):
    one, two, three = (str(make_run(str(k), k, range(5))) for k in (1, 2, 3))
    picture = tmp_path / "figures" / "seeds.png"
    words = ["--group", "a b", one, two, "--output", str(picture), "--group", "c", three]
    outcome = run("plot_seeds", *words)
    assert outcome.status == 0, outcome.err
    *table, path = outcome.out.split("\n")[:-1]
    assert path == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    rows = [line.split() for line in table if line]
    assert [row[:2] for row in rows[-2:]] == [["a", "b"], ["c", "3"]]
    # Folders before and after an option.
    assert run("plot_seeds", one, "--output", str(picture), two).status == 0


@pytest.mark.parametrize(
    ("words", "part"), [([], "run folders"), (["--group", "a"], "a name and run folders")]
)
def test_a_group_without_runs_is_an_error(run, words, part):
    outcome = run("plot_seeds", *words)
    assert outcome.status != 0
    assert part in outcome.message


@pytest.mark.parametrize("name", [".", "", "p.nope"])
def test_an_output_that_is_no_picture_names_its_flag(run, make_run, name):
    outcome = run("plot_seeds", str(make_run("1", 1, range(3))), "--output", name)
    assert outcome.status != 0
    assert "--output" in outcome.message


def test_what_is_no_run_is_named(run, make_run, tmp_path):
    good = str(make_run("1", 1, range(3)))
    for name in ("nowhere", "empty"):
        outcome = run("plot_seeds", good, str(tmp_path / name))
        assert outcome.status == 1
        assert str(tmp_path / name) in outcome.message
        (tmp_path / "empty").mkdir(exist_ok=True)


def test_a_trained_run_is_drawn(run, trained, tmp_path):
    outcome = run("plot_seeds", str(trained), "--output", str(tmp_path / "seeds.png"))
    assert outcome.status == 0, outcome.err
    assert (tmp_path / "seeds.png").is_file()
