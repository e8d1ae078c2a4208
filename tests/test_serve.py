"""The command, as a real process."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from remote_helpers import ENVIRONMENT, TOKEN, install_plugin, observation, policy_spec

from osel_sim.core.errors import RemoteError
from osel_sim.remote.client import RemoteClient
from osel_sim.serve import main

COMMAND = [sys.executable, "-m", "osel_sim.serve"]


@pytest.fixture
def folder(tmp_path):
    install_plugin(tmp_path)
    policy_spec(tmp_path)
    policy_spec(tmp_path, name="stuck", kind="stuck")
    return tmp_path


def environment(folder, **changes):
    base = {key: value for key, value in os.environ.items() if key != "OSEL_SIM_TOKEN"}
    return {**base, "PYTHONPATH": str(folder), **changes}


def run(folder, *arguments, **changes):
    return subprocess.run([*COMMAND, *arguments], env=environment(folder, **changes), capture_output=True, text=True, timeout=60)


class Serving:
    def __init__(self, folder, *arguments, **changes):
        self.process = subprocess.Popen(
            [*COMMAND, *arguments, "--port", "0", "--policies-dir", str(folder)],
            env=environment(folder, **changes),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.ready = json.loads(self.process.stdout.readline())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 0)])
def test_serves_our_client_and_openpis_and_stops_when_told(folder, number, code):
    with Serving(folder, "sinusoid", OSEL_SIM_TOKEN=TOKEN) as server:
        assert server.ready == {"policy": "sinusoid", "url": f"ws://127.0.0.1:{server.ready['port']}", "port": server.ready["port"]}
        url = server.ready["url"]
        assert urllib.request.urlopen(url.replace("ws:", "http:") + "/healthz", timeout=5).status == 200
        assert WebsocketClientPolicy("127.0.0.1", server.ready["port"], TOKEN).infer(observation())["actions"].shape == (8, 7)
        with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5) as client:
            client.reset("x")
            assert client.act(observation("x")).actions.shape == (8, 7)
            server.process.send_signal(number)
            assert server.process.wait(10) == code
        assert re.fullmatch(r"loading sinusoid; clients .* with the token in OSEL_SIM_TOKEN \.\.\.\n", server.process.stderr.read())


def test_what_a_plugin_prints_does_not_come_before_the_line(folder):
    policy_spec(folder, name="loud", kind="loud")
    with Serving(folder, "loud", OSEL_SIM_TOKEN=TOKEN) as server:
        assert server.ready["policy"] == "loud"


def test_makes_a_token_of_its_own_on_loopback(folder):
    with Serving(folder, "sinusoid") as server, RemoteClient(server.ready["url"], ENVIRONMENT, server.ready["token"], timeout=5) as client:
        client.reset("x")
        with pytest.raises(RemoteError):
            RemoteClient(server.ready["url"], ENVIRONMENT, "another token", timeout=5).connect()


def test_stops_when_standard_input_ends(folder):
    with Serving(folder, "sinusoid", "--watch-stdin") as server:
        server.process.stdin.close()
        assert server.process.wait(10) == 0
        server.process.stdin = None


def test_stops_in_time_even_when_the_policy_never_answers(folder):
    with Serving(folder, "stuck", OSEL_SIM_TOKEN=TOKEN) as server:
        client = RemoteClient(server.ready["url"], ENVIRONMENT, TOKEN, timeout=0.5)
        client.connect()
        with pytest.raises(Exception, match="no answer"):
            client.act(observation("wait"))
        start = time.monotonic()
        server.process.terminate()
        assert server.process.wait(20) == 1
        assert time.monotonic() - start < 12


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["sinusiod"], r"unknown policy 'sinusiod': did you mean 'sinusoid'\?"),
        (["sinusoid", "--host", "0.0.0.0"], "put a token into the environment variable OSEL_SIM_TOKEN"),
        (["sinusoid", "--host", "0.0.0.0", "--token-env", "MY_TOKEN"], "put a token into the environment variable MY_TOKEN"),
        (["sinusoid", "--port", "70000"], r"--port: must lie in \[0, 65535\], got 70000"),
        (["sinusoid", "--host", "no-such-host.invalid", "--token-env", "GOOD_TOKEN"], "cannot listen on no-such-host.invalid"),
        (["sinusoid", "--token-env", "SHORT_TOKEN"], "a token must be 8 to 256 printable ASCII characters"),
        (["wrong"], r"wrong\.toml: execute: must lie in"),
    ],
)
def test_wrong_input_gets_one_line_and_exit_code_2(folder, arguments, complaint, monkeypatch, capsys):
    """In this process; `test_a_used_port` is of a process of its own."""
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delenv("OSEL_SIM_TOKEN", raising=False)
    for name, token in (("SHORT_TOKEN", "abc"), ("GOOD_TOKEN", TOKEN)):
        monkeypatch.setenv(name, token)
    (folder / "wrong.toml").write_text(
        (folder / "sinusoid.toml").read_text().replace("execute = 4", "execute = 0").replace('"sinusoid"', '"wrong"', 1)
    )
    code, shown = main([*arguments, "--policies-dir", str(folder)]), capsys.readouterr()
    assert code == 2, shown.err
    assert shown.err.startswith("error: ") and shown.err.count("\n") == 1, shown.err
    assert re.search(complaint, shown.err)
    assert shown.out == ""


def test_a_used_port(folder):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        result = run(folder, "sinusoid", "--policies-dir", str(folder), "--port", str(listener.getsockname()[1]))
    assert result.returncode == 2 and result.stderr.startswith("error: cannot listen on 127.0.0.1:")  # before anything is loaded


def test_help_comes_fast_and_imports_nothing_heavy(folder):
    start = time.monotonic()
    result = run(folder, "--help")
    assert result.returncode == 0 and "examples:" in result.stdout
    assert time.monotonic() - start < 3.0
    code = "import sys, osel_sim.serve; print([name for name in ('torch', 'mujoco', 'robosuite', 'websockets', 'lerobot') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60).stdout.strip() == "[]"


def test_the_example_of_a_server_of_ones_own():
    environment = {key: value for key, value in os.environ.items() if key != "OSEL_SIM_TOKEN"}
    example = Path(__file__).parent.parent / "examples" / "serve_your_own.py"
    result = subprocess.run([sys.executable, example], capture_output=True, text=True, timeout=60, env=environment)
    assert result.returncode == 0, result.stderr
    assert "new episode: pick up the can" in result.stdout and "actions (8, 7)" in result.stdout
