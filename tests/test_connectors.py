"""Policies trained elsewhere: real small checkpoints of LeRobot, a real server of openpi's kind, and the scripted expert."""

import dataclasses
import json
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE

from osel_sim import doctor
from osel_sim.core import content
from osel_sim.core.errors import CheckpointError, ContentError, PolicyError, RemoteError, UsageError
from osel_sim.episodes.drivers import choose_policies
from osel_sim.formats import library
from osel_sim.formats.conventions import Conventions
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.interface.specification import specification
from osel_sim.policy.lerobot_policy import load
from osel_sim.policy.mapping import actions_of, message_of, orientation, state_of, state_size
from osel_sim.policy.registry import session_factory
from osel_sim.remote.policy import open_remote

SIZE = 32
ROBOT = specification()
STATE = np.array([0.1, 0.2, 1.0, np.pi / 2, 0.0, 0.0, 0.04, -0.04], np.float32)


def observation(**changes: Any) -> dict[str, Any]:
    images = {f"observation.images.{camera}": np.full((SIZE, SIZE, 3), value, np.uint8) for camera, value in (("agentview", 50), ("wrist", 200))}
    return {**images, OBS_STATE: STATE, "task": "put the can in the basket", **changes}


# -- numbers -----------------------------------------------------------------------------------------------------------


def test_a_state_is_put_together_from_its_parts() -> None:
    parts = ("position", "quaternion", "gripper")
    half = np.sqrt(0.5)
    assert state_of(observation(), Conventions(state_parts=parts), ROBOT) == pytest.approx([0.1, 0.2, 1.0, half, 0, 0, half, 1.0])
    assert state_of(observation(), Conventions(state_parts=("euler",)), ROBOT) == pytest.approx([np.pi / 2, 0, 0])
    assert np.array_equal(state_of(observation(), Conventions(), ROBOT), STATE)
    assert state_size(Conventions(state_parts=parts), ROBOT) == 8


def test_rotations_agree_with_another_implementation(recwarn: pytest.WarningsRecorder) -> None:
    import mujoco

    for vector in [*np.random.default_rng(0).uniform(-2, 2, (50, 3)), np.array([0.0, np.pi / 2, 0.0]), np.zeros(3)]:
        angle = float(np.linalg.norm(vector))
        expected, composed, turn = np.zeros(4), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4)
        mujoco.mju_axisAngle2Quat(expected, vector / max(angle, 1e-12), angle)
        for axis, part in zip(np.eye(3), orientation(vector, "euler"), strict=True):  # about fixed axes: later turns from the left
            mujoco.mju_axisAngle2Quat(turn, axis, part)
            mujoco.mju_mulQuat(composed, turn.copy(), composed.copy())
        assert orientation(vector, "quaternion") == pytest.approx(np.roll(expected * np.sign(expected[0]), -1), abs=1e-12)
        assert composed * np.sign(composed[0]) == pytest.approx(expected * np.sign(expected[0]), abs=1e-6)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("gripper", "opened", "closed"), [("closed_positive", -1, 1), ("open_positive", 1, -1), ("closed_one", 0, 1), ("open_one", 1, 0)]
)
def test_every_gripper_convention_ends_in_ours(gripper: str, opened: float, closed: float) -> None:
    chunk = np.zeros((2, 7))
    chunk[:, 6] = opened, closed
    chunk[:, 0] = 0.01
    actions = actions_of(chunk, Conventions(gripper=gripper, scale=(20.0, 20.0, 20.0, 2.0, 2.0, 2.0)), ROBOT.action)
    assert actions[:, 6].tolist() == [-1, 1] and actions[:, 0] == pytest.approx(0.2)


def test_columns_are_picked_and_a_wrong_width_is_explained() -> None:
    wide = np.arange(32.0)[None].repeat(3, axis=0)
    assert actions_of(wide, Conventions(columns=(0, 1, 2, 3, 4, 5, 7)), ROBOT.action)[0].tolist() == [0, 1, 2, 3, 4, 5, 7]
    with pytest.raises(PolicyError, match=r"shape \(3, 32\), the robot takes \(T, 7\).*columns"):
        actions_of(wide, Conventions(), ROBOT.action)
    with pytest.raises(PolicyError, match=r"columns = .* needs more"):
        actions_of(np.zeros(6), Conventions(columns=(0, 1, 2, 3, 4, 5, 6)), ROBOT.action)


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", sorted((content.root() / "examples" / "policies").glob("*.toml")), ids=lambda file: file.stem)
def test_the_example_files_are_right(file: Path) -> None:
    spec = load_policy_file(file)
    message = message_of(observation(), spec.mapping, spec.cameras, ROBOT)
    assert spec.mapping.prompt in message and all(spec.mapping.key(camera) in message for camera in spec.cameras)


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ('images = { agentvie = "image" }', "mapping.images.agentvie: unknown value 'agentvie', did you mean 'agentview'?"),
        ('gripper = "open_is_one"', "mapping.gripper: unknown value 'open_is_one', did you mean 'open_one'?"),
        ("columns = []", "mapping.columns: must be column numbers"),
        ('prompt = "observation.state"', "two inputs have the name 'observation.state'"),
        ('sate = "x"', "mapping.sate: is not a known key, did you mean 'state'?"),
    ],
)
def test_a_wrong_mapping_names_the_key(mapping: str, message: str, tmp_path: Path) -> None:
    text = (content.root() / "policies" / "local_small.toml").read_text()
    (tmp_path / "local_small.toml").write_text(f"{text}\n[mapping]\n{mapping}\n")
    with pytest.raises(ContentError) as failure:
        load_policy_file(tmp_path / "local_small.toml")
    assert message in str(failure.value)


def test_an_openpi_file_needs_an_address(tmp_path: Path) -> None:
    text = (content.root() / "examples" / "policies" / "openvla.toml").read_text()
    (tmp_path / "openvla.toml").write_text(text.replace('url = "ws://127.0.0.1:8001"\n', ""))
    with pytest.raises(ContentError, match=r"remote\.url: is missing.*ws://host:port"):
        load_policy_file(tmp_path / "openvla.toml")


# -- checkpoints -------------------------------------------------------------------------------------------------------


def save_act(folder: Path, state: int = 8, action: int = 7, statistics: bool = True, images: tuple[str, ...] = ("image", "image2")) -> Path:
    """A tiny ACT with the names that LIBERO's datasets have."""
    inputs = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)) for name in images}
    inputs[OBS_STATE] = PolicyFeature(FeatureType.STATE, (state,))
    config = ACTConfig(
        device="cpu",
        input_features=inputs,
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (action,))},
        chunk_size=8,
        n_action_steps=8,
        pretrained_backbone_weights=None,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
    )
    torch.manual_seed(0)
    ACTPolicy(config).save_pretrained(folder)
    stats: dict[str, Any] = {key: {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.2)} for key in config.image_features}
    stats |= {
        OBS_STATE: {"mean": torch.zeros(state), "std": torch.ones(state)},
        ACTION: {"mean": torch.zeros(action), "std": torch.full((action,), 0.3)},
    }
    for pipeline in make_pre_post_processors(config, dataset_stats=stats if statistics else None):
        pipeline.save_pretrained(folder)
    return folder


def spec_of(folder: Path, **mapping: Any) -> Any:
    given = {"images": {"agentview": "observation.images.image", "wrist": "observation.images.image2"}} | mapping
    local = library.load_policy("local_small")
    return dataclasses.replace(local, cameras=("agentview", "wrist"), image_size=SIZE, checkpoint=str(folder), mapping=Conventions(**given))


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_act(tmp_path_factory.mktemp("act"))


def chunk_of(spec: Any, **changes: Any) -> np.ndarray:
    policy = load(spec, ROBOT)()
    policy.reset("put the can in the basket")
    return np.asarray(policy.act(observation(**changes)))


def test_a_checkpoint_with_other_names_drives(act: Path) -> None:
    chunk = chunk_of(spec_of(act))
    assert chunk.shape == (8, 7) and np.ptp(chunk) > 0
    swapped = {"agentview": "observation.images.image2", "wrist": "observation.images.image"}
    assert not np.array_equal(chunk, chunk_of(spec_of(act, images=swapped)))
    turned = chunk_of(spec_of(act, gripper="open_positive"))
    assert np.array_equal(turned[:, :6], chunk[:, :6]) and np.array_equal(turned[:, 6], -chunk[:, 6])
    assert not np.array_equal(chunk, chunk_of(spec_of(act, state_parts=("position", "quaternion", "gripper"))))
    half = spec_of(act, images={"agentview": "observation.images.image"}, blank=("observation.images.image2",))
    only = dataclasses.replace(half, cameras=("agentview",))
    assert np.array_equal(chunk_of(only), chunk_of(only, **{"observation.images.wrist": np.zeros((SIZE, SIZE, 3), np.uint8)}))


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (
            {"images": {}},
            ["it wants observation.images.image,", "the policy file gives observation.images.agentview", '[mapping.images] agentview = "'],
        ),
        (
            {"images": {"agentview": "observation.images.image", "wrist": "observation.images.wrist_image"}},
            ["[mapping] gives it observation.images.wrist_image, which it does not know", "it wants observation.images.image2"],
        ),
        ({"state_parts": ("position", "quaternion", "fingers")}, ["of shape (8,), the simulation gives (9,): position 3 + quaternion 4 + fingers 2"]),
        ({"columns": (0, 1, 2, 3, 4, 5, 9)}, ["names number 9 of an action"]),
    ],
)
def test_a_wrong_mapping_is_explained_at_load(act: Path, mapping: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(CheckpointError) as failure:
        load(spec_of(act, **mapping), ROBOT)
    assert all(word in str(failure.value) for word in words), str(failure.value)


def test_wrong_dimensions_and_missing_statistics_are_explained(tmp_path: Path) -> None:
    wide = save_act(tmp_path / "wide", state=14, action=14)
    with pytest.raises(CheckpointError, match=r"it wants observation.state of shape \(14,\).*it gives action of shape \(14,\).*columns"):
        load(spec_of(wide), ROBOT)
    bare = save_act(tmp_path / "bare", statistics=False)
    with pytest.raises(CheckpointError, match=r"normalised .*observation\.state.*action.*hold no statistics.*normalised = false"):
        load(spec_of(bare), ROBOT)
    assert chunk_of(spec_of(bare, normalised=False)).shape == (8, 7)
    for file in bare.glob("policy_preprocessor*"):
        file.unlink()
    with pytest.raises(CheckpointError, match=r"has no policy_preprocessor\.json.*migrate_policy_normalization"):
        load(spec_of(bare), ROBOT)


# -- openpi ------------------------------------------------------------------------------------------------------------

SERVER = """
    # As openpi's own server (websocket_policy_server.py) does it: greeting, then an answer for each frame; an exception goes back as a traceback.
    import traceback
    import numpy as np
    from openpi_client import msgpack_numpy
    from websockets.sync.server import serve

    def infer(request):
        images = [request["observation/image"], request["observation/wrist_image"]]
        assert all(image.shape == (32, 32, 3) and image.dtype == np.uint8 for image in images)
        state = request["observation/state"]
        if state.shape != (8,):
            raise ValueError(f"state must have shape (8,), got {state.shape}")
        chunk = np.zeros((10, 32))
        chunk[:, :6] = state[:6] + images[0].mean() / 1000
        chunk[:, 6] = len(request["prompt"]) % 2
        return {"actions": chunk, "state": state, "policy_timing": {"infer_ms": 1.0}}

    def handle(connection):
        connection.send(msgpack_numpy.packb({"model": "pi0_libero"}))
        for frame in connection:
            try:
                connection.send(msgpack_numpy.packb(infer(msgpack_numpy.unpackb(frame))))
            except Exception:
                connection.send(traceback.format_exc())
                connection.close(1011)

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        print(server.socket.getsockname()[1], flush=True)
        server.serve_forever()
"""


@pytest.fixture(scope="module")
def openpi() -> Iterator[str]:
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(SERVER)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    yield f"ws://127.0.0.1:{process.stdout.readline().strip()}"
    process.terminate()
    process.wait()
    process.stdout.close()


def openpi_file(folder: Path, url: str, mapping: str) -> Path:
    text = (content.root() / "examples" / "policies" / "pi0_libero.toml").read_text()
    head, tail = text[: text.index("[mapping]")], text[text.index("[remote]") :]
    file = folder / "pi0_libero.toml"
    file.write_text((head + "[mapping]\n" + mapping + tail).replace("ws://127.0.0.1:8000", url).replace("image_size = 256", "image_size = 32"))
    return file


NAMES = 'state = "observation/state"\nprompt = "prompt"\nimages = { agentview = "observation/image", wrist = "observation/wrist_image" }\n'
COLUMNS = "columns = [0, 1, 2, 3, 4, 5, 6]\n"


def test_an_openpi_server_gets_its_own_names_and_its_actions_are_read(openpi: str, tmp_path: Path) -> None:
    spec = load_policy_file(
        openpi_file(tmp_path, openpi, NAMES + "columns = [0, 1, 2, 3, 4, 5, 6]\ngripper = 'open_one'\nscale = [2, 2, 2, 1, 1, 1]\n")
    )
    remote = open_remote(dataclasses.replace(spec, remote=dataclasses.replace(spec.remote, network="none")) if spec.remote else spec, ROBOT)
    try:
        remote.reset("put the can in the basket", (0,))
        call = remote.call(observation())
        assert call.failure is None and call.actions is not None
        assert call.actions.shape == (10, 7) and call.actions[0, 0] == pytest.approx(2 * (0.1 + 0.05))
        assert call.actions[0, 6] == -1.0  # 25 letters: an odd number, 1, which is open there
    finally:
        remote.close()


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (NAMES.replace("observation/image", "observation/picture"), ["KeyError: 'observation/image'", "observation/picture (uint8 (32, 32, 3))"]),
        (NAMES + 'state_parts = ["position", "quaternion", "fingers"]\n', ["state must have shape (8,), got (9,)"]),
        (NAMES, ["actions have the shape (10, 32), the robot takes (T, 7)", "columns"]),
        (NAMES + 'actions = "action"\n', ["answered without action (it has: actions (float64 (10, 32)), state (float32 (8,)), policy_timing"]),
    ],
)
def test_what_an_openpi_server_does_not_take_is_explained_at_load(openpi: str, mapping: str, words: list[str], tmp_path: Path) -> None:
    with pytest.raises(RemoteError) as failure:
        open_remote(load_policy_file(openpi_file(tmp_path, openpi, mapping)), ROBOT)
    assert all(word in str(failure.value) for word in [*words, "pi0_libero.toml", "[mapping]"]), str(failure.value)


def test_a_server_whose_chunks_are_too_short_is_refused(openpi: str, tmp_path: Path) -> None:
    spec = load_policy_file(openpi_file(tmp_path, openpi, NAMES + COLUMNS))
    with pytest.raises(RemoteError, match=r"chunks hold 10 actions, execute = 11"):
        open_remote(dataclasses.replace(spec, execute=11), ROBOT)


# -- the expert, and the doctor ----------------------------------------------------------------------------------------


def test_the_expert_is_only_used_where_it_is_named_and_never_served(tmp_path: Path) -> None:
    assert "scripted_expert" not in [spec.name for spec in choose_policies(None, ROBOT)]
    (spec,) = choose_policies(["scripted_expert"], ROBOT)
    assert spec.is_privileged and not spec.is_remote
    with pytest.raises(UsageError, match="cannot be served"):
        session_factory(spec, ROBOT)
    text = spec.file.read_text()
    (tmp_path / "scripted_expert.toml").write_text(text.replace('"local"', '"remote"'))
    with pytest.raises(ContentError, match="location: must be 'local'"):
        load_policy_file(tmp_path / "scripted_expert.toml")


def test_the_doctor_runs_the_expert_to_success(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--policy", "scripted_expert", "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["outcome"]["success"] and report["outcome"]["error"] is None
    assert report["calls"] == report["outcome"]["steps"] and report["chunk"] == [1, 1]
    assert json.loads((tmp_path / "report.json").read_text()) == report


def test_the_doctor_sees_that_a_policy_is_wrongly_connected(act: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tiny ACT without language: it acts, but not on the instruction, and its state is not ours."""
    text = (
        (content.root() / "policies" / "local_small.toml")
        .read_text()
        .replace("local_small", "mine")
        .replace('["agentview"]', '["agentview", "wrist"]')
    )
    mapping = (
        '[mapping]\nscale = [100, 100, 100, 1, 1, 1]\nimages = { agentview = "observation.images.image", wrist = "observation.images.image2" }\n'
    )
    (tmp_path / "mine.toml").write_text(text.replace("assets/policies/mine", str(act)) + mapping)
    assert doctor.main(["--policy", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr().out
    assert "does not read the instruction" in shown
    assert (tmp_path / "out" / "call000_wrist.png").is_file()
    assert doctor.main(["--policy", str(tmp_path / "none.toml")]) == 2
