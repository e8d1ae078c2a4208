"""The components that tuned PPO and Vowpal Wabbit see."""

import numpy as np

from osel_sim.selection.scaling import RunningComponents


def contexts(count: int, dim: int = 40) -> np.ndarray:
    generator = np.random.default_rng(0)
    return (3.0 + generator.normal(size=(count, 3)) @ generator.normal(size=(3, dim)) * 0.01).astype(np.float32)


def test_few_numbers_of_size_one_that_keep_what_they_mean():
    rows = contexts(200)
    scale = RunningComponents(40, 8)
    seen = scale.stream(rows)
    assert seen.shape == (200, 8) and (seen[:15] == 0).all()
    assert np.isfinite(seen).all() and 0.2 < (seen[32:] ** 2).sum(axis=1).mean() / 3 < 5
    for row in rows[:127]:
        scale.add(row)
    before = scale.transform(rows)
    scale.add(rows[127])  # here it is fitted anew
    after = scale.transform(rows)
    assert not np.array_equal(before, after)
    assert ((after - before) ** 2).mean() < 0.05 * (before**2).mean()


def test_a_stream_is_what_one_by_one_gives_and_a_state_goes_on():
    rows = contexts(80)
    scale = RunningComponents(40, 4)
    ahead = scale.stream(rows)
    one_by_one = []
    for number, row in enumerate(rows):
        if number == 50:
            state = scale.state()
            scale = RunningComponents(40, 4)
            scale.load(state)
        scale.add(row)
        one_by_one.append(scale.transform(row))
    assert (ahead == np.stack(one_by_one)).all()


def test_equal_contexts_are_nothing():
    assert (RunningComponents(5, 4).stream(np.ones((40, 5), np.float32)) == 0).all()
