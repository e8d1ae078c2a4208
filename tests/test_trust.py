"""Checkpoints are data: whatever their files name, no code runs but that of installed packages and what the user allows."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.utils.import_utils import register_third_party_plugins

from osel_sim.__main__ import main
from osel_sim.api.settings import TrustSettings
from osel_sim.cli.command import Command
from osel_sim.core import content
from osel_sim.core.errors import CheckpointError, UsageError
from osel_sim.core.trust import VARIABLE, ForeignCodeError, trust, trusted, trusting
from osel_sim.formats import library
from osel_sim.interface.specification import specification
from osel_sim.policy import register
from osel_sim.policy.lerobot_policy import load
from osel_sim.policy.trust import check_checkpoint
from osel_sim.training.initial import Initial

ROBOT = specification()

SHIPPED = content.root() / "assets" / "policies" / "local_small"
BEFORE, AFTER = "policy_preprocessor.json", "policy_postprocessor.json"


@pytest.fixture(autouse=True)
def nothing_is_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    register()
    register_third_party_plugins()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(SHIPPED, tmp_path / "checkpoint")
    return tmp_path / "checkpoint"


def popen(marker: Path) -> dict[str, Any]:
    return {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}}


def insert(folder: Path, step: Any, file: str = BEFORE) -> Path:
    data = json.loads((folder / file).read_text())
    data["steps"].insert(0, step)
    (folder / file).write_text(json.dumps(data))
    return folder


def spec_of(checkpoint: Path | str) -> Any:
    return dataclasses.replace(library.load_policy("local_small"), checkpoint=str(checkpoint))


@pytest.mark.parametrize("file", [BEFORE, AFTER])
def test_a_class_of_another_module_is_never_called(folder: Path, tmp_path: Path, file: str) -> None:
    marker = tmp_path / "ran"
    insert(folder, popen(marker), file)
    for build in (lambda: load(spec_of(folder), ROBOT), lambda: Initial(folder)):
        with pytest.raises(ForeignCodeError, match=rf"{file}: step 0 names 'subprocess\.Popen'.*--trust subprocess"):
            build()
    assert not marker.exists()


def test_no_command_runs_it(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    marker = tmp_path / "ran"
    insert(folder, popen(marker))
    text = library.load_policy("local_small").file.read_text()
    (tmp_path / "mine.toml").write_text(text.replace('"local_small"', '"mine"').replace('"assets/policies/local_small"', f'"{folder}"'))
    from osel_sim import doctor, serve
    from osel_sim.run import main as run_main

    own = ["--policies-dir", str(tmp_path)]
    assert (
        run_main([*own, "--task", "lift", "--policies", "mine", "--selector", "fixed:mine", "--episodes", "1", "--out", str(tmp_path / "out")]) == 2
    )
    assert doctor.main([*own, "--policy", "mine", "--task", "lift"]) == 2
    assert serve.main([*own, "mine", "--port", "0"]) == 2
    assert capsys.readouterr().err.count("names 'subprocess.Popen'") == 3
    assert not marker.exists()


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ({"class": "os.system"}, "--trust os"),
        ({"class": "lerobot.processor.pipeline.importlib.import_module"}, "cannot be imported"),
        ({"class": "lerobot.processor.pipeline.Path"}, "is no ProcessorStep"),
        ({"class": "lerobot.robots.utils.Popen"}, "cannot be imported"),
        ({"class": "lerobot.processor.pipeline.re"}, "is no ProcessorStep"),
        ({"class": "osel_sim.remote.process.subprocess.Popen"}, "cannot be imported"),
        ({"class": "osel_sim.remote.policy_process.PolicyServerProcess"}, "is no ProcessorStep"),
        ({"class": "lerobot.processor.pipeline.ProcessorStep.__subclasses__"}, "--trust"),
        ({"class": "lerobotx.processor.Step"}, "--trust lerobotx.processor"),
        ({"class": "osel_sim_extra.Step"}, "--trust osel_sim_extra"),
        ({"class": "Popen"}, "is no class"),
        ({"class": ""}, "is no class"),
        ({"class": ".subprocess.Popen"}, "is no class"),
        ({"class": "lerobot..Popen"}, "is no class"),
        ({"class": "lerobot.processor\n.Step"}, "is no class"),
        ({"class": ["subprocess.Popen"]}, "is no class"),
        ({"class": None}, "is no class"),
        ({"registry_name": "subprocess.Popen"}, "has no registered name"),
        ({"registry_name": ["device_processor"]}, "has no registered name"),
        ({"registry_name": None}, "has no registered name"),
        ({"registry_name": "device_procesor"}, "did you mean 'device_processor'"),
        ({"registry_name": "device_processor", "class": "subprocess.Popen"}, "either"),
        ({"config": {}}, "either"),
        ("subprocess.Popen", "either"),
        ({"registry_name": "device_processor", "config": ["cpu"]}, "config"),
        ({"registry_name": "device_processor", "config": None}, "config"),
        ({"registry_name": "normalizer_processor", "state_file": "../../other.safetensors"}, "state file"),
        ({"registry_name": "normalizer_processor", "state_file": "/etc/state.safetensors"}, "state file"),
        ({"registry_name": "normalizer_processor", "state_file": "state.pkl"}, "state file"),
        ({"registry_name": "normalizer_processor", "state_file": 3}, "state file"),
    ],
)
def test_whatever_a_step_names_is_looked_at_first(folder: Path, step: Any, words: str) -> None:
    insert(folder, step)
    with pytest.raises(CheckpointError) as error:
        check_checkpoint(folder)
    assert f"{folder / BEFORE}: step 0 " in str(error.value) and words in str(error.value)
    with pytest.raises(CheckpointError, match="step 0"):
        load(spec_of(folder), ROBOT)


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[]", '{"steps": {}}', "\x00", '{"steps": 1e999999}'])
@pytest.mark.parametrize("file", ["config.json", BEFORE, AFTER])
def test_damaged_json_is_refused_with_its_name(folder: Path, file: str, text: str) -> None:
    (folder / file).write_text(text)
    with pytest.raises(CheckpointError, match=f"{folder / file}: "):
        check_checkpoint(folder)


@pytest.mark.parametrize("kind", ["subprocess.Popen", "languagechunk", None, 3, ["act"], {"type": "act"}])
def test_a_policy_is_of_a_registered_type(folder: Path, kind: Any) -> None:
    data = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**data, "type": kind}))
    with pytest.raises(CheckpointError, match="is no registered type of policy"):
        check_checkpoint(folder)


def test_a_configuration_takes_no_key_that_no_field_has(folder: Path) -> None:
    data = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**data, "auto_map": {"AutoConfig": "evil.Config"}}))
    (folder / "evil.py").write_text("raise SystemExit('ran')")
    with pytest.raises(CheckpointError, match="auto_map"):
        load(spec_of(folder), ROBOT)


def test_weights_are_safetensors_and_nothing_else(folder: Path, tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {tmp_path / 'ran'}",)

    import torch

    torch.save({"weights": Bomb()}, folder / "model.safetensors")
    with pytest.raises(CheckpointError, match="SafetensorError"):
        load(spec_of(folder), ROBOT)
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(CheckpointError):
        load(spec_of(folder), ROBOT)
    assert not (tmp_path / "ran").exists()


STEP = """
from pathlib import Path
from lerobot.processor import IdentityProcessorStep
from subprocess import Popen

class Step(IdentityProcessorStep):
    def __init__(self, marker):
        Path(marker).touch()
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module that brings a step of its own."""
    (tmp_path / "somebodys_steps.py").write_text(STEP)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "somebodys_steps", raising=False)
    return "somebodys_steps"


def test_an_allowed_module_is_imported_and_its_steps_are_built(folder: Path, tmp_path: Path, module: str) -> None:
    insert(folder, {"class": f"{module}.Step", "config": {"marker": str(tmp_path / "ran")}})
    with pytest.raises(ForeignCodeError, match=f"--trust {module}"):
        load(spec_of(folder), ROBOT)
    assert module not in sys.modules
    trust([module])
    load(spec_of(folder), ROBOT)
    assert (tmp_path / "ran").exists()


def test_an_allowed_module_is_still_no_way_to_what_it_imports(folder: Path, tmp_path: Path, module: str) -> None:
    trust([module])
    insert(folder, {**popen(tmp_path / "ran"), "class": f"{module}.Popen"})
    with pytest.raises(ForeignCodeError, match="is no ProcessorStep"):
        load(spec_of(folder), ROBOT)
    trust(["subprocess"])  # even then it is none
    with pytest.raises(ForeignCodeError, match="is no ProcessorStep"):
        load(spec_of(folder), ROBOT)
    assert not (tmp_path / "ran").exists()


def test_an_allowed_module_never_comes_from_the_checkpoint(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trust(["somebodys_steps"])
    (folder / "somebodys_steps.py").write_text(STEP)
    insert(folder, {"class": "somebodys_steps.Step", "config": {"marker": str(folder / "ran")}})
    monkeypatch.syspath_prepend(str(folder))  # as when a command is started within it
    monkeypatch.delitem(sys.modules, "somebodys_steps", raising=False)
    with pytest.raises(ForeignCodeError, match="from the folder that is being loaded"):
        load(spec_of(folder), ROBOT)
    assert "somebodys_steps" not in sys.modules


def test_the_flag_allows_for_one_command_and_its_child_processes() -> None:
    def execute(config: TrustSettings) -> int:
        with trusting(config.trust):
            assert trusted() == ("package.steps", "owner/name")
            child = subprocess.run([sys.executable, "-c", f"import os; print(os.environ['{VARIABLE}'])"], capture_output=True, text=True)
            assert child.stdout.strip() == "package.steps,owner/name"
        return 0

    assert Command("demo", TrustSettings, execute, "")(["--trust", "package.steps", "--trust", "owner/name"]) == 0
    assert trusted() == ()


@pytest.mark.parametrize("name", ["", "a b", "a,b", "../x", "/", "x;y", "a..b", "-m"])
def test_only_names_can_be_allowed(name: str) -> None:
    with pytest.raises(UsageError, match="neither a module"):
        trust([name])


@pytest.mark.parametrize("command", ["run", "record", "serve", "doctor", "ingest", "train"])
def test_every_command_that_loads_policies_has_the_flag(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert "--trust STR" in capsys.readouterr().out


def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, files: Path) -> Path:
    """A hub's cache with one model in it; the hub itself is out of reach."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    model = tmp_path / "hub" / f"models--{name.replace('/', '--')}"
    shutil.copytree(files, model / "snapshots" / ("0" * 40))
    (model / "refs").mkdir()
    (model / "refs" / "main").write_text("0" * 40)
    return model / "snapshots" / ("0" * 40)


def test_a_model_of_the_hub_is_fetched_checked_and_loaded_from_where_it_was_checked(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = hub(tmp_path, monkeypatch, "somebody/policy", folder)
    load(spec_of("somebody/policy"), ROBOT)
    insert(snapshot, popen(tmp_path / "ran"))
    with pytest.raises(ForeignCodeError) as error:
        load(spec_of("somebody/policy"), ROBOT)
    assert str(snapshot / BEFORE) in str(error.value) and not (tmp_path / "ran").exists()


def test_code_beside_a_tokenizer_is_not_run_although_lerobot_allows_it(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    repository = tmp_path / "tokenizer"
    repository.mkdir()
    (repository / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass Evil: pass\n")
    (repository / "processor_config.json").write_text(json.dumps({"processor_class": "Evil", "auto_map": {"AutoProcessor": "evil.Evil"}}))
    (repository / "config.json").write_text(json.dumps({"model_type": "evil", "auto_map": {"AutoConfig": "evil.Evil"}}))
    insert(folder, {"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": str(repository)}})
    with pytest.raises(CheckpointError, match=rf"wants its own code 'evil\.py'.*--trust {repository}"):
        load(spec_of(folder), ROBOT)
    assert not (tmp_path / "ran").exists()
    trust([str(repository)])
    with pytest.raises(CheckpointError, match="Evil"):  # it is no processor
        load(spec_of(folder), ROBOT)
    assert (tmp_path / "ran").exists()
