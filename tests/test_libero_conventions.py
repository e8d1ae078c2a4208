"""What LIBERO's policies were trained on, held against robosuite's own observables, LeRobot's processor and openpi's client tools."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import robosuite
import torch
from lerobot.processor.env_processor import LiberoProcessorStep
from openpi_client import image_tools, msgpack_numpy
from robosuite.utils.binding_utils import MjRenderContextOffscreen, MjSim
from scipy.spatial.transform import Rotation

from osel_sim.core import content
from osel_sim.core.errors import ContentError
from osel_sim.formats.conventions import Conventions
from osel_sim.formats.policy_file import PolicySpec, load_policy_file
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.specification import specification
from osel_sim.policy.environment_fit import check_environment
from osel_sim.policy.history import split
from osel_sim.policy.mapping import grip_orientation, hand_orientation, image_of, message_of
from osel_sim.remote.codec import pack, unpack
from osel_sim.remote.protocol import Greeting, ObservationError, example_observation
from osel_sim.remote.session import Session
from osel_sim.sim.env import TaskEnv

RENDERED = 256
ROBOT = specification()


def example(name: str) -> PolicySpec:
    return load_policy_file(content.root() / "examples" / "policies" / f"{name}.toml")


@pytest.fixture(scope="module")
def moments() -> Iterator[list[tuple[dict[str, Any], dict[str, Any]]]]:
    """Moments of a robosuite environment: its own observables, and the same as our environments tell it."""
    env = robosuite.make(
        "Lift", robots="Panda", has_renderer=False, camera_names=["agentview", "robot0_eye_in_hand"], camera_heights=RENDERED, camera_widths=RENDERED
    )
    random, found = np.random.default_rng(0), []
    raw, action = env.reset(), np.zeros(7)
    for step in range(20):
        if step % 4 == 0:
            action = random.uniform(-1, 1, 7) * [0.3, 0.3, 0.3, 1, 1, 1, 1]
            site, quaternion = env.sim.data.site_xmat[env.robots[0].eef_site_id["right"]], np.empty(4)
            mujoco.mju_mat2Quat(quaternion, site.reshape(-1))
            quaternion *= -1 if quaternion[1] < 0 else 1
            angle = 2 * np.arccos(quaternion[0])
            state = np.concatenate([raw["robot0_eef_pos"], quaternion[1:] * angle / np.sin(angle / 2), raw["robot0_gripper_qpos"]])
            images = {"agentview": raw["agentview_image"][::-1], "wrist": raw["robot0_eye_in_hand_image"][::-1]}
            ours = {f"observation.images.{camera}": np.ascontiguousarray(image) for camera, image in images.items()}
            found.append((raw, {**ours, "observation.state": state.astype(np.float32), "task": "lift the cube"}))
        raw = env.step(action)[0]
    env.close()
    yield found


def nearer(image: np.ndarray[Any, Any], upright: np.ndarray[Any, Any]) -> bool:
    """Whether an image is more like another one than like its mirror images."""
    far = [np.abs(image.astype(float) - other).mean() for other in (upright, upright[::-1], upright[:, ::-1], upright[::-1, ::-1])]
    return int(np.argmin(far)) == 0


def test_robosuites_images_are_ours_upside_down() -> None:
    env = TaskEnv("pick_place")
    env.reset(seed=0)
    ours = {camera: env.image(camera, 64, 64) for camera in ("agentview", "wrist")}
    env.close()  # of the contexts of one thread only one is current
    sim = MjSim(env.world.model)
    sim.data._data.qpos[:] = env.world.data.qpos
    sim.forward()
    MjRenderContextOffscreen(sim, device_id=-1).vopt.geomgroup[:2] = 0, 1  # what is to be seen, not what collides
    for camera, name in (("agentview", "agentview"), ("wrist", "robot0_eye_in_hand")):
        assert nearer(ours[camera], sim.render(64, 64, camera_name=name)[::-1])
    hand = env.world.data.body("robot0_right_hand").xquat
    said = hand_orientation(env.world.grip_rotation_vector())["quaternion"]
    assert said == pytest.approx(np.roll(hand, -1) * np.sign(hand[1]), abs=1e-6)


def test_pi0_gets_what_openpis_client_sends(moments: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    spec = example("pi0_libero")
    for raw, ours in moments:
        message = message_of(ours, spec.mapping, spec.cameras, ROBOT)
        assert set(message) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
        for key, name in (("observation/image", "agentview_image"), ("observation/wrist_image", "robot0_eye_in_hand_image")):
            wanted = image_tools.convert_to_uint8(image_tools.resize_with_pad(np.ascontiguousarray(raw[name][::-1, ::-1]), 224, 224))
            assert np.array_equal(message[key], wanted)
        angle = 2 * np.arccos(raw["robot0_eef_quat"][3])
        turned = raw["robot0_eef_quat"][:3] * angle / np.sin(angle / 2)
        wanted = np.concatenate([raw["robot0_eef_pos"], turned, raw["robot0_gripper_qpos"]])
        assert message["observation/state"] == pytest.approx(wanted, abs=1e-5)


def test_smolvla_gets_what_lerobots_processor_makes(moments: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    spec = example("smolvla_libero")
    for raw, ours in moments:
        theirs = LiberoProcessorStep().observation(
            {
                f"observation.images.{key}": torch.from_numpy(np.array(raw[name])).permute(2, 0, 1)[None]
                for key, name in (("image", "agentview_image"), ("image2", "robot0_eye_in_hand_image"))
            }
            | {
                "observation.robot_state": {
                    "eef": {"pos": torch.from_numpy(raw["robot0_eef_pos"])[None], "quat": torch.from_numpy(raw["robot0_eef_quat"])[None]},
                    "gripper": {"qpos": torch.from_numpy(raw["robot0_gripper_qpos"])[None]},
                }
            }
        )
        message = message_of(ours, spec.mapping, spec.cameras, ROBOT)
        for key in ("observation.images.image", "observation.images.image2"):
            assert np.array_equal(message[key], theirs[key][0].permute(1, 2, 0))
        assert message["observation.state"] == pytest.approx(theirs["observation.state"][0].numpy(), abs=1e-5)


def test_the_hands_orientation_comes_back() -> None:
    for rotation in Rotation.random(20, random_state=0):
        x, y, z, w = rotation.as_quat() * np.sign(rotation.as_quat()[0])
        grip = np.array([x, y, z]) * 2 * np.arccos(w) / np.sin(np.arccos(w))
        hand = hand_orientation(grip)
        assert hand["quaternion"] == pytest.approx((rotation * Rotation.from_euler("z", np.pi / 2)).as_quat(), abs=1e-9) or hand[
            "quaternion"
        ] == pytest.approx(-(rotation * Rotation.from_euler("z", np.pi / 2)).as_quat(), abs=1e-9)
        assert grip_orientation(hand["axis_angle"]) == pytest.approx(grip, abs=1e-6)
    assert hand_orientation(np.zeros(3))["axis_angle"] == pytest.approx([0, 0, np.pi / 2])


def test_images_are_turned_over_as_said() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    found = {flip: image_of({"observation.images.a": image}, "a", Conventions(flip={"a": flip})) for flip in ("horizontal", "vertical", "both")}
    assert np.array_equal(found["horizontal"], image[:, ::-1]) and np.array_equal(found["vertical"], image[::-1])
    assert np.array_equal(found["both"], image[::-1, ::-1]) and found["both"].flags.c_contiguous
    assert image_of({"observation.images.a": image}, "a", Conventions()) is image


def test_a_hand_that_the_environment_does_not_tell_is_refused() -> None:
    other = EnvironmentSpec("another", 10, ROBOT.action, {"joints": 7}, ROBOT.cameras, "agentview")
    spec = example("smolvla_libero")
    with pytest.raises(ContentError, match=r"mapping\.state_frame: the environment of another has no axis_angle"):
        check_environment(spec, other)
    check_environment(replace(spec, mapping=replace(spec.mapping, state="")), other)


class Seen:
    """A policy that remembers what it is shown."""

    def __init__(self) -> None:
        self.instructions: list[str] = []
        self.observations: list[dict[str, Any]] = []

    def reset(self, instruction: str) -> None:
        self.instructions.append(instruction)

    def act(self, observation: dict[str, Any]) -> np.ndarray[Any, Any]:
        self.observations.append(observation)
        return np.zeros((5, 7), np.float32)


@pytest.fixture
def session() -> tuple[Session, Seen]:
    spec, seen = replace(example("smolvla_libero"), image_size=224), Seen()
    return Session(seen, Greeting.of(spec, ROBOT)), seen


def test_a_libero_client_is_served(session: tuple[Session, Seen], moments: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    serving, seen = session
    pi0 = example("pi0_libero")
    for _, ours in moments:
        reply = unpack(serving.answer(msgpack_numpy.packb(message_of(ours, pi0.mapping, pi0.cameras, ROBOT))))
        assert reply["actions"].shape == (5, 7)
        given = seen.observations[-1]
        assert given["observation.state"] == pytest.approx(ours["observation.state"], abs=1e-5)
        for camera in ("agentview", "wrist"):
            assert np.array_equal(
                given[f"observation.images.{camera}"], image_tools.resize_with_pad(ours[f"observation.images.{camera}"][:, ::-1], 224, 224)[:, ::-1]
            )
    assert seen.instructions == ["lift the cube"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"observation/state": np.zeros(7)}, "observation/state must be 8 finite numbers"),
        ({"observation/state": np.full(8, np.nan)}, "observation/state must be 8 finite numbers"),
        ({"observation/state": "no"}, "observation/state must be 8 finite numbers"),
        (
            {"observation/image": np.zeros((224, 224), np.uint8)},
            r"observation/image must be uint8 of shape \(H, W, 3\), got uint8 of shape \(224, 224\)",
        ),
        ({"observation/image": np.zeros((224, 224, 3))}, "got float64"),
        ({"observation/picture": 1}, "expected the keys observation/image"),
        ({"prompt": 3}, "an instruction must be a string"),
    ],
)
def test_what_a_libero_client_got_wrong_is_named(session: tuple[Session, Seen], change: dict[str, Any], words: str) -> None:
    image = np.zeros((224, 224, 3), np.uint8)
    message = {"observation/image": image, "observation/wrist_image": image, "observation/state": np.zeros(8), "prompt": "lift"}
    with pytest.raises(ObservationError, match=words):
        session[0].answer(msgpack_numpy.packb(message | change))
    with pytest.raises(ObservationError, match="expected the keys"):
        session[0].answer(msgpack_numpy.packb({key: value for key, value in message.items() if key != "prompt"}))
    assert not session[1].observations


def test_a_policy_of_another_environment_does_not_take_libero(session: tuple[Session, Seen]) -> None:
    other = EnvironmentSpec("another", 10, ROBOT.action, {"joints": 7}, ROBOT.cameras, "agentview")
    with pytest.raises(ObservationError, match="drives in another environment"):
        Session(Seen(), Greeting.of(example("pi0_libero"), other)).answer(msgpack_numpy.packb({"observation/state": np.zeros(8)}))


def test_a_stack_of_observations_is_sent_and_checked_as_one() -> None:
    spec = replace(example("pi0_libero"), history=2)
    greeting = Greeting.of(spec, ROBOT)
    assert Greeting.parse(greeting.to_dict()) == greeting and "history" not in Greeting.of(example("pi0_libero"), ROBOT).to_dict()
    observation = example_observation(greeting)
    message = message_of(observation, spec.mapping, spec.cameras, ROBOT)
    assert (message["observation/image"].shape, message["observation/state"].shape) == ((2, 224, 224, 3), (2, 8))
    seen = Seen()
    assert unpack(Session(seen, greeting).answer(pack(observation)))["actions"].shape == (5, 7)
    with pytest.raises(ObservationError, match=r"must be uint8 of shape \(2, 256, 256, 3\)"):
        Session(seen, greeting).answer(pack(split(observation)[0]))
