"""Datasets of strangers: what is wrong with one is found before any work, by measuring and training alike, and named with file, frame and column."""

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from synthetic_demonstrations import SIZE, STEPS, write

from osel_sim.core.errors import ContentError, DataError
from osel_sim.formats import library
from osel_sim.formats.dataset_mapping import DatasetMapping, load_dataset_mapping
from osel_sim.ingestion.action_mse import Measurement, open_datasets
from osel_sim.ingestion.lerobot_check import open_dataset
from osel_sim.ingestion.lerobot_numbers import actions, check_mapping, states
from osel_sim.policy.mapping import hand_orientation
from osel_sim.training.dataset import load_demonstrations

FRAMES = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
IMAGE = "observation.images.agentview"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("data") / "world", 2, annotated=False)


@pytest.fixture
def dataset(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "world"))


def change(file: Path, column: str, edit: Any) -> None:
    """Replace a column's values by what `edit` makes of them."""
    table = parquet.read_table(file)
    index = table.schema.get_field_index(column)
    values = pa.array(edit(table[column].to_pylist()), table.schema.field(column).type)
    parquet.write_table(table.set_column(index, table.schema.field(column), values), file)


def info(dataset: Path, **changes: Any) -> None:
    file = dataset / "meta/info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def put(frame: int, value: Any) -> Any:
    return lambda values: [*values[:frame], value, *values[frame + 1 :]]


def png(image: Image.Image) -> dict[str, Any]:
    content = io.BytesIO()
    image.save(content, "PNG")
    return {"bytes": content.getvalue(), "path": None}


def both(dataset: Path) -> None:
    """Measure, and train on it: as far as reading goes."""
    assert open_datasets([dataset], [library.load_policy("local_small")], Measurement(frames=STEPS))
    assert len(load_demonstrations(dataset, ("agentview",), progress=False).state) == 2 * STEPS


def test_what_is_read_is_what_the_library_reads(written: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    theirs, ours = LeRobotDataset("local/world", root=written), open_dataset(written)
    assert (ours.frames, ours.starts.tolist()) == (2 * STEPS, [0, STEPS, 2 * STEPS])
    for frame in (0, STEPS, 2 * STEPS - 1):
        item = theirs[frame]
        assert ours.tasks[ours.task[frame]] == item["task"]
        assert np.array_equal(states(ours, DatasetMapping())[frame], item["observation.state"].numpy())
        assert np.array_equal(actions(ours, DatasetMapping())[frame], item["action"].numpy())
        assert np.array_equal(ours.image(IMAGE, frame), (item[IMAGE].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda d: change(d / FRAMES, "observation.state", put(5, [float("nan"), *[0.0] * 7])), r"frame 5, column 'observation\.state': .* got nan"),
        (lambda d: change(d / FRAMES, "observation.state", put(3, [1e30] * 8)), r"frame 3, column 'observation\.state': .* got 1e\+30"),
        (lambda d: change(d / FRAMES, "action", put(20, [0.0] * 6 + [float("-inf")])), "frame 20, column 'action': .* got -inf"),
        (lambda d: change(d / FRAMES, "action", put(2, [0.0] * 6 + [None])), "frame 2, column 'action': .* got nan"),
        (lambda d: change(d / FRAMES, "task_index", put(4, 99)), r"frame 4, column 'task_index': task 99 is not in .*meta/tasks\.parquet"),
        (lambda d: change(d / FRAMES, "task_index", put(4, None)), "frame 4, column 'task_index': is empty"),
        (lambda d: change(d / FRAMES, "episode_index", put(15, 0)), "frame 15, column 'episode_index': episodes are not in order"),
        (lambda d: change(d / FRAMES, IMAGE, put(7, {"bytes": b"\x89PNG nothing", "path": None})), f"frame 7, column '{IMAGE}': the image cannot be"),
        (lambda d: change(d / FRAMES, IMAGE, put(7, None)), f"frame 7, column '{IMAGE}': holds neither"),
        (lambda d: change(d / FRAMES, IMAGE, put(7, {"bytes": None, "path": "../../x.png"})), f"frame 7, column '{IMAGE}': holds neither"),
        (lambda d: change(d / FRAMES, IMAGE, put(0, png(Image.new("I;16", (SIZE, SIZE))))), "more than 8 bits a channel"),
        (lambda d: change(d / EPISODES, "dataset_to_index", put(0, 11)), "file-000.parquet: says that episode 0 is frames 0 to 11"),
        (lambda d: change(d / "meta/tasks.parquet", "task", lambda values: [" "] * len(values)), r"tasks\.parquet: task 0 is empty"),
        (lambda d: (d / "meta/tasks.parquet").unlink(), r"tasks\.parquet: is missing"),
        (lambda d: (d / "meta/tasks.parquet").write_bytes(b"PAR1"), r"tasks\.parquet: is not a whole Parquet file"),
        (lambda d: shutil.rmtree(d / "meta/episodes"), "meta/episodes: has no"),
        (lambda d: shutil.rmtree(d / "data"), "has no data"),
        (lambda d: (d / FRAMES).write_bytes((d / FRAMES).read_bytes()[:200]), "is not a whole Parquet file"),
        (lambda d: parquet.write_table(parquet.read_table(d / FRAMES).drop_columns(["action"]), d / FRAMES), "there is no column 'action'"),
        (lambda d: info(d, codebase_version="v2.1"), r"format v2\.1.* --repo-id=local/world --root=/.*/world --push-to-hub=false$"),
        (lambda d: info(d, codebase_version="v4.0"), r"format v4\.0, newer than v3"),
        (lambda d: info(d, codebase_version=None), "codebase_version must be such as"),
        (lambda d: info(d, features=["action"]), "features must be an object"),
    ],
)
def test_damage_is_named_before_any_work(dataset: Path, damage: Any, says: str) -> None:
    damage(dataset)
    for read in (
        lambda: open_datasets([dataset], [library.load_policy("local_small")], Measurement(frames=STEPS)),
        lambda: load_demonstrations(dataset, ("agentview",), progress=False),
    ):
        with pytest.raises(DataError, match=says) as caught:
            read()
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


def test_what_others_have_besides_does_not_matter(dataset: Path) -> None:
    file = dataset / FRAMES
    table = parquet.read_table(file)
    late = pa.array([2**52] * len(table), pa.timestamp("s"))  # beyond what Python's dates reach
    parquet.write_table(table.append_column("when", late).append_column("action.note", pa.array(["x"] * len(table))), file)
    info(dataset, total_frames=10**6, fps=0)
    (dataset / "meta/stats.json").unlink()
    content = (dataset / "meta/info.json").read_bytes()
    (dataset / "meta/info.json").write_bytes(b"\xef\xbb\xbf" + content)
    both(dataset)


@pytest.mark.parametrize("mode", ["L", "RGBA", "LA", "P", "1"])
def test_images_of_other_modes_are_taken_alike(dataset: Path, mode: str) -> None:
    image = Image.new("RGB", (SIZE, SIZE), (255, 255, 255)).convert(mode)
    change(dataset / FRAMES, IMAGE, lambda values: [png(image)] * len(values))
    assert np.array_equal(open_dataset(dataset).image(IMAGE, 3), np.full((SIZE, SIZE, 3), 255, np.uint8))
    both(dataset)


def test_images_may_lie_beside_the_tables(dataset: Path) -> None:
    Image.new("RGB", (SIZE, SIZE), (1, 2, 3)).save(dataset / "one.png")
    change(dataset / FRAMES, IMAGE, lambda values: [{"bytes": None, "path": "one.png"}] * len(values))
    assert open_dataset(dataset).image(IMAGE, 20)[5, 5].tolist() == [1, 2, 3]


def test_images_of_several_sizes_cannot_be_trained_on(dataset: Path) -> None:
    change(dataset / FRAMES, IMAGE, put(9, png(Image.new("RGB", (20, 10)))))
    open_datasets([dataset], [library.load_policy("local_small")], Measurement())
    with pytest.raises(DataError, match=f"frame 9, column '{IMAGE}': the image has 20 x 10 pixels, the first one {SIZE} x {SIZE}"):
        load_demonstrations(dataset, ("agentview",), progress=False)
    assert not list(dataset.glob(".cache/*/*.npy"))


def test_a_datasets_own_conventions(dataset: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, plain = dataset / FRAMES, open_dataset(dataset)
    ours = actions(plain, DatasetMapping())
    change(file, "action", lambda rows: [[(row[6] + 1) / 2, *(np.array(row[:6]) / 20).tolist()] for row in rows])
    table = parquet.read_table(file)
    parquet.write_table(table.rename_columns(["observation.images.top" if name == IMAGE else name for name in table.column_names]), file)
    features = json.loads((dataset / "meta/info.json").read_text())["features"]
    info(dataset, features={"observation.images.top" if name == IMAGE else name: feature for name, feature in features.items()})
    mapping = dataset.parent / "theirs.toml"
    mapping.write_text(
        'version = 1\nimages = { agentview = "observation.images.top" }\ncolumns = [1, 2, 3, 4, 5, 6, 0]\n'
        'scale = [20, 20, 20, 20, 20, 20]\ngripper = "closed_one"\n'
    )
    data = load_demonstrations(dataset, ("agentview",), progress=False, mapping=load_dataset_mapping(mapping))
    assert np.allclose(data.action, ours, atol=1e-6) and not caplog.records
    samples = open_datasets([dataset], [library.load_policy("local_small")], Measurement(mapping=load_dataset_mapping(mapping)))
    assert np.allclose(samples[0].dataset.actions, ours, atol=1e-6)
    with pytest.raises(ContentError, match="scale: must have 6 numbers"):
        check_mapping(DatasetMapping(scale=(1.0,)), mapping, ("agentview",))
    with pytest.raises(ContentError, match=r"images\.front: no policy has that camera"):
        check_mapping(DatasetMapping(images={"front": "x"}), mapping, ("agentview",))


def test_mirrored_images_and_the_hands_orientation_become_ours(dataset: Path) -> None:
    ours = states(open_dataset(dataset), DatasetMapping())
    grips = Rotation.random(len(ours), random_state=0).as_rotvec()
    hands = [hand_orientation(grip)["axis_angle"] for grip in grips]
    change(dataset / FRAMES, "observation.state", lambda rows: [[*row[:3], *hand, *row[6:]] for row, hand in zip(rows, hands, strict=True)])
    picture = np.arange(SIZE * SIZE * 3, dtype=np.uint32).reshape(SIZE, SIZE, 3).astype(np.uint8)
    change(dataset / FRAMES, IMAGE, lambda values: [png(Image.fromarray(picture[:, ::-1]))] * len(values))
    mapping = DatasetMapping(flip={"agentview": "horizontal"}, state_frame="hand")
    data = load_demonstrations(dataset, ("agentview",), progress=False, mapping=mapping)
    for found, grip in zip(data.state, grips, strict=True):
        assert (Rotation.from_rotvec(found[3:6]) * Rotation.from_rotvec(grip).inv()).magnitude() == pytest.approx(0, abs=1e-5)
    assert np.array_equal(data.state[:, [0, 1, 2, 6, 7]], ours[:, [0, 1, 2, 6, 7]])
    samples = open_datasets([dataset], [library.load_policy("local_small")], Measurement(mapping=mapping))
    assert np.array_equal(data.images["agentview"][0], picture) and np.array_equal(samples[0].dataset.images(3)[0], picture)


def test_actions_in_other_units_are_warned_of(dataset: Path, caplog: pytest.LogCaptureFixture) -> None:
    change(dataset / FRAMES, "action", lambda rows: [[*row[:6], 0.0] for row in rows[:13]] + [[*row[:5], -30.0, 1.0] for row in rows[13:]])
    actions(open_dataset(dataset), DatasetMapping())
    beyond, gripper = (record.getMessage() for record in caplog.records)
    assert "frame 13, column 'action': yaw is -30, and 46% of the frames have actions beyond [-1, 1]" in beyond and "--map" in beyond
    assert "gripper's number" in gripper and "closed_one" in gripper


def test_videos_are_measured_and_a_missing_one_is_named(tmp_path: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    features = {
        IMAGE: {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (8,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    data = LeRobotDataset.create("local/films", 20, features, root=tmp_path / "films", use_videos=True)
    for level in (40, 200):
        for _ in range(4):
            image = np.full((96, 96, 3), level, np.uint8)
            data.add_frame({IMAGE: image, "observation.state": np.zeros(8, np.float32), "action": np.zeros(7, np.float32), "task": "wait"})
        data.save_episode()
    data.finalize()
    found = open_dataset(tmp_path / "films")
    assert [abs(int(found.image(IMAGE, frame).mean()) - level) < 8 for frame, level in ((1, 40), (4, 200), (7, 200))] == [True] * 3
    with pytest.raises(DataError, match="are videos; training reads images"):
        load_demonstrations(tmp_path / "films", ("agentview",), progress=False)
    shutil.rmtree(tmp_path / "films/videos")
    with pytest.raises(DataError, match=r"file-000\.mp4: is missing, and episode 0 has its images"):
        open_datasets([tmp_path / "films"], [library.load_policy("local_small")], Measurement())
