"""What others wrote is shown without control characters, and nothing shows a secret."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

from osel_sim import doctor
from osel_sim.cli.command import reported
from osel_sim.cli.console import console
from osel_sim.core import shown as module
from osel_sim.core.errors import ContentError, OselError, RemoteError, UnknownNameError, UsageError
from osel_sim.core.shown import all_shown, printable, shown
from osel_sim.formats.journal import to_line
from osel_sim.formats.policy_file import load_policy_file
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.interface.specification import specification
from osel_sim.remote.client import RemoteClient
from osel_sim.reporting.page import Page, Section, Verdict, to_html
from osel_sim.run import main as run_main

HOSTILE = "a\x1b[2J\x1b]0;title\x07b\x9b31mc\x08\x7fd\rfake\u202eEVIL\u2066\u2028\x00\U000e0041"
RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\u2028\u2029\U000e0000-\U000e007f]")
ORDINARY = ["", "put the can in the bowl", "a\tb\nc", "naïve 東京 שלום مرحبا \u200f👩‍🔧", "model [v2] [/bold]", "50% ? # @ a:b ://", "C:\\x1b"]
SECRET = "SECRET123"
ADDRESSES = [
    f"ws://127.0.0.1:9/infer?api_key={SECRET}",
    f"ws://user:{SECRET}@127.0.0.1:9",
    f"ws://{SECRET}@127.0.0.1:9/a",
    f"ws://user:a/{SECRET}@127.0.0.1:9",
    f"ws://user:a@{SECRET}@127.0.0.1:9/x?y#z",
    f"ws://127.0.0.1:9/#access_token={SECRET}",
    f"wss://127.0.0.1:9/x?a=1&b={SECRET}&c=%20;.)",
]


@pytest.mark.parametrize("text", ORDINARY)
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert shown(text) == text


def test_control_characters_become_visible() -> None:
    text = printable(HOSTILE)
    assert not RAW.search(text) and text.startswith(r"a\x1b[2J\x1b]0;title\x07b\x9b31mc\x08\x7fd\rfake\u202eEVIL\u2066\u2028\x00\U000e0041")
    assert printable(text) == text
    printable("caf\udce9").encode()  # a file name that is not UTF-8
    assert printable("a\ufffe\uffffb") == r"a\ufffe\uffffb"  # what draws an SVG with one ends the process


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("form", ["{}", "{}: cannot connect", "got '{}'", '("{}")', "see <{}>, or {}."])
def test_no_secret_of_an_address_is_shown(address: str, form: str) -> None:
    text = shown(form.replace("{}", address))
    assert SECRET not in text and "127.0.0.1:9" in text and "***" in text
    assert shown(text) == text
    assert text == form.replace("{}", shown(address))  # so that a message can be told from the address before it


@pytest.mark.parametrize("address", ["ws://h:8000/models/@v2", "wss://[::1]:80/a@b", "https://example.org/a/b.", "ws://host:port"])
def test_an_address_without_secrets_stays_as_it_is(address: str) -> None:
    assert shown(address) == address


def test_the_token_is_shown_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(module.TOKEN_VARIABLE, SECRET)
    assert str(RemoteError(f"reported an error: bad key {SECRET}!")) == "reported an error: bad key ***!"
    monkeypatch.setenv(module.TOKEN_VARIABLE, "a")  # too short to be told from other words
    assert str(RemoteError("a bad key")) == "a bad key"


@pytest.mark.parametrize("error", [OselError(HOSTILE), UnknownNameError("policy", HOSTILE, [HOSTILE + "x"]), ContentError("f", HOSTILE, HOSTILE)])
def test_every_error_of_ours_is_safe_to_print(error: OselError) -> None:
    assert not RAW.search(str(error)) and "\\x1b" in str(error)


@pytest.mark.parametrize("token", [f"{SECRET}\n", f"{SECRET}\r", f"\x1b[31m{SECRET}", f"{SECRET} ", f"{SECRET}é", f"{SECRET}\x00", f" {SECRET}"])
def test_a_token_that_cannot_be_sent_is_described_and_not_told(token: str) -> None:
    with pytest.raises(UsageError) as error:
        RemoteClient("ws://127.0.0.1:9", specification(), token)
    assert re.search(rf"OSEL_SIM_TOKEN cannot be sent: character \d+ of {len(token)} is", str(error.value))
    assert SECRET not in str(error.value) and not RAW.search(str(error.value))


@pytest.mark.parametrize("address", [*ADDRESSES, f"ws://user:{SECRET}@", f"ws://user:{SECRET}@[x", f"ws://h:{SECRET}@x:y/"])
def test_no_error_of_a_connection_tells_its_secrets(address: str) -> None:
    with pytest.raises(RemoteError) as error:
        RemoteClient(address, specification(), timeout=2.0).connect()
    assert SECRET not in str(error.value)


POLICY = """
version = 1
name = "mine"
title = "Mine"
location = "remote"
kind = "openpi"
execute = 8
inference_seconds = 0.1
[observation]
cameras = ["agentview"]
image_size = 64
[remote]
url = "{}"
network = "none"
"""


@pytest.mark.parametrize("address", ADDRESSES)
def test_no_command_tells_the_secrets_of_an_address(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.toml").write_text(POLICY.replace("{}", address))
    own = ["--policies-dir", str(tmp_path)]
    assert run_main(["--list", *own]) == 0 and run_main(["--list", "--json", *own]) == 0
    doctor.main(own)
    output = capsys.readouterr()
    assert "127.0.0.1:9" in output.out and SECRET not in output.out + output.err


@pytest.mark.parametrize("address", [f"http://user:{SECRET}@h", f"user:{SECRET}@h", f"ws://user:{SECRET} x@h", f"ws://user:'{SECRET}'@h", "ws://"])
def test_a_wrong_address_is_refused_without_its_secrets(address: str, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(POLICY.replace("{}", address))
    with pytest.raises(ContentError, match=r"remote\.url") as error:
        load_policy_file(tmp_path / "mine.toml")
    assert SECRET not in str(error.value)


@pytest.mark.parametrize(
    ("line", "key"), [('title = "Mi\\u001bne"', "title"), ('"na\\u202eme" = 1', r"na\u202eme"), ('skills = ["a", "\\u009b"]', "skills")]
)
def test_a_file_with_control_characters_in_its_texts_is_refused(line: str, key: str, tmp_path: Path) -> None:
    text = POLICY.replace("{}", "ws://h").replace('title = "Mine"\n', "" if "title" in line else 'title = "Mine"\n')
    (tmp_path / "mine.toml").write_text(line + "\n" + text)
    with pytest.raises(ContentError, match="control character") as error:
        load_policy_file(tmp_path / "mine.toml")
    assert f": {key}: " in str(error.value) and not RAW.search(str(error.value))


def test_a_file_name_with_control_characters_is_named_safely(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mi\x1b[2Jne.toml").write_text(POLICY)
    assert run_main(["--list", "--policies-dir", str(tmp_path)]) == 2
    doctor.main(["--policies-dir", str(tmp_path)])
    assert run_main(["--task", "\x1b[2J"]) == 2
    assert run_main(["--\x1b[2J"]) == 2
    output = capsys.readouterr()
    assert "\x1b" not in output.out + output.err and "\\x1b" in output.out and "\\x1b" in output.err


def test_what_the_system_says_is_safe_to_print(capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        raise FileNotFoundError(2, "No such file", "a\x1b[2Jb")

    assert reported(command) == 2
    assert capsys.readouterr().err == "error: a\\x1b[2Jb: No such file\n"


def test_tables_on_the_terminal_show_names_safely(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("policy", HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE, f"ws://u:{SECRET}@h")
    console().print(table, HOSTILE)
    output = capsys.readouterr().out
    assert not RAW.search(output) and SECRET not in output and "\\x1b" in output


def outcome(**told: Any) -> Outcome:
    return Outcome(False, 0.0, 0, Seconds(), 0, 0, 0.0, **told)


def test_what_servers_say_is_kept_safely() -> None:
    kept = outcome(fallback=HOSTILE, error=f"ws://u:{SECRET}@h: {HOSTILE}")
    assert not RAW.search(str(kept.fallback)) and not RAW.search(str(kept.error)) and SECRET not in str(kept.error)
    assert outcome(error="no answer within 2 s\n\tat all").error == "no answer within 2 s\n\tat all" and outcome().error is None


@pytest.mark.parametrize("text", [HOSTILE, *ORDINARY])
def test_a_line_of_a_journal_holds_no_raw_control_characters_and_the_same_text(text: str) -> None:
    line = to_line({"instruction": text, text: [1.5]})
    assert not RAW.search(line[:-1]) and json.loads(line) == {"instruction": text, text: [1.5]}
    if text in ORDINARY:
        assert line == json.dumps({"instruction": text, text: [1.5]}, ensure_ascii=False, separators=(", ", ": ")) + "\n"


def test_the_page_shows_names_safely() -> None:
    words = f"{HOSTILE} <script>alert(1)</script> ws://u:{SECRET}@h"
    page = Page(words, words, Verdict(words, [words]), [Section("a", words, [words])], [(words, words)])
    html = to_html(page)
    own = to_html(Page("k", "t", Verdict("h", ["s"]), [Section("a", "b", ["c"])], [("d", "e")]))
    assert set(RAW.findall(html)) <= set(RAW.findall(own))  # Vega has some of its own
    assert SECRET not in html and "<script>alert" not in html and "\\x1b" in html


def test_plain_data_is_shown_whole() -> None:
    assert all_shown({"a\x1b": ["b\x9b", 1, None, ("ws://u:p@h", 2.5)]}) == {"a\\x1b": ["b\\x9b", 1, None, ["ws://***@h", 2.5]]}


def test_a_server_logs_what_clients_send_safely() -> None:
    code = "from osel_sim.remote.serving import ShownFormatter as F; import logging; h = logging.StreamHandler(); h.setFormatter(F('%(message)s'));"
    code += "log = logging.getLogger('x'); log.addHandler(h); log.warning('refused: %s', 'a\\x1b[2J\\x9b')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "refused: a\\x1b[2J\\x9b\n"
