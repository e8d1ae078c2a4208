from pathlib import Path

import pytest

from osel_sim.core.errors import ContentError
from osel_sim.formats.policy_file import Price, Remote, load_policy_file

GOOD = """
version = 1
name = "mine"
title = "A policy"
location = "remote"
kind = "lerobot"
checkpoint = "assets/policies/mine"
execute = 8
inference_seconds = 0.1

[observation]
cameras = ["agentview", "wrist"]
image_size = 96

[remote]
network = "lte"
mode = "async"
deadline = 1.5
fallback = "local_small"

[price]
per_action = 0.02
per_call = 1
"""


def write(folder: Path, text: str) -> Path:
    file = folder / "mine.toml"
    file.write_text(text)
    return file


def test_a_whole_file_is_read(tmp_path: Path) -> None:
    spec = load_policy_file(write(tmp_path, GOOD))
    assert spec.remote == Remote("lte", "async", 1.5, "local_small", None)
    assert spec.price == Price(0.02, 1.0, 0.0)
    assert spec.price.of(actions=100, calls=3, megabytes=7.0) == pytest.approx(5.0)
    assert (spec.cameras, spec.image_size, spec.execute, spec.is_remote) == (("agentview", "wrist"), 96, 8, True)
    assert spec.skills is None
    assert load_policy_file(write(tmp_path, GOOD.replace("execute = 8", 'execute = 8\nskills = ["lift", "tag:long"]'))).skills == ("lift", "tag:long")


def test_a_local_policy_needs_no_remote_and_no_price(tmp_path: Path) -> None:
    text = GOOD.replace('"remote"', '"local"')
    spec = load_policy_file(write(tmp_path, text[: text.index("[remote]")]))
    assert spec.remote is None
    assert spec.price == Price()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version = 1", "version = 2", "version: must lie in [1, 1], got 2"),
        ('name = "mine"', 'name = "other"', "name: must equal the file's name 'mine', got 'other'"),
        ('title = "A policy"\n', "", "title: is missing, expected a string"),
        ('title = "A policy"', "title = 3", "title: must be a string, got 3"),
        ('location = "remote"', 'location = "remot"', "location: unknown value 'remot', did you mean 'remote'? known: local, remote"),
        ('location = "remote"', 'location = "local"', 'remote: only a policy with location = "remote" has this table'),
        ("execute = 8", "execute = 0", "execute: must lie in [1, 1000], got 0"),
        ("execute = 8", "execute = 8.5", "execute: must be an integer, got 8.5"),
        ("execute = 8", "execute = true", "execute: must be an integer, got True"),
        ("execute = 8", "exekute = 8", "exekute: is not a known key, did you mean 'execute'?"),
        ("inference_seconds = 0.1", "inference_seconds = -1", "inference_seconds: must lie in [0.0, 3600.0], got -1.0"),
        ("inference_seconds = 0.1", "inference_seconds = nan", "inference_seconds: must lie in [0.0, 3600.0], got nan"),
        ('["agentview", "wrist"]', '"agentview"', "observation.cameras: must be a list, got 'agentview'"),
        ('["agentview", "wrist"]', "[]", "observation.cameras: must name one or more different cameras, got []"),
        (
            '["agentview", "wrist"]',
            '["wrist", "wrist"]',
            "observation.cameras: must name one or more different cameras, got ['wrist', 'wrist']",
        ),
        ("image_size = 96", "image_size = 8", "observation.image_size: must lie in [16, 1024], got 8"),
        ("image_size = 96", "image_size = 96\nimagesize = 9", "observation.imagesize: is not a known key, did you mean 'image_size'?"),
        ('network = "lte"', 'network = "lt"', "remote.network: unknown value 'lt', did you mean 'lte'?"),
        ('mode = "async"', 'mode = "sync"', "remote.mode: unknown value 'sync', did you mean 'async'?"),
        ("deadline = 1.5", "deadline = 0", "remote.deadline: must lie in [0.001, 3600.0], got 0.0"),
        ("deadline = 1.5", 'url = "http://robot"', "remote.url: must start with ws:// or wss://, got 'http://robot'"),
        ("per_action = 0.02", "per_action = -0.02", "price.per_action: must lie in [0.0, 1000000.0], got -0.02"),
        ("per_action = 0.02", "per_action = inf", "price.per_action: must lie in [0.0, 1000000.0], got inf"),
        ("per_action", "per_akction", "price.per_akction: is not a known key, did you mean 'per_action'?"),
        ("[price]", "[prices]", "prices: is not a known key, did you mean 'price'?"),
        ("[observation]", "[observation", "TOML: "),
        ("execute = 8", "execute = 8\nexecute = 9", "TOML: "),
        ("execute = 8", "execute = 8\nskills = []", "skills: must name at least one task"),
        ("execute = 8", 'execute = 8\nskills = "lift"', "skills: must be a list, got 'lift'"),
    ],
)
def test_a_broken_file_is_refused_with_file_key_and_what_would_be_right(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in GOOD
    file = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ContentError) as raised:
        load_policy_file(file)
    assert str(raised.value).startswith(f"{file}: {message}")


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ContentError, match="TOML"):
        load_policy_file(file)
