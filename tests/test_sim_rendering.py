"""What makes a fast image quick may not show in it, nor in the physics."""

import mujoco
import numpy as np
import pytest

from osel_sim.sim import cameras
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance
from osel_sim.sim.light_meshes import ROBOT
from osel_sim.sim.robots import BUILT_IN
from osel_sim.sim.scene import full_model


@pytest.fixture(scope="module")
def env():
    env = TaskEnv("pick_place")
    yield env
    env.close()


def moments(env):
    """Four moments in the expert's run on each of three instances, whose cameras and things differ from those at level 0 more and more."""
    for seed, level in enumerate((0, 1, 3)):
        env.load(make_instance(env.task, seed, level))
        expert = Expert(env.world)
        for step in range(46):
            if step % 15 == 0:
                yield
            env.advance(expert.act())


@pytest.mark.parametrize(("camera", "width", "height"), [("agentview", 96, 96), ("agentview", 160, 60), ("wrist", 96, 96), ("wrist", 40, 120)])
def test_leaving_out_what_a_camera_cannot_see_changes_no_pixel(env, monkeypatch, camera, width, height):
    def picture():
        return env.image(camera, width, height)

    def everything(model, data, camera, aspect):
        return np.ones(model.ngeom, dtype=bool)

    for _ in moments(env):
        image = picture()
        with monkeypatch.context() as patch:
            patch.setattr(cameras, "in_view", everything)
            np.testing.assert_array_equal(image, picture())


def test_what_a_camera_cannot_see_is_left_out(env):
    env.load(make_instance(env.task, 0))
    model, data = env.world.model, env.world.data
    seen = {name: cameras.in_view(model, data, model.camera(full).id, 1.0) for name, full in env.world.scene.cameras.items()}
    table, shoulder = (model.geom(name).id for name in ("table_visual", "robot0_g12_vis"))
    assert seen["agentview"][table] and seen["wrist"][table]
    assert not seen["wrist"][shoulder]
    parked = [entity.name for entity in env.task.entities if entity.name not in env.entity_positions()]
    assert parked
    for name in parked:
        geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body(env.world.scene.root_bodies[name]).id)
        assert len(geoms) and not seen["agentview"][geoms].any()


def test_looking_leaves_the_model_as_it_was(env):
    env.load(make_instance(env.task, 0))
    groups = env.world.model.geom_group.copy()
    env.image("wrist", 32, 32)
    np.testing.assert_array_equal(env.world.model.geom_group, groups)


@pytest.fixture(scope="module", params=sorted(BUILT_IN))
def any_env(request):
    env = TaskEnv("pick_place", robot=request.param)
    yield env
    env.close()


def test_light_meshes_are_light(any_env):
    model, robot = any_env.world.model, any_env.world.robot
    shown = [
        geom
        for geom in range(model.ngeom)
        if model.geom(geom).name.startswith(ROBOT) and model.geom_group[geom] == 1 and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    ]
    assert len(shown) > 15
    faces = model.mesh_facenum[model.geom_dataid[shown]]
    assert max(faces) <= robot.meshes.most and sum(faces) < 15_000


def area(model, mesh):
    """Of all its faces."""
    first, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]][model.mesh_face[faces : faces + model.mesh_facenum[mesh]]]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2)


def test_a_light_arm_has_all_its_parts(any_env):
    """No mesh has all but vanished, as those made of loose pieces do when corners are joined too far apart."""
    light, full = any_env.world.model, full_model(any_env.world.scene.xml)
    for geom in range(light.ngeom):
        name = light.geom(geom).name
        if name.startswith(("robot0_", "gripper0_")) and light.geom_group[geom] == 1 and light.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            assert area(light, light.geom_dataid[geom]) > 0.5 * area(full, full.geom_dataid[full.geom(name).id]), name


def test_light_meshes_change_no_bit_of_the_physics(any_env):
    """The same torques on the light and on robosuite's own model, from the start of an instance."""
    env = any_env
    env.load(make_instance(env.task, 5))
    light, full = env.world.model, mujoco.MjModel.__copy__(full_model(env.world.scene.xml))
    full.body_pos[:], full.body_quat[:] = light.body_pos, light.body_quat
    full.geom_contype[:], full.geom_conaffinity[:] = light.geom_contype, light.geom_conaffinity
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(light, spec))
    mujoco.mj_getState(light, env.world.data, state, spec)
    ends = []
    for model in (light, full):
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        mujoco.mj_setState(model, data, state, spec)
        for _ in range(500):
            data.ctrl[:] = rng.uniform(-5, 5, model.nu)
            mujoco.mj_step(model, data)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_array_equal(*ends)
