"""Result files of lerobot-eval and vla-eval as a rollout log: which pairing was found, and what is wrong with a file in one line."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from osel_sim.analysis.log import read_log
from osel_sim.formats.rollout_log import read_rollouts
from osel_sim.ingest import main as ingest_main


def lerobot(successes: dict[str, list[Any]]) -> dict[str, Any]:
    """As lerobot 0.6.1 writes it: an entry a task, without seeds."""
    tasks = []
    for name, values in successes.items():
        group, _, number = name.partition("/")
        rewards = [float(bool(value)) for value in values]
        metrics = {"sum_rewards": rewards, "max_rewards": rewards, "successes": values, "video_paths": []}
        tasks.append({"task_group": group, "task_id": int(number or 0), "metrics": metrics})
    return {"per_task": tasks, "per_group": {}, "overall": {"eval_s": 1.0}}


def alone(first: int, successes: list[bool]) -> dict[str, Any]:
    """As it was written where there was one environment: with seeds."""
    episodes = [{"episode_ix": i, "sum_reward": 0.5, "max_reward": 0.5, "success": done, "seed": first + i} for i, done in enumerate(successes)]
    return {"per_episode": episodes, "aggregated": {"pc_success": 50.0}}


def vla(successes: dict[str, list[bool]], seed: int | None = 7) -> dict[str, Any]:
    """As vla-eval 0.8.0 writes it."""
    tasks = [
        {
            "task": name,
            "num_episodes": len(values),
            "episodes": [
                {"episode_id": i, "metrics": {"success": done, "progress": 0.5 + done / 2}, "steps": 40 + i, "elapsed_sec": 1.5}
                for i, done in enumerate(values)
            ],
        }
        for name, values in successes.items()
    ]
    return {"benchmark": "Libero", "mode": "sync", "tasks": tasks, "config": {}} | ({} if seed is None else {"seed": seed})


def written(folder: Path, **files: dict[str, Any]) -> list[str]:
    """POLICY=FILE of each, all files called the same, as evaluators do."""
    given = []
    for policy, data in files.items():
        file = folder / policy / "eval_info.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(data))
        given.append(f"{policy}={file}")
    return given


def run(out: Path, given: list[str], *more: str) -> int:
    return ingest_main(["--results", *given, "--out", str(out), *more])


def outcomes(out: Path) -> dict[tuple[str, str], bool]:
    return {(row.instance, row.policy): row.success for row in read_rollouts(out)[0]}


def test_lerobots_episodes_are_paired_by_task_and_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    given = written(tmp_path, small=lerobot({"pusht": [True, False], "aloha": [False]}), large=lerobot({"pusht": [True, True], "aloha": [True]}))
    assert run(tmp_path / "log", given, "--price", "small=0", "large=12") == 0
    said = capsys.readouterr()
    assert "paired by task and number of the episode: 3 episodes of 2 tasks that all 2 policies ran" in said.out
    assert "no seeds are in" in caplog.text + said.err and "lerobot-eval --seed" in caplog.text + said.err
    found = outcomes(tmp_path / "log")
    assert found[("pusht/000001", "small")] is False and found[("pusht/000001", "large")] is True and len(found) == 6
    log = read_log(tmp_path / "log")
    assert log.contexts.shape[0] == 3 and {row.price for row in read_rollouts(tmp_path / "log")[0]} == {0.0, 12.0}


def test_groups_with_several_tasks_keep_their_numbers(tmp_path: Path) -> None:
    small, large = lerobot({"libero_10/0": [True], "libero_10/3": [False]}), lerobot({"libero_10/3": [True], "libero_10/0": [True]})
    assert run(tmp_path / "log", written(tmp_path, small=small, large=large)) == 0
    assert outcomes(tmp_path / "log")[("libero_10/3/000000", "small")] is False


def test_seeds_of_episodes_pair_them(tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    given = written(tmp_path, small=alone(1000, [True, False, True]), large=alone(1001, [True, False, True]))
    assert run(tmp_path / "log", given, "--score", "max_reward") == 0
    said = capsys.readouterr()
    assert "paired by task and seed: 2 episodes of 1 task" in said.out and "no seeds" not in caplog.text + said.err
    assert "1 of its 3 episodes" in caplog.text + said.err
    assert outcomes(tmp_path / "log") == {
        ("task/001001", "small"): False,
        ("task/001001", "large"): True,
        ("task/001002", "small"): True,
        ("task/001002", "large"): False,
    }


def test_vla_eval_brings_steps_errors_and_its_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = vla({"put_the_bowl_away": [True, True]})
    large["tasks"][0]["episodes"][1] = {"episode_id": 1, "metrics": {"success": False}, "failure_reason": "model_act", "failure_detail": "Traceback"}
    given = written(tmp_path, small=vla({"put_the_bowl_away": [True, False]}), large=large)
    assert run(tmp_path / "log", given, "--subgoals", "progress") == 0
    assert "by task, number of the episode and the run's seed, 7: 2 episodes of 1 task" in capsys.readouterr().out
    rows = {(row.instance, row.policy): row for row in read_rollouts(tmp_path / "log")[0]}
    failed, done = rows[("put_the_bowl_away/000001", "large")], rows[("put_the_bowl_away/000001", "small")]
    assert failed.error == "model_act" and not failed.success and failed.steps is None
    assert (done.steps, done.subgoals, done.error, done.instruction) == (41, 0.5, None, "put the bowl away")


def test_an_evaluator_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "log", written(tmp_path, small=lerobot({"lift": [True, False]}), large=vla({"lift": [True, True]}))) == 0
    assert len(outcomes(tmp_path / "log")) == 4  # steps, which only one of them has, are left out
    assert {row.steps for row in read_rollouts(tmp_path / "log")[0]} == {None}
    assert run(tmp_path / "more", written(tmp_path, small=lerobot({"lift": [True]}), large=vla({"lift": [True]})), "--steps", "steps") == 2
    assert "there is no 'steps', which --steps of policy 'large' names: measured in all of them: nothing else" in capsys.readouterr().err


def test_tasks_and_episodes_that_not_all_have_are_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    small, large = vla({"lift": [True, False, True], "push": [True]}), vla({"lift": [True, True], "stack": [False]})
    large["partial"] = True
    assert run(tmp_path / "log", written(tmp_path, small=small, large=large)) == 0
    said = capsys.readouterr().err + caplog.text
    for part in ("task push", "task stack", "1 of its 4 episodes", "the run was not finished"):
        assert part in said
    assert {instance for instance, _ in outcomes(tmp_path / "log")} == {"lift/000000", "lift/000001"}


BOTH = {"small": lerobot({"lift": [True, False]}), "large": lerobot({"lift": [True, True]})}
OTHER = vla({"lift": [True, False]})


def changed(data: dict[str, Any], *path: Any, value: Any = ...) -> dict[str, Any]:
    """A copy with a value within it replaced, or removed."""
    data = copy.deepcopy(data)
    inner: Any = data
    for key in path[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({"small": BOTH["small"]}, "needs the files of two policies or more, got 1"),
        ({**BOTH, "large": BOTH["small"]}, "is the same file as"),
        ({**BOTH, "large": {}}, "is of neither lerobot-eval (per_task) nor vla-eval (tasks); its keys: none"),
        ({**BOTH, "large": {"per_task": []}}, "has no episodes"),
        ({**BOTH, "large": {"per_task": {}}}, "per_task must be a list, got {}"),
        ({**BOTH, "large": {"per_task": [3]}}, "per_task[0]: must be an object, got 3"),
        ({**BOTH, "large": changed(BOTH["large"], "per_task", 0, "task_group")}, "per_task[0]: there is no task_group; its keys: task_id"),
        ({**BOTH, "large": changed(BOTH["large"], "per_task", 0, "task_id", value=True)}, "task_id must be an integer, got True"),
        ({**BOTH, "large": changed(BOTH["large"], "per_task", 0, "metrics", "successes")}, "per_task[0], metrics: there is no successes"),
        ({**BOTH, "large": lerobot({"lift": [True, float("nan")]})}, "task 'lift', episode 1, column 'success': is NaN"),
        ({**BOTH, "large": lerobot({"lift": [True, None]})}, "task 'lift/0', episode 1, column 'success': must be true or false, got nothing"),
        ({**BOTH, "large": lerobot({"lift": [True, "maybe"]})}, "must be true or false (or 1 or 0), got 'maybe'"),
        ({**BOTH, "large": lerobot({"lift": [True, 0.5]})}, "must be true or false (or 1 or 0), got 0.5"),
        ({**BOTH, "large": lerobot({"push": [True]})}, "no episode is in all of the files, by task and number of the episode:"),
        (
            {**BOTH, "large": changed(BOTH["large"], "per_task", 0, "metrics", "sum_rewards", value=[1.0])},
            "sum_rewards has 1 episodes, successes has 2",
        ),
        ({"small": alone(5, [True]), "large": alone(9, [True])}, "no episode is in all of the files, by task and seed"),
        ({"small": alone(5, [True]), "large": changed(alone(5, [True]), "per_episode", 0, "seed", value="5")}, "seed must be an integer, got '5'"),
        ({"small": OTHER, "large": vla({"lift": [True, True]}, seed=8)}, "different seeds"),
        (
            {"small": OTHER, "large": changed(OTHER, "tasks", 0, "episodes", 1, "metrics", "success")},
            "metrics: there is no success; its keys: progress",
        ),
        ({"small": OTHER, "large": changed(OTHER, "tasks", 0, "episodes", 1, "episode_id", value=0)}, "task 'lift', episode 0: is there twice"),
        ({"small": OTHER, "large": changed(OTHER, "tasks", 0, "episodes", 1, "steps", value=float("nan"))}, "episode 1, column 'steps'"),
        ({"small": OTHER, "large": changed(OTHER, "tasks", 0, "episodes", 1, "steps", value=-3)}, "episode 1, column 'steps'"),
        ({"small": OTHER, "large": changed(OTHER, "tasks", 0, "episodes", value="none")}, "tasks[0]: episodes must be a list, got 'none'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(files: dict[str, Any], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "log", written(tmp_path, **files)) != 0
    complaint = capsys.readouterr().err.strip().splitlines()
    assert says in complaint[-1] and len([line for line in complaint if line.startswith("error")]) == 1, complaint
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["eval_info.json", "b=x.json"], "must be POLICY=FILE, got 'eval_info.json'"),
        (["a=x.json", "a=y.json"], "policy 'a' is named twice"),
        (["a=nowhere.json", "b=x.json"], "nowhere.json cannot be read as JSON"),
    ],
)
def test_what_is_no_result_file_is_named(given: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "log", given) != 0
    assert says in capsys.readouterr().err
    assert run(tmp_path / "log", written(tmp_path, **BOTH), "--text", "task") != 0
    assert "--text does not go with --results" in capsys.readouterr().err
