"""Our tasks as environments of LeRobot, whose own evaluator and training run on them."""

import json
from pathlib import Path

import numpy as np
import pytest
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from lerobot_helpers import ROOT, install_plugin, lerobot
from other_packages import beside

import osel_sim as osel
from osel_sim.core.errors import OselError
from osel_sim.suites.lerobot_env import OselSimEnv
from osel_sim.suites.registry import find_task


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_plugin(tmp_path_factory.mktemp("plugin"))


def test_an_environment_in_lerobots_words_is_the_instance_of_its_seed() -> None:
    config = OselSimEnv(task="lift", level=2, image_size=40)
    (env,) = config.create_envs(1)["lift"].values()
    observation, _ = env.reset(seed=[7], options={NEW_ROLLOUT_OPTION: True})
    batch = preprocess_observation(observation)
    task = find_task("lift")
    instance, alone = task.instance(7, level=2), task.open()
    alone.load(instance)
    shown = alone.observe(["agentview", "wrist"], 40)
    assert env.call("task_description") == (instance.instruction,) and env.call("_max_episode_steps") == (task.info.horizon,)
    assert set(batch) == {"observation.state", "observation.images.agentview", "observation.images.wrist"} == set(config.features) - {"action"}
    np.testing.assert_array_equal(observation["agent_pos"][0], shown["observation.state"])
    np.testing.assert_array_equal(observation["pixels"]["wrist"][0], shown["observation.images.wrist"])
    action = np.full((1, 7), 5.0, np.float32)  # beyond the bounds: clipped, as the episode loop does
    observation, *_, info = env.step(action)
    alone.advance(np.ones(7, np.float32))
    np.testing.assert_array_equal(observation["agent_pos"][0], alone.observe([], 1)["observation.state"])
    assert info["is_success"].tolist() == [False]
    env.close()
    assert env.reset(seed=[7])[0]["agent_pos"].shape == (1, 8)  # opened again
    env.close()
    alone.close()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"task": "pick_plce"}, "did you mean 'pick_place'"),
        ({"task": ""}, "--task is missing"),
        ({"cameras": ["wrst"]}, "unknown camera 'wrst': did you mean 'wrist'"),
        ({"level": 9}, "unknown level 9"),
        ({"split": "tst"}, "unknown split 'tst'"),
        ({"axes": {"camra": 1}}, "'camra'"),
        ({"robot": "Pnda"}, "did you mean 'Panda'"),
        ({"image_size": 0}, "image_size must be"),
        ({"video_size": 5000}, "video_size must be"),
    ],
)
def test_what_there_is_not_is_named(settings: dict[str, object], says: str) -> None:
    with pytest.raises(OselError, match=says):
        OselSimEnv(**settings)


@pytest.mark.slow
@pytest.mark.parametrize("vector", [["--eval.batch_size=1"], ["--eval.batch_size=2", "--eval.use_async_envs=true"]])
def test_lerobots_evaluator_comes_to_what_record_comes_to(vector: list[str], plugin: Path, tmp_path: Path) -> None:
    done = lerobot(
        "eval",
        [plugin],
        tmp_path,
        "--env.type=osel_sim",
        "--env.task=pick_place",
        '--env.cameras=["agentview"]',
        f"--policy.path={ROOT}/assets/policies/local_small",
        "--eval.n_episodes=4",
        "--seed=1000",
        "--output_dir=out",
        *vector,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    (measured,) = json.loads((tmp_path / "out" / "eval_info.json").read_text())["per_task"]
    recorded = osel.record(task="pick_place", policies=["local_small"], instances=4, start_seed=1000, out=tmp_path / "log").episodes
    assert measured["task_group"] == "pick_place"
    assert measured["metrics"]["successes"] == recorded.sort_values("seed")["success"].tolist()


ACT = "--policy.type=act --policy.chunk_size=8 --policy.n_action_steps=8 --policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32"
TINY = "--policy.n_encoder_layers=1 --policy.use_vae=false --policy.pretrained_backbone_weights=null --policy.push_to_hub=false --policy.device=cpu"
SHORT = "--steps=2 --batch_size=2 --num_workers=0 --save_freq=2"
MINE = """version = 1
name = "mine"
title = "ACT, trained by lerobot-train"
location = "local"
kind = "lerobot"
checkpoint = "{checkpoint}"
execute = 8
inference_seconds = 0.01

[observation]
cameras = ["agentview", "wrist"]
image_size = 96
"""


@pytest.mark.slow
def test_a_policy_file_loads_what_lerobots_training_makes_of_our_demonstrations(tmp_path: Path) -> None:
    accelerate = beside("accelerate==1.15.0")  # all that LeRobot's extra `training` wants beside what is here
    osel.collect(task="lift", episodes=2, out=tmp_path / "data")
    settings = [*ACT.split(), *TINY.split(), *SHORT.split()]
    done = lerobot("train", [accelerate], tmp_path, "--dataset.repo_id=mine/lift", "--dataset.root=data", "--output_dir=out", *settings)
    assert done.returncode == 0, done.stderr[-3000:]
    checkpoint = tmp_path / "out" / "checkpoints" / "000002" / "pretrained_model"
    (tmp_path / "mine.toml").write_text(MINE.format(checkpoint=checkpoint))
    policy, env = osel.load_policy("mine", policies_dir=tmp_path), find_task("lift").open()
    env.load(find_task("lift").instance(0))
    policy.reset("lift the cube")
    actions = policy.act(env.observe(["agentview", "wrist"], 96))
    assert actions.shape == (8, 7) and np.isfinite(actions).all()
    env.close()
