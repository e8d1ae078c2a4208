import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(code: str | Path, *arguments: str, **changes: str | None) -> subprocess.CompletedProcess[str]:
    ours = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID", "OSEL_SIM_GL_CHECKED")
    environment = {key: value for key, value in os.environ.items() if key not in ours}
    environment.update({key: value for key, value in changes.items() if value is not None})
    command = [str(code)] if isinstance(code, Path) else ["-c", code]
    return subprocess.run([sys.executable, *command, *arguments], env=environment, capture_output=True, text=True, timeout=120)


CHOOSE = "import os; from osel_sim.sim import gl; print(gl.find_backend(), os.environ['MUJOCO_GL'], os.environ['PYOPENGL_PLATFORM'])"
NO_EGL = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent"}


def no_osmesa(folder: Path) -> dict[str, str]:
    for version in ("", *(f".{number}" for number in range(10))):
        (folder / f"libOSMesa.so{version}").touch()  # found first, and no library
    return {"LD_LIBRARY_PATH": str(folder)}


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_what_the_environment_asks_for_is_used(backend: str) -> None:
    done = run(CHOOSE, MUJOCO_GL=backend)
    assert done.stdout.strip() == f"Backend(name='{backend}', how='MUJOCO_GL') {backend} {backend}", done.stderr


def test_osmesa_is_found_where_egl_does_not_work() -> None:
    done = run(CHOOSE, **NO_EGL)
    assert done.stdout.strip() == "Backend(name='osmesa', how='probed') osmesa osmesa", done.stderr
    assert "images are drawn by osmesa instead (MUJOCO_GL=osmesa asks for it)" in done.stderr  # never in silence


def test_without_any_backend_the_packages_are_named(tmp_path: Path) -> None:
    done = run(CHOOSE, **NO_EGL, **no_osmesa(tmp_path))
    assert "DisplayError: no headless OpenGL works" in done.stderr
    assert "apt-get install libegl1 libgl1-mesa-dri or apt-get install libosmesa6" in done.stderr


@pytest.mark.parametrize(
    ("value", "message"), [("eggl", "'eggl' is not a rendering backend, known: egl, osmesa, glfw"), ("egl", "MUJOCO_GL=egl does not work")]
)
def test_a_broken_wish_is_refused(value: str, message: str) -> None:
    done = run(CHOOSE, MUJOCO_GL=value, **NO_EGL)
    assert done.returncode != 0
    assert message in done.stderr


@pytest.mark.parametrize(
    ("variables", "says"),
    [
        ({"PYOPENGL_PLATFORM": "osmesa"}, "Backend(name='osmesa', how='PYOPENGL_PLATFORM')"),
        ({"PYOPENGL_PLATFORM": "egl", **NO_EGL}, "PYOPENGL_PLATFORM=egl does not work"),
        ({"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"}, "MUJOCO_GL=egl and PYOPENGL_PLATFORM=osmesa contradict each other"),
        ({"MUJOCO_EGL_DEVICE_ID": "0"}, "Backend(name='egl', how='MUJOCO_EGL_DEVICE_ID')"),
        ({"MUJOCO_EGL_DEVICE_ID": "77"}, "MUJOCO_EGL_DEVICE_ID=77: that device cannot be had (RuntimeError"),
        ({"MUJOCO_EGL_DEVICE_ID": "cuda:0", "MUJOCO_GL": "egl"}, "MUJOCO_EGL_DEVICE_ID=cuda:0: that device cannot be had (ValueError"),
        ({"MUJOCO_EGL_DEVICE_ID": "77", "MUJOCO_GL": "osmesa"}, "Backend(name='osmesa', how='MUJOCO_GL')"),
    ],
)
def test_a_wish_is_met_or_its_variable_named(variables: dict[str, str], says: str) -> None:
    done = run(CHOOSE, **variables)
    assert says in done.stdout + done.stderr


def test_robosuite_takes_an_egl_device_that_cuda_numbers_otherwise() -> None:
    done = run(
        "from osel_sim.sim import gl; gl.quiet_robosuite(); import os; print(os.environ['MUJOCO_EGL_DEVICE_ID'])",
        MUJOCO_EGL_DEVICE_ID="0",
        CUDA_VISIBLE_DEVICES="3",
    )
    assert done.stdout.strip() == "0", done.stderr


FORK = """
import mujoco  # before a backend is chosen
import os
import warnings
import numpy as np
from osel_sim.core.errors import DisplayError
from osel_sim.sim.env import TaskEnv
env = TaskEnv("lift", cameras=("agentview",), image_size=32)
before = env.reset(seed=1)[0]["image_agentview"].copy()
print("drawn", before.std() > 10, flush=True)
warnings.simplefilter("ignore")  # of forking where there are threads
child = os.fork()
try:
    same = np.array_equal(before, env.reset(seed=1)[0]["image_agentview"])
    os.write(1, f"{'child' if child == 0 else 'parent'} {same}\\n".encode())  # in one piece, whatever the other writes meanwhile
except DisplayError as error:
    print(str(error).partition(": start")[0], flush=True)
if child == 0:
    os._exit(0)
os.waitpid(child, 0)
"""


@pytest.mark.parametrize(("backend", "says"), [("egl", "child True"), ("osmesa", "this process was forked from one that had drawn images (osmesa)")])
def test_a_process_may_fork_after_it_drew(backend: str, says: str) -> None:
    done = run(FORK, MUJOCO_GL=backend, OSEL_SIM_GL_CHECKED=f"{backend} MUJOCO_GL")
    assert "drawn True" in done.stdout and done.stderr == "", done.stdout + done.stderr
    assert says in done.stdout and "parent True" in done.stdout, done.stdout + done.stderr


VECTOR = """
import sys
import gymnasium
import mujoco
import osel_sim.envs
if __name__ == "__main__":
    who, start = sys.argv[1:]
    if who != "ours":  # another program's image, whose context is closed again, or kept
        model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
        renderer = mujoco.Renderer(model, 16, 16)
        renderer.render()
        if who != "kept":
            renderer.close()
    else:
        ours = gymnasium.make("osel_sim/lift-v0", render_mode="rgb_array")
        ours.reset(seed=1)
        ours.render()
    envs = gymnasium.make_vec(
        "osel_sim/lift-v0", 2, "async", vector_kwargs=None if start == "fork" else {"context": start}, cameras=("agentview",), image_size=32
    )
    try:
        print("drawn", envs.reset(seed=1)[0]["image_agentview"].shape)
    except Exception as error:
        print(type(error).__name__, error)
    envs.close(terminate=True)
"""


@pytest.mark.parametrize(
    ("who", "start", "backend", "says"),
    [
        ("closed", "fork", "egl", "drawn (2, 32, 32, 3)"),
        ("kept", "fork", "egl", "DisplayError this process was forked from one that had drawn images (egl)"),
        # Those of which `test_a_process_may_fork_after_it_drew` says the same without gymnasium.
        pytest.param("ours", "fork", "egl", "drawn (2, 32, 32, 3)", marks=pytest.mark.slow),
        pytest.param("kept", "fork", "osmesa", "from one that had drawn images (osmesa)", marks=pytest.mark.slow),
        pytest.param("kept", "spawn", "egl", "drawn (2, 32, 32, 3)", marks=pytest.mark.slow),
        pytest.param("ours", "spawn", "osmesa", "drawn (2, 32, 32, 3)", marks=pytest.mark.slow),
    ],
)
def test_gymnasiums_vector_of_processes_draws_or_says_why_not(who: str, start: str, backend: str, says: str, tmp_path: Path) -> None:
    script = tmp_path / "vector.py"
    script.write_text(VECTOR)
    done = run(script, who, start, MUJOCO_GL=backend, OSEL_SIM_GL_CHECKED=f"{backend} MUJOCO_GL")
    assert says in done.stdout, done.stdout + done.stderr


def test_a_child_process_does_not_probe_again() -> None:
    done = run("from osel_sim.sim import gl; gl.PROBE_SECONDS = 0.0; print(gl.find_backend())", MUJOCO_GL="egl", OSEL_SIM_GL_CHECKED="egl probed")
    assert done.stdout.strip() == "Backend(name='egl', how='probed')", done.stderr


def test_a_context_comes_from_the_chosen_backend_even_if_mujoco_was_imported_before() -> None:
    code = "import mujoco; from osel_sim.sim import gl; c = gl.context(8, 8); c.make_current(); print(type(c).__module__); c.free()"
    assert run(code, MUJOCO_GL=None, **NO_EGL).stdout.strip() == "mujoco.osmesa"


def test_robosuite_is_imported_quietly(tmp_path: Path) -> None:
    # An empty byte-code cache brings out the SyntaxWarnings of a first import. What robosuite imports of others need not be compiled for that.
    others = "import mujoco, numba, scipy.spatial.transform, cv2, PIL.Image, termcolor, sys"
    code = f"{others}; sys.pycache_prefix = {str(tmp_path)!r}; from osel_sim.sim import gl; print(gl.quiet_robosuite().__version__)"
    done = run(code, MUJOCO_GL="egl", OSEL_SIM_GL_CHECKED="egl probed")
    assert (done.stdout.strip(), done.stderr) == ("1.5.1", "")
