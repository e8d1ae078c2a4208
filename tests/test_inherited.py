"""What a process inherits: proxies, folders that cannot be written, a user without a name, a terminal that knows few letters."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from remote_helpers import ENVIRONMENT

from osel_sim.context.encoder import load_encoder
from osel_sim.core import caches, proxies
from osel_sim.core.errors import CheckpointError, RemoteError, UsageError
from osel_sim.remote.client import RemoteClient

PROXIES = [f"{name}_proxy" for name in ("ws", "wss", "socks", "https", "http", "all", "no")]
LAN = "ws://192.0.2.7:9001"  # nobody's


@pytest.fixture
def environment(monkeypatch):
    """Set variables after all that matter here were removed."""
    for name in [*PROXIES, *map(str.upper, PROXIES), "SSL_CERT_FILE", "SSL_CERT_DIR"]:
        monkeypatch.delenv(name, raising=False)
    return monkeypatch.setenv


@pytest.mark.parametrize(
    ("name", "value", "proxy"),
    [
        ("https_proxy", "socks5://127.0.0.1:1080", "the proxy socks5://127.0.0.1:1080 (https_proxy)"),
        ("HTTP_PROXY", "127.0.0.1:3128", "the proxy http://127.0.0.1:3128 (HTTP_PROXY)"),
        ("ws_proxy", "http://me:secret@proxy:8080", "the proxy http://***@proxy:8080 (ws_proxy)"),
        ("ALL_PROXY", "socks5://127.0.0.1:1080", "None"),
    ],
)
def test_which_proxy_a_server_is_behind(environment, name, value, proxy):
    environment(name, value)
    assert str(proxies.proxy_for(LAN)) == proxy
    assert proxies.proxy_for("ws://[::1:9") is None  # no address: who connects says so
    assert proxies.proxy_for("ws://127.0.0.1:8000") is None and proxies.proxy_for("ws://[::1]:8000") is None
    for excepted in ("192.0.2.7", "localhost, 192.0.2.0/24", "*", "[::1],192.0.2.7:9001"):
        environment("NO_PROXY", excepted)
        assert proxies.proxy_for(LAN) is None, excepted
    environment("NO_PROXY", "localhost,[::1],fd00::/8")
    assert str(proxies.proxy_for(LAN)) == proxy


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (
            "http://127.0.0.1:9",
            r"cannot connect by way of the proxy http://127.0.0.1:9 \(https_proxy\) \(Connection refused\); .*NO_PROXY=192.0.2.7$",
        ),
        ("127.0.0.1:9", r"cannot connect by way of the proxy http://127.0.0.1:9"),
        ("socks5://127.0.0.1:9", r"the proxy socks5://127.0.0.1:9 \(https_proxy\), which needs the package python-socks.* NO_PROXY=192.0.2.7$"),
        ("ftp://127.0.0.1:9", r"cannot connect by way of the proxy ftp://127.0.0.1:9"),
    ],
)
def test_an_error_names_the_proxy_and_how_to_except_a_server(environment, value, says):
    environment("https_proxy", value)
    with pytest.raises(RemoteError, match=says):
        RemoteClient(LAN, ENVIRONMENT, timeout=2).connect()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ALL_PROXY", "socks5://127.0.0.1:1080"),
        ("all_proxy", "socks://127.0.0.1:7890"),
        ("NO_PROXY", "localhost,[::1]"),
        ("no_proxy", "localhost,fd00::/8"),
        ("SSL_CERT_FILE", "/nonexistent/cacert.pem"),
    ],
)
def test_what_is_local_needs_no_network_and_what_is_not_names_the_variable(environment, monkeypatch, name, value):
    import httpx
    from huggingface_hub import constants

    environment(name, value)
    with monkeypatch.context() as context:
        context.setattr(httpx.Client, "__init__", None)  # whoever makes one fails
        assert load_encoder("osel_small").dimension > 0
    monkeypatch.delenv("HF_HUB_OFFLINE")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(CheckpointError) as error:
        load_encoder("hf-hub:nobody/nothing")
    assert "the hub cannot be reached (" in str(error.value) and f"the environment sets {name}={value}" in str(error.value)
    assert constants.HF_HUB_OFFLINE is False


CACHES = """
import os, getpass
from osel_sim.core.caches import prepare
print(prepare())
print(os.environ.get('NUMBA_CACHE_DIR'), os.environ.get('HF_HOME'))
"""
NAMELESS = "import pwd\ndef nobody(uid): raise KeyError(f'getpwuid(): uid not found: {uid}')\npwd.getpwuid = nobody\n"


def run(code: str, **variables: str | None) -> subprocess.CompletedProcess[str]:
    without = ("HOME", "USER", "LOGNAME", "LNAME", "USERNAME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "HF_HOME", "TMPDIR")
    kept = {name: value for name, value in os.environ.items() if name not in without}
    given = {name: value for name, value in variables.items() if value is not None}
    return subprocess.run([sys.executable, "-c", code], env=kept | given, capture_output=True, text=True, timeout=60)


def test_caches_stay_where_they_are_where_that_can_be_written(tmp_path):
    assert run(CACHES, HOME=str(tmp_path)).stdout == f"{tmp_path}/.cache\nNone None\n"
    assert run(CACHES, HOME="/proc", XDG_CACHE_HOME=str(tmp_path)).stdout == f"{tmp_path}\nNone None\n"


@pytest.mark.parametrize("home", ["/proc/nobody", None])
def test_caches_go_to_the_temporary_files_where_there_is_no_home(tmp_path, home):
    done = run(NAMELESS + CACHES + "print(getpass.getuser())", HOME=home, TMPDIR=str(tmp_path))
    base = tmp_path / f"osel_sim-{os.getuid()}"
    assert done.stdout == f"{base}\n{base}/numba None\nuid{os.getuid()}\n", done.stderr
    assert base.stat().st_mode & 0o777 == 0o700
    base.chmod(0o777)  # anybody may have put code there
    assert run(CACHES, HOME="/proc/nobody", TMPDIR=str(tmp_path)).stdout.splitlines()[0] != str(base)


def test_what_was_downloaded_is_read_where_it_is(tmp_path, monkeypatch):
    (tmp_path / "huggingface").mkdir()
    monkeypatch.setattr(caches, "_usable", lambda folder: folder != tmp_path)  # root may write anywhere
    for name in ("NUMBA_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR", "MPLCONFIGDIR", "HF_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    base = caches.prepare.__wrapped__()
    assert (os.environ["HF_HOME"], os.environ["XDG_CACHE_HOME"], "TORCH_HOME" in os.environ) == (str(tmp_path / "huggingface"), str(base), False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with pytest.raises(UsageError, match=r"NUMBA_CACHE_DIR=\S+ cannot be written"):
        caches.prepare.__wrapped__()


def test_without_any_temporary_folder_one_line_says_so():
    code = "import tempfile; tempfile._candidate_tempdir_list = lambda: ['/proc/nobody']\nfrom osel_sim.run import main\n"
    done = run(code + "raise SystemExit(main(['--list']))", HOME="/proc/nobody")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: no folder for temporary files can be written (") and done.stderr.endswith(": name one in TMPDIR\n")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_letters_that_a_terminal_lacks_are_written_as_escapes(tmp_path, encoding):
    policy = (Path(__file__).parents[1] / "policies" / "local_small.toml").read_text(encoding="utf-8")
    lines = [
        'name = "uni"' if line.startswith("name") else 'title = "策略 – klein"' if line.startswith("title") else line for line in policy.splitlines()
    ]
    (tmp_path / "uni.toml").write_text("\n".join(lines), encoding="utf-8")
    code = f"from osel_sim.run import main; raise SystemExit(main(['--list', '--policies-dir', {str(tmp_path)!r}]))"
    done = run(code, HOME=str(tmp_path), PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert r"\u7b56\u7565 \u2013 klein" in done.stdout
