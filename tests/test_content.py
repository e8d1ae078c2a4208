import json
import subprocess
import sys
from pathlib import Path

import pytest

from osel_sim.core import content
from osel_sim.core.errors import ContentError, UnknownNameError, UsageError
from osel_sim.formats import library
from osel_sim.formats.policy_file import load_policy_file


def copy_of(name: str, folder: Path, new_name: str, **changes: str) -> Path:
    text = (content.root() / "policies" / f"{name}.toml").read_text().replace(f'name = "{name}"', f'name = "{new_name}"')
    for old, new in changes.items():
        text = text.replace(old, new)
    file = folder / f"{new_name}.toml"
    file.write_text(text)
    return file


def test_shipped_content_is_found() -> None:
    assert "pick_place" in content.files("tasks")
    assert {"local_small", "remote_large"} <= set(content.files("policies"))
    assert content.find("tasks", "pick_place").is_file()


@pytest.mark.parametrize("name", sorted(content.files("policies")))
def test_every_shipped_policy_loads_and_its_fallback_is_a_local_one(name: str) -> None:
    spec = library.load_policy(name)
    assert spec.name == name
    if spec.remote is not None and spec.remote.fallback is not None:
        assert not library.load_policy(spec.remote.fallback).is_remote


def test_a_users_folder_adds_and_wins(tmp_path: Path) -> None:
    copy_of("local_small", tmp_path, "mine")
    mine = copy_of("remote_large", tmp_path, "remote_large", wifi="lte")
    found = content.files("policies", tmp_path)
    assert {"mine", "local_small"} <= set(found)
    assert found["remote_large"] == mine
    remote = library.load_policy("remote_large", tmp_path).remote
    assert remote is not None and remote.network == "lte"


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("tasks", "pik_place", "unknown task 'pik_place': did you mean 'pick_place'?"),
        ("policies", "local_smal", "unknown policy 'local_smal': did you mean 'local_small'?"),
        ("policies", "gpt", "known: local_small"),
    ],
)
def test_unknown_names_get_a_suggestion(kind: str, name: str, message: str) -> None:
    with pytest.raises(UnknownNameError) as raised:
        content.find(kind, name)
    assert message in str(raised.value)
    assert "osel_sim.run --list" in str(raised.value)


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not a folder of policies"):
        content.files("policies", tmp_path / "nothing")


def test_a_checkpoint_is_a_folder_of_the_content_or_a_hub_name(tmp_path: Path) -> None:
    assert content.resolve_checkpoint("assets/objects") == content.root() / "assets" / "objects"
    assert content.resolve_checkpoint(str(tmp_path)) == tmp_path
    assert content.resolve_checkpoint("lerobot/smolvla_base") == "lerobot/smolvla_base"


def test_a_list_shows_a_users_own_policies_and_refuses_broken_ones(tmp_path: Path) -> None:
    copy_of("local_small", tmp_path, "mine")
    command = [sys.executable, "-m", "osel_sim.run", "--list", "--json", "--policies-dir", str(tmp_path)]
    listed = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    assert "mine" in [policy["name"] for policy in listed["policies"]]
    file = copy_of("local_small", tmp_path, "broken", execute="exekute")
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2
    assert refused.stderr == f"error: {file}: exekute: is not a known key, did you mean 'execute'?\n"


def test_errors_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(ContentError, match=r"nothing\.toml: file: cannot be read \(No such file or directory\)"):
        load_policy_file(tmp_path / "nothing.toml")
