"""Perturbed scenes in the simulator: reproducible to the bit, gone without a trace, seen by every camera."""

import itertools

import numpy as np
import pytest

from osel_sim import gallery
from osel_sim.reporting import contact_sheet
from osel_sim.sim.appearance import FIELDS
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance

CAMERAS = ("agentview", "wrist")


@pytest.fixture(scope="module")
def env():
    env = TaskEnv("pick_place")
    yield env
    env.close()


def trace(env, instance, steps=6, full=False):
    """Images and states of a short run."""
    env.load(instance)
    rng = np.random.default_rng(1)
    parts = [env.image(camera, 64, 64).tobytes() for camera in CAMERAS]
    if full:
        parts.append(env.image("agentview", 64, 64, "full").tobytes())
    for _ in range(steps):
        env.advance(rng.uniform(-1, 1, 7))
    return b"".join([*parts, env.world.data.qpos.tobytes(), env.world.data.qvel.tobytes()])


def model_bytes(env):
    return {field: getattr(env.world.model, field).tobytes() for field in FIELDS}


def test_a_perturbed_load_leaves_no_trace(env):
    """Clean, perturbed, clean: images of both qualities, states and the model come back to the last bit."""
    fresh = TaskEnv("pick_place")
    before = model_bytes(fresh)
    clean, hard = make_instance(env.task, 4), make_instance(env.task, 4, 3)
    first = trace(fresh, clean, full=True)
    perturbed = trace(fresh, hard, full=True)
    assert perturbed != first and model_bytes(fresh) != before
    assert trace(fresh, clean, full=True) == first
    assert model_bytes(fresh) == before
    assert trace(fresh, hard, full=True) == perturbed
    fresh.close()
    # Neither does what another environment of the same scene shows.
    assert trace(env, clean, full=True) == first


def test_one_perturbation_after_another_equals_it_alone(env):
    for axes in ({"sizes": 3}, {"camera": 2, "light": 1}, {"texture": 3, "colours": 3}):
        trace(env, make_instance(env.task, 2, 3))
        after = trace(env, make_instance(env.task, 9, axes=axes), full=True)
        trace(env, make_instance(env.task, 9))
        assert trace(env, make_instance(env.task, 9, axes=axes), full=True) == after


def test_a_snapshot_goes_on_to_the_same_bits_in_another_environment(env):
    env.load(make_instance(env.task, 6, 3))
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (16, 7))
    for action in actions[:8]:
        env.advance(action)
    snapshot = env.snapshot()
    for action in actions[8:]:
        env.advance(action)
    expected, image = env.world.data.qpos.copy(), env.image("agentview", 64, 64)
    twin = TaskEnv("pick_place")
    twin.load(make_instance(env.task, 1, 2))
    for there in (env, twin):
        there.restore(snapshot)
        for action in actions[8:]:
            there.advance(action)
        np.testing.assert_array_equal(there.world.data.qpos, expected)
        np.testing.assert_array_equal(there.image("agentview", 64, 64), image)
    twin.close()


@pytest.mark.parametrize("axis", ["light", "camera", "texture", "distractors", "colours", "sizes", "start", "robot"])
def test_every_axis_can_be_seen(env, axis):
    env.load(make_instance(env.task, 5))
    clean = env.image("agentview", 64, 64)
    env.load(make_instance(env.task, 5, axes={axis: 3}))
    assert (env.image("agentview", 64, 64) != clean).any()


def test_phrasing_changes_words_only(env):
    seed = next(seed for seed in range(20) if make_instance(env.task, seed).phrasing.startswith("train"))
    clean, other = make_instance(env.task, seed), make_instance(env.task, seed, axes={"phrasing": 3})
    assert trace(env, clean) == trace(env, other) and clean.instruction != other.instruction


@pytest.mark.parametrize(("name", "size"), [("can", 1.2), ("red_cube", 0.8), ("green_cylinder", 1.15), ("bottle", 0.9)])
def test_a_scaled_object_is_what_compiling_it_larger_gives(env, name, size):
    import mujoco

    world = env.world
    world.load(make_instance(env.task, 0))
    spec = mujoco.MjSpec.from_string(world.scene.xml)
    for geom in spec.body(world.scene.root_bodies[name]).geoms:
        geom.size = np.array(geom.size) * size
    for mesh in spec.meshes:
        if mesh.name.startswith(f"{name}_"):
            mesh.scale = np.array(mesh.scale) * size
    wanted, model = spec.compile(), world.model
    instance = make_instance(env.task, 0)
    sized = type(instance.perturbation)(sizes=((name, size),))
    world.appearance.apply(sized)
    body = model.body(world.scene.root_bodies[name]).id
    geoms, first = np.flatnonzero(model.geom_bodyid == body), model.body_dofadr[body]
    for field in ("geom_size", "geom_rbound", "geom_aabb", "geom_pos"):
        np.testing.assert_allclose(getattr(model, field)[geoms], getattr(wanted, field)[geoms], rtol=1e-4, atol=1e-6, err_msg=field)
    for field in ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_invweight0"):
        np.testing.assert_allclose(getattr(model, field)[body], getattr(wanted, field)[body], rtol=1e-4, atol=1e-6, err_msg=field)
    assert model.body_subtreemass[0] == pytest.approx(wanted.body_subtreemass[0])
    for field in ("dof_invweight0", "dof_M0"):
        np.testing.assert_allclose(getattr(model, field)[first : first + 6], getattr(wanted, field)[first : first + 6], rtol=1e-4, err_msg=field)
    for mesh in set(model.geom_dataid[geoms]) - {-1}:
        part = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        other = wanted.mesh(model.mesh(mesh).name)
        theirs = wanted.mesh_vert[other.vertadr[0] : other.vertadr[0] + other.vertnum[0]]
        np.testing.assert_allclose(model.mesh_vert[part], theirs, atol=1e-6)
    for field, address, count in (("bvh_aabb", model.body_bvhadr[body], model.body_bvhnum[body]),):
        theirs = getattr(wanted, field)[wanted.body_bvhadr[body] : wanted.body_bvhadr[body] + count]
        np.testing.assert_allclose(getattr(model, field)[address : address + count], theirs, rtol=1e-4, atol=1e-6)
    world.load(instance)


def test_a_larger_mesh_looks_larger_in_both_qualities(env):
    """The renderers keep meshes of their own, which have to follow."""
    seed = next(seed for seed in range(200) if make_instance(env.task, seed).target == "cereal")
    instance = make_instance(env.task, seed)
    counts = {}
    for size in (0.8, 1.0, 1.2):
        sized = type(instance)(**{**instance.__dict__, "perturbation": type(instance.perturbation)(sizes=(("cereal", size),))})
        env.load(sized)
        x, y = env.project(env.world.position("cereal")[None], "agentview", 200)[0].astype(int)
        for quality in ("fast", "full"):
            patch = env.image("agentview", 200, 200, quality)[y - 25 : y + 25, x - 25 : x + 25].astype(int)
            counts[quality, size] = int((np.ptp(patch, axis=2) > 60).sum())
    for quality in ("fast", "full"):
        assert counts[quality, 0.8] < 0.9 * counts[quality, 1.0] < 0.8 * counts[quality, 1.2]


def test_fast_and_full_images_show_the_same_scene(env):
    for seed in range(3):
        env.load(make_instance(env.task, seed, 3))
        fast, full = (env.image("agentview", 128, 128, quality).astype(float) for quality in ("fast", "full"))
        assert np.abs(fast - full).mean() < 14  # of 255: shadows and edges differ, nothing else


@pytest.mark.parametrize("level", [1, 2, 3])
def test_what_is_named_stays_in_view_and_nothing_starts_in_contact_with_the_hand(env, level):
    for seed in range(30):
        instance = make_instance(env.task, seed, level)
        env.load(instance)
        positions = env.entity_positions()
        pixels = env.project(np.array([positions[name] for name in instance.roles.values()]), "agentview", 96)
        assert ((pixels > 2) & (pixels < 94)).all(), instance.key
        assert env.world.grip_position[2] > 1.0
        for place in instance.placements:
            assert np.hypot(*(positions[place.entity][:2] - (place.x, place.y))) < 0.01, (instance.key, place.entity)
        assert not env.success and env.subgoal_fraction == 0.0


def visible_pixels(env, size=192):
    """Thing -> pixels of it that the agentview camera sees, by MuJoCo's segmentation."""
    import mujoco

    env.image("agentview", 8, 8)
    scene = env._images._renderers["fast"]._scene
    flags = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
    scene.flags[flags] = 1
    try:
        codes = env.image("agentview", size, size).astype(np.int64) @ [1, 256, 65536]
    finally:
        scene.flags[flags] = 0
    bodies = {env.world.model.body(body).id: name for name, body in env.world.scene.root_bodies.items()}
    counts = dict.fromkeys(bodies.values(), 0)
    for code, count in zip(*np.unique(codes[codes > 0], return_counts=True), strict=True):
        geom = scene.geoms[code - 1]
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            name = bodies.get(int(env.world.model.body_rootid[env.world.model.geom_bodyid[geom.objid]]))
            if name:
                counts[name] += int(count)
    return counts


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_nothing_hides_what_is_named(env, level):
    seeds = [*range(12), 197]  # at level 3 of seed 197 the camera looks along two objects
    for seed in seeds:
        instance = make_instance(env.task, seed, level)
        env.load(instance)
        counts = visible_pixels(env)
        assert all(counts[name] >= 40 for name in instance.roles.values()), (instance.key, counts)


@pytest.mark.slow
@pytest.mark.parametrize(("level", "wanted"), [(1, 48), (2, 47), (3, 45)])
def test_the_expert_still_manages(env, level, wanted):
    solved = 0
    for seed in range(50):
        env.load(make_instance(env.task, seed, level))
        expert = Expert(env.world)
        while not env.done:
            env.advance(expert.act())
        solved += env.success
    assert solved >= wanted


def test_a_gymnasium_environment_draws_perturbed_instances():
    env = TaskEnv("pick_place", level=1, axes={"camera": 3})
    env.reset(seed=0)
    assert env.instance.key.startswith("pick_place/train/1,camera=3/")
    env.close()


def test_the_contact_sheet(tmp_path, capsys):
    import cv2

    out = tmp_path / "docs" / "sheet.png"
    assert gallery.main(["--task", "pick_place", "--size", "96", "--seed", "3", "--out", str(out)]) == 0
    picture = cv2.imread(str(out))
    assert picture.shape == (contact_sheet.HEADER + 96 + contact_sheet.BAND, contact_sheet.MARGIN + 4 * 96, 3)
    cells = [
        picture[contact_sheet.HEADER : contact_sheet.HEADER + 96, contact_sheet.MARGIN + 96 * level : contact_sheet.MARGIN + 96 * (level + 1)]
        for level in range(4)
    ]
    assert all((one != other).any() for one, other in itertools.pairwise(cells))
    assert [file.name for file in out.parent.iterdir()] == ["sheet.png"]
    for flags, message in (["--out", str(tmp_path / "a.jpg")], ".png"), (["--task", "pick_plac", "--out", str(out)], "did you mean 'pick_place'"):
        assert gallery.main(flags) == 2
        assert message in capsys.readouterr().err
