"""Tables of moments, and what they say of monitors: on a made-up log whose answer is known."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from synthetic_moments import ENCODER, POLICIES, stuck_log

from osel_sim.analysis.equal_duty import blind_arms, random_arm
from osel_sim.analysis.handovers import Handovers, blind, by_chance, first_turns, never, outcomes, recovered_and_harmed
from osel_sim.analysis.learned_handovers import learned_turns
from osel_sim.analysis.log import Array
from osel_sim.analysis.moment_arms import values_of
from osel_sim.analysis.moment_log import MomentLog, read_moment_log
from osel_sim.analysis.moment_oracles import gains_at, oracles_of
from osel_sim.analysis.units import units_of
from osel_sim.api.replay import replay
from osel_sim.api.report import report
from osel_sim.core.errors import DataError, OselError, SettingError, UsageError
from osel_sim.episodes.moment_recording import MOMENT_SHARDS, MomentRecording
from osel_sim.episodes.moments import Cuts, Moments
from osel_sim.formats.moments import MOMENTS, SEEN, SIGNALS, MomentRow, read_moments, write_moments
from osel_sim.formats.moments_result import MOMENTS_RESULT
from osel_sim.formats.replay_result import REPLAY
from osel_sim.formats.rollout_log import read_rollouts, write_rollouts
from osel_sim.selection.reward import preset

WEIGHTS = preset("oxe")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stuck_log(tmp_path_factory.mktemp("moments") / "log")


@pytest.fixture(scope="module")
def log(folder: Path) -> MomentLog:
    return read_moment_log(folder)


# -- the table ---------------------------------------------------------------------------------------------------------------------------


def test_a_table_is_read_as_it_was_written_and_is_the_same_bytes_again(folder: Path, tmp_path: Path) -> None:
    table = read_moments(folder)
    about = {key: value for key, value in table.metadata.items() if key not in ("schema_version", "seen_sha256")}
    write_moments(tmp_path, table.rows, table.seen, about)
    for name in (MOMENTS, SEEN):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_a_table_without_moments_can_be_read(folder: Path, tmp_path: Path) -> None:
    table = read_moments(folder)
    write_moments(tmp_path, [], replace(table.seen, pictures=table.seen.pictures[:0], signals=table.seen.signals[:0]), table.metadata)
    assert read_moments(tmp_path).rows == []


def _first(rows: list[MomentRow], **changed: object) -> list[MomentRow]:
    return [replace(rows[0], **changed), *rows[1:]]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: _first(rows, call=5), "call must be a multiple of 4, got 5"),
        (lambda rows: _first(rows, step=0), "call and step must be 1 or more"),
        (lambda rows: _first(rows, second="local"), "second must be another policy than first"),
        (lambda rows: _first(rows, first="nobody"), "must be of local, remote, got 'nobody'"),
        (lambda rows: _first(rows, steps=3), "steps must be more than the 32 before the moment"),
        (lambda rows: _first(rows, price=-1.0), "price must be a finite number of 0 or more"),
        (lambda rows: _first(rows, subgoals=float("nan")), "subgoals must be a number in [0, 1]"),
        (lambda rows: _first(rows, remote_steps=1000), "must be parts of steps"),
        (lambda rows: _first(rows, step=33), "step is 32, in an earlier row of the same moment 33"),
        (lambda rows: rows[1:], "does not go on with None"),
        (lambda rows: [rows[0], *rows], "goes on with None twice"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused_with_the_row_and_the_field(folder: Path, tmp_path: Path, change: object, says: str) -> None:
    table = read_moments(folder)
    write_moments(tmp_path, change(list(table.rows)), table.seen, table.metadata)  # type: ignore[operator]
    with pytest.raises(DataError, match=re.escape(says)) as told:
        read_moments(tmp_path)
    assert MOMENTS in str(told.value)


@pytest.mark.parametrize("name", [MOMENTS, SEEN])
def test_every_damaged_byte_is_refused_or_changes_nothing(folder: Path, tmp_path: Path, name: str) -> None:
    small = stuck_log(tmp_path / "small", instances=3, repeats=1)
    whole, there = (small / name).read_bytes(), read_moments(small)
    random = np.random.default_rng(0)
    for at in random.choice(len(whole), 60, replace=False):
        (small / name).write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            assert read_moments(small).rows == there.rows
        except OselError:
            continue
    for length in (0, 4, len(whole) // 2, len(whole) - 1):
        (small / name).write_bytes(whole[:length])
        with pytest.raises(OselError, match=re.escape(name)):
            read_moments(small)


def test_a_table_of_other_episodes_than_the_log_beside_it_is_refused(folder: Path, tmp_path: Path) -> None:
    other = stuck_log(tmp_path / "other", instances=160, seed=1)
    for name in (MOMENTS, SEEN):
        (other / name).write_bytes((folder / name).read_bytes())
    with pytest.raises(DataError, match=r"of going on is .* in the rollout log beside it"):
        read_moment_log(other)


# -- what handovers come to --------------------------------------------------------------------------------------------------------------


def test_handing_over_nothing_is_the_first_policy_alone(log: MomentLog) -> None:
    for name, values in outcomes(log, never(log)).items():
        np.testing.assert_array_equal(values, log.alone[name])


def test_blind_handovers_are_the_rows_of_the_table(log: MomentLog) -> None:
    found = outcomes(log, blind(log, 8, 1))
    np.testing.assert_array_equal(found["success"][:, 0], log.ways["success"][:, 0, :, 1, 1])
    np.testing.assert_array_equal(found["price"][:, 1], log.alone["price"][:, 1])  # it drives already


def test_only_the_first_turn_of_an_episode_counts(log: MomentLog) -> None:
    turns = np.ones(log.there.shape, int)  # the remote policy, at every point
    np.testing.assert_array_equal(first_turns(log, turns), blind(log, 4, 1))


def test_chance_is_expected_exactly(log: MomentLog) -> None:
    chance = by_chance(log, 0.25, [0, 1])
    np.testing.assert_allclose(chance[:, 0].sum(axis=(2, 3)), 1.0 - 0.75**2)
    own, expected = outcomes(log, chance)["price"][:, 0], 0.25 * 10.0 + 0.75 * 0.25 * 10.0
    np.testing.assert_allclose(own, expected)


def test_recovered_and_harmed_are_of_what_the_first_policy_alone_does(log: MomentLog) -> None:
    lost, recovered, won, harmed = recovered_and_harmed(log, blind(log, 4, 1))
    assert recovered[:, 0].sum() == lost[:, 0].sum() > 0
    assert harmed.sum() == 0 < won.sum()


def test_arms_without_looking_have_the_duty_that_is_asked_for(log: MomentLog) -> None:
    share = np.tile([1.0, 0.0], (len(log), 1))
    for arm in [*blind_arms(log, 0.4, share), random_arm(log, 0.4, share)]:
        assert arm is not None
        assert _duty(log, arm.handovers, share) == pytest.approx(0.4, abs=1e-3)
    assert {arm.name for arm in blind_arms(log, 0.4, share)} == {"blind:8:remote or blind:4:remote"}
    assert random_arm(log, 0.9, share) is None  # even at the first point it is too late for so much


def test_instances_count_alike_in_duty_however_often_they_were_repeated(log: MomentLog) -> None:
    """As in the duty of the monitor that the arms are set against."""
    gone = np.zeros(log.there.shape[:3], bool)
    gone[::2, :, 1] = True
    whole = {name: np.where(gone, np.nan, getattr(log.whole, name)) for name in ("success", "subgoals", "steps", "price")}
    ways = {name: np.where(gone[..., None, None], np.nan, values) for name, values in log.ways.items()}
    fewer = replace(log, whole=replace(log.whole, **whole), ways=ways, seen_at=np.where(gone[..., None], -1, log.seen_at))
    share = np.tile(np.eye(2), (len(log) // 2, 1))  # the remote policy begins where nothing is missing
    arms = [*blind_arms(fewer, 0.6, share), random_arm(fewer, 0.6, share)]
    assert len(arms) > 1
    for arm in arms:
        assert arm is not None
        assert _duty(fewer, arm.handovers, share) == pytest.approx(0.6, abs=1e-3)


def _duty(log: MomentLog, handovers: Handovers, share: Array) -> float:
    """As a replay reports it."""
    measures = values_of(log, share, handovers, WEIGHTS).measures
    return float(np.nansum(measures["remote_steps"]) / np.nansum(measures["steps"]))


# -- what can be learned -----------------------------------------------------------------------------------------------------------------


def test_what_the_picture_shows_is_learned_and_what_it_does_not_is_left_alone(log: MomentLog, tmp_path: Path) -> None:
    choose = log.whole.half("choose")
    turns, chosen = learned_turns(log, WEIGHTS, choose, ~choose)
    own = outcomes(log, first_turns(log, turns))
    assert np.nanmean(own["success"][~choose, 0]) > 0.97  # the local policy alone: 0.6
    assert np.nanmean(own["price"][~choose, 0]) < 5.0  # it is stuck in 40%, and a rescue costs 10
    assert chosen["local"].model
    _, blinded = learned_turns(log, WEIGHTS, choose, ~choose, look=False)
    assert blinded["local"].gain < chosen["local"].gain - 0.03


def test_oracles_do_not_count_luck_as_foresight(log: MomentLog) -> None:
    found = oracles_of(log, WEIGHTS)
    assert found.repeated.all()
    # Nobody can know beforehand in which repeat the local policy gets stuck: handing over blindly is the best schedule that can be known.
    assert np.nanmean(found.when) <= np.nanmean(found.hindsight_when) - 0.03
    assert np.nanmean(found.when) >= np.nanmean(found.once) + 0.05


def test_gains_are_of_the_same_states(log: MomentLog) -> None:
    gains = {(gain.task, gain.first, gain.call): gain for gain in gains_at(log, WEIGHTS, units_of(log.whole))}
    early, late = gains["task", "local", 4], gains["task", "local", 8]
    assert (early.recovered, early.harmed, late.recovered) == (1.0, 0.0, 0.0)
    assert late.gain.value == pytest.approx(-0.1)
    assert early.gain.value > 0.2


# -- the command -------------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def replayed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("replayed") / "out"
    out.mkdir()
    (out / REPLAY).write_text("{}")  # of another replay, which this one replaces
    replay(folder, selectors=["auto:warm"], seeds=2, workers=1, out=out, overwrite=True)
    return out


def test_a_replay_says_by_whom_to_hand_over(replayed: Path) -> None:
    result = json.loads((replayed / MOMENTS_RESULT).read_text())
    verdict = result["verdict"]
    assert (verdict["decision"], verdict["start"]) == ("hand_over", "auto:warm")
    assert verdict["headline"].startswith("Hand over by learned")
    arms = {(arm["start"], arm["monitor"]): arm for arm in result["arms"]}
    best, alone = arms["auto:warm", verdict["monitor"]], arms["auto:warm", "never"]
    assert best["reward"][0] > alone["reward"][0] + 0.1
    assert best["first"][0] > 0.3 > alone["first"][0]  # the start selector learns from what episodes come to with the monitor
    own = arms["fixed:local", "learned"]
    assert own["recovered"] > 2 * max(other["recovered"] for other in own["equal_duty"])
    assert {row.split(",")[0] for row in (replayed / "arms.csv").read_text().splitlines()[1:]} == {
        "auto:warm",
        *(f"fixed:{name}" for name in POLICIES),
    }


def test_a_replay_has_a_page(replayed: Path, tmp_path: Path) -> None:
    written = report(replayed, out=tmp_path)
    assert written.verdict.startswith("Hand over by learned")
    assert {file.stem for file in (tmp_path / "figures").glob("*.png")} == {"timeline", "gains", "duty"}


def test_settings_of_other_replays_are_refused(folder: Path, replayed: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"decisions: .* holds a table of moments"):
        replay(folder, decisions=10, out=tmp_path / "new")
    with pytest.raises(OselError, match="holds a replay"):
        replay(folder, out=replayed)


def test_a_table_with_nobody_to_hand_over_to_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="with local alone there is nobody to hand over to"):
        replay(folder, policies=["local"], out=tmp_path / "new")


def test_a_table_without_an_outcome_of_some_policy_is_refused(tmp_path: Path) -> None:
    log = stuck_log(tmp_path / "log", instances=20, repeats=1)
    rows, about = read_rollouts(log)
    failed = [replace(row, error="down") if row.policy == "remote" else row for row in rows]
    write_rollouts(log, failed, {key: about[key] for key in ("encoder", "policies")})
    table = read_moments(log)
    moments = [replace(row, error="down") if "remote" in (row.first, row.second) else row for row in table.rows]
    write_moments(log, moments, table.seen, {key: value for key, value in table.metadata.items() if key not in ("schema_version", "seen_sha256")})
    with pytest.raises(DataError, match="remote has no outcome on any of"):
        replay(log, out=tmp_path / "new")


def test_the_shipped_table_is_of_its_log() -> None:
    log = read_moment_log(Path(__file__).parent.parent / "assets" / "logs" / "moments")
    assert log.policies == ("local_small", "remote_large", "remote_specialist") and log.calls == (6, 12, 18)
    assert log.remote.tolist() == [False, True, True]
    assert np.isfinite(log.ways["success"][log.there]).all()


def test_a_table_that_grows_loses_nothing_where_it_is_cut_off(tmp_path, monkeypatch):
    """Its two files change one after the other, and then no longer belong together."""
    folder, cuts, about = stuck_log(tmp_path / "log", instances=3), Cuts(4, 2), {"policies": list(POLICIES), "remote": ["remote"], "encoder": ENCODER}
    table = read_moments(folder)
    (instance, first, _), own = table.rows[0].moment[:3], [row for row in table.rows if row.moment[:3] == table.rows[0].moment[:3]]
    more = Moments(tuple(replace(row, repeat=9) for row in own), np.ones((2, 8), np.float32), np.zeros((2, len(SIGNALS))))
    episodes = [*dict.fromkeys(row.moment[:3] for row in table.rows), (instance, first, 9)]

    def killed(*arguments, **settings):
        raise KeyboardInterrupt

    recording = MomentRecording(folder)
    recording.add({(instance, first, 9): more})
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pyarrow.parquet, "write_table", killed)
        recording.finish(episodes, cuts, about)
    MomentRecording(folder).finish(episodes, cuts, about)
    grown = read_moments(folder)
    assert list(grown.rows) == [*table.rows, *more.rows]
    np.testing.assert_array_equal(grown.seen.pictures, np.concatenate([table.seen.pictures, more.pictures]))
    assert not (folder / MOMENT_SHARDS).exists()
