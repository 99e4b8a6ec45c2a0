"""A saved state: going on from it equals never having stopped, and a damaged one is refused in one line."""

import contextlib
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.data.state_arrays import Arrays, StateError
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.graph import key_frames
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam import saved_state
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import fan, scan_at
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head
from tests.unit.ngo_estimator.slam.test_online_trajectory import make_steps

Make = Callable[[], CorrectedTrajectory]


@pytest.fixture(autouse=True)
def little_slack(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two key frames and their slack are soon full: some go, and loops move to others."""
    monkeypatch.setattr(key_frames, "SLACK", 3)


def networks(form: str = "loops", iterations_per_step: int = 0, window_frames: int = 32) -> OnlineTrajectory:
    head = None if form == "paper" else small_pair_head()
    return OnlineTrajectory(small_optimizer(form, trained=True), head, window_frames, 2, iterations_per_step)


@lru_cache
def lidar_drive(rounds: float = 1.25) -> tuple[RelativeStep, ...]:
    """A robot that goes round a block and meets its own way again."""
    true, generator = loop_way(rounds), np.random.default_rng(0)

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(HOUSE, true[k], stamp_ns, fan(91, 270.0), noise=(0.01, generator))

    return tuple(lidar_steps(drifted(true, (0.01, 0.005, 0.004)), scan))


def scans(config: ScanGraphConfig | None = None) -> ScanTrajectory:
    return ScanTrajectory(config, iterations_per_step=1)


def through_files(core: CorrectedTrajectory, folder: Path) -> Arrays:
    write_state(folder, core.identity, core.state())
    return read_state(folder, core.identity)


def assert_same(a: CorrectedTrajectory, b: CorrectedTrajectory) -> None:
    """Equal in all that later steps depend on, to the last bit."""
    ours, theirs = a.state(), b.state()
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        assert (array.dtype, array.shape, array.tobytes()) == (
            theirs[name].dtype, theirs[name].shape, theirs[name].tobytes()
        ), name  # fmt: skip


def drive(core: CorrectedTrajectory, steps: list[RelativeStep], paused: range) -> None:
    for k, step in enumerate(steps):
        core.update(step, optimize=k not in paused)


# ---- the round trip


@given(data=st.data())
@settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_saved_and_loaded_at_any_step_it_goes_on_as_if_never_stopped(tmp_path: Path, data: st.DataObject) -> None:
    form = data.draw(st.sampled_from(["loops", "smoothed", "gauss_newton", "paper"]))
    spread = data.draw(st.integers(0, 1))
    before, lost = data.draw(st.integers(1, 120)), data.draw(st.integers(0, 12))
    paused = range(data.draw(st.integers(0, 120)), data.draw(st.integers(0, 140)))
    steps = make_steps(140)
    del steps[before - min(lost, before - 1) : before]  # a gap, right before it is saved or soon after
    if data.draw(st.booleans()):  # another trajectory before this one, which is forgotten
        steps = [*make_steps(20, seed=1, origin_ns=-(10**12)), *steps]
    original = networks(form, spread)
    drive(original, steps[:before], paused)
    loaded = networks(form, spread).restored(through_files(original, tmp_path / "state"))
    assert_same(original, loaded)
    for k, step in enumerate(steps[before:], start=before):
        ours, theirs = (core.update(step, optimize=k not in paused) for core in (original, loaded))
        for name, value in vars(ours).items():
            np.testing.assert_array_equal(getattr(theirs, name), value, err_msg=name)
    assert_same(original, loaded)
    assert (original.finish() is None) == (loaded.finish() is None)
    assert_same(original, loaded)


def test_a_session_that_was_paused_for_longer_than_its_window_is_loaded() -> None:
    core, steps = networks("loops", 1), make_steps(200)
    drive(core, steps[:160], range(100, 160))
    assert core._back_end._corrections is not None and core._back_end._corrections.last <= core._back_end._first
    loaded = networks("loops", 1).restored(core.state())
    for step in steps[160:]:
        core.update(step), loaded.update(step)
    assert_same(core, loaded)


def test_the_round_trip_holds_where_key_frames_have_gone() -> None:
    core, steps = networks("loops", 1), make_steps(160)
    drive(core, steps[:145], range(0))
    back_end = core._back_end
    assert len(back_end.graph) < 1 + back_end._odometry.blocks
    loaded = networks("loops", 1).restored(core.state())
    drive(core, steps[145:], range(0)), drive(loaded, steps[145:], range(0))
    assert len(core._back_end.closed)
    assert_same(core, loaded)


def test_what_is_due_is_done_before_a_state_is_saved() -> None:
    core, steps = networks("loops", 1), make_steps(80)
    drive(core, steps, range(0))
    assert core.unfinished
    loaded = networks("loops", 1).restored(core.state())
    assert not core.unfinished and not loaded.unfinished and loaded.finish() is None


def test_the_round_trip_holds_at_each_frame_of_a_meta_pose_where_updates_go_on_from_the_last_solution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    core, steps, updates, others = networks("loops", 1, window_frames=160), make_steps(150), set(), []
    drive(core, steps[:120], range(0))
    for name in ("_anneal", "_resume"):
        update = getattr(core._back_end, name)
        monkeypatch.setattr(
            core._back_end, name, lambda *given, of=name, update=update: (updates.add(of), update(*given))[1]
        )
    for step in steps[120:136]:
        for other in [core, *others]:
            other.update(step)
        others.append(networks("loops", 1, window_frames=160).restored(core.state()))
    assert updates == {"_anneal", "_resume"}
    for other in others:
        assert_same(core, other)


@pytest.mark.parametrize("when", ["halfway", "while a loop waits", "after key scans have gone"])
def test_the_round_trip_of_a_lidar_is_exact(tmp_path: Path, when: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config, rounds = ScanGraphConfig(), 1.25
    if when == "after key scans have gone":
        config, rounds = ScanGraphConfig(most_scans=100), 2.5
    original, steps = scans(config), lidar_drive(rounds)
    for count, step in enumerate(steps, start=1):
        original.update(step)
        back_end = original.back_end
        gone = len(back_end.graph.borders) > 1
        reached = {
            "halfway": count == len(steps) // 2,
            "while a loop waits": back_end.unfinished,
            "after key scans have gone": gone and len(back_end._finder._submaps) > 0,
        }
        if reached[when]:
            break
    assert reached[when] and count < len(steps)
    loaded = scans(config).restored(through_files(original, tmp_path / "state"))
    assert_same(original, loaded)
    for step in steps[count:]:
        original.update(step), loaded.update(step)
    original.finish(), loaded.finish()
    assert original.newest().closed_loops > 0
    assert_same(original, loaded)


def test_an_array_in_another_order_of_memory_is_read_as_it_was(tmp_path: Path) -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(3, 2))
    write_state(tmp_path / "state", {}, {"rows": array, "count": np.array(3)})
    found = read_state(tmp_path / "state", {})
    np.testing.assert_array_equal(found["rows"], array)
    assert found["count"].shape == ()


def test_without_the_library_of_states_saving_and_loading_end_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_state(tmp_path / "state", {"map": 1}, {"a": np.zeros(3)})
    monkeypatch.setitem(sys.modules, "safetensors", None)
    monkeypatch.setitem(sys.modules, "safetensors.numpy", None)
    with pytest.raises(StateError, match="need the Python package safetensors"):
        write_state(tmp_path / "new", {"map": 1}, {"a": np.zeros(3)})
    with pytest.raises(StateError, match="need the Python package safetensors"):
        read_state(tmp_path / "state", {"map": 1})
    assert not (tmp_path / "new").exists()


def test_an_empty_trajectory_is_not_saved() -> None:
    with pytest.raises(StateError, match="the trajectory is empty"):
        networks().state()


# ---- files


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, OnlineTrajectory]:
    core = networks()
    drive(core, make_steps(40), range(0))
    write_state(tmp_path / "state", core.identity, core.state())
    return tmp_path / "state", core


def refusal(folder: Path, core: CorrectedTrajectory) -> str:
    with pytest.raises(StateError) as caught:
        core.restored(read_state(folder, core.identity))
    line = str(caught.value)
    assert "\n" not in line and str(folder) in line
    return line


@pytest.mark.parametrize("name", ["state.json", "arrays"])
def test_every_damage_is_refused_in_one_line(saved: tuple[Path, OnlineTrajectory], name: str) -> None:
    folder, core = saved
    (path,) = folder.glob(name + "*")
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    for cut in {0, 1, 7, 8, len(whole) - 1, *generator.integers(0, len(whole), 20).tolist()}:
        path.write_bytes(whole[:cut])
        refusal(folder, core)
    places = range(len(whole)) if name == "state.json" else generator.integers(0, len(whole), 100).tolist()
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place % 8)
        path.write_bytes(bytes(damaged))
        refusal(folder, core)
    path.write_bytes(whole + b"\n")
    refusal(folder, core)
    path.unlink()
    assert refusal(folder, core) == f"{path}: cannot be read (No such file or directory)"


def test_other_settings_weights_and_formats_are_refused(
    saved: tuple[Path, OnlineTrajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, core = saved
    path = folder / "state.json"
    assert refusal(folder, networks(window_frames=48)) == f"{path}: was saved with window_frames 32; here it is 48"
    other = OnlineTrajectory(small_optimizer("loops"), small_pair_head(), 32, 2)
    assert refusal(folder, other).startswith(f'{path}: was saved with weights_sha256 "')
    assert refusal(folder, scans()).startswith(f"{path}: was saved with graph null; here it is ")
    written = saved_state.FORMAT
    monkeypatch.setattr(saved_state, "FORMAT", written + 1)
    assert refusal(folder, core) == f"{path}: is of format {written}; expected {written + 1}"


def test_the_scans_of_a_map_are_no_session_and_neither_replaces_the_other(tmp_path: Path) -> None:
    core, of_a_map = networks(), {"map": "maze2d", "max_range": 0.0}
    drive(core, make_steps(20), range(0))
    session, scans_folder, arrays = tmp_path / "office", tmp_path / "scans", {"stamps_ns": np.arange(3)}
    write_state(session, core.identity, core.state())
    write_state(scans_folder, of_a_map, arrays)
    expected = f"{scans_folder}/state.json: is the scans of an ngo_map; expected the state of an ngo_node"
    assert refusal(scans_folder, core) == expected
    with pytest.raises(StateError, match="is the state of an ngo_node; expected the scans of an ngo_map"):
        read_state(session, of_a_map)
    with pytest.raises(StateError, match="office: holds the state of an ngo_node; save the scans of an ngo_map in a"):
        write_state(session, of_a_map, arrays)
    core.restored(read_state(session, core.identity))
    (scans_folder / "state.json").write_text("damaged")
    write_state(scans_folder, core.identity, core.state())  # nothing is lost there


def test_a_lidars_other_settings_are_named(tmp_path: Path) -> None:
    core = scans()
    drive(core, list(lidar_drive()[:5]), range(0))
    write_state(tmp_path / "state", core.identity, core.state())
    other = ScanGraphConfig(loops=replace(ScanGraphConfig().loops, every=3))
    expected = f"{tmp_path}/state/state.json: was saved with graph.loops.every 2; here it is 3"
    assert refusal(tmp_path / "state", scans(other)) == expected


@pytest.mark.parametrize("make", [networks, scans])
def test_arrays_that_no_trajectory_gave_are_refused_and_leave_the_old_one(make: Make) -> None:
    core, steps = make(), make_steps(100) if make is networks else list(lidar_drive()[:40])
    drive(core, steps, range(0))
    good, generator = core.state(), np.random.default_rng(0)
    for name, array in good.items():
        for wrong in ({}, {name: array[..., None]}, {name: array.astype(np.complex128)}):
            with pytest.raises(StateError):
                core.restored({**{k: v for k, v in good.items() if k != name}, **wrong})
        if array.ndim and len(array) and name != "_back_end.graph._before":  # which says how many nodes there were
            with pytest.raises(StateError):
                core.restored({**good, name: np.concatenate((array, array[generator.integers(len(array))][None]))})
    assert_same(core, core.restored(good))


def test_a_state_is_replaced_by_a_whole_one_or_not_at_all(
    saved: tuple[Path, OnlineTrajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, core = saved
    old = core.state()
    drive(core, make_steps(50)[40:], range(0))
    for failing in range(2):  # the disk is full at the arrays, or at the description
        calls = []

        def fsync(handle: int, failing: int = failing, calls: list[int] = calls) -> None:
            calls.append(handle)
            if len(calls) == 1 + 2 * failing:
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", fsync)
        with pytest.raises(StateError, match=r"state/\S+: cannot be written \(No space left on device\)"):
            write_state(folder, core.identity, core.state())
        calls.clear()
        with pytest.raises(StateError, match="cannot be written"):
            write_state(folder.parent / "new", core.identity, core.state())
        assert not (folder.parent / "new").exists()
        assert len(list(folder.iterdir())) == 2
        loaded = read_state(folder, core.identity)
        assert all(np.array_equal(loaded[name], array) for name, array in old.items())
    monkeypatch.undo()
    write_state(folder, core.identity, core.state())
    assert_same(core, core.restored(read_state(folder, core.identity)))
    assert len(list(folder.iterdir())) == 2


def test_killed_at_any_moment_it_leaves_a_whole_state(
    saved: tuple[Path, OnlineTrajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, core = saved
    old = core.state()
    core.update(make_steps(41)[40])
    new = core.state()

    class Killed(BaseException):
        """Which nothing cleans up after."""

    def stopping(call: Callable[..., Any]) -> Callable[..., Any]:
        def stop(*arguments: Any, **more: Any) -> Any:
            calls.append(call)
            if len(calls) == moment:
                raise Killed
            return call(*arguments, **more)

        return stop

    def is_state(arrays: Arrays) -> bool:
        return all(np.array_equal(found[name], array) for name, array in arrays.items())

    outcomes = []
    for moment in range(1, 100):
        write_state(folder, core.identity, old)
        calls: list[Any] = []
        with monkeypatch.context() as patched, contextlib.suppress(Killed):
            for owner, name in ((os, "fsync"), (os, "replace"), (Path, "unlink"), (Path, "mkdir"), (Path, "open")):
                patched.setattr(owner, name, stopping(getattr(owner, name)))
            write_state(folder, core.identity, new)
        found = read_state(folder, core.identity)
        assert is_state(old) or is_state(new)
        outcomes.append(is_state(new))
        if len(calls) < moment:
            break
    assert outcomes == sorted(outcomes) and len(outcomes) > 8 and not outcomes[0] and outcomes[-1]
    assert len(list(folder.iterdir())) == 2


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    core = networks()
    drive(core, make_steps(9), range(0))
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(StateError, match=r"holds 'thesis\.tex'; expected a saved state, an empty folder or none"):
        write_state(tmp_path, core.identity, core.state())
    with pytest.raises(StateError, match="is a file; expected a folder"):
        write_state(tmp_path / "thesis.tex", core.identity, core.state())
    with pytest.raises(StateError, match="missing/state: cannot be written"):
        write_state(tmp_path / "missing" / "state", core.identity, core.state())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_description_says_what_was_saved(saved: tuple[Path, OnlineTrajectory]) -> None:
    folder, core = saved
    values = json.loads((folder / "state.json").read_text())
    assert values["format"] == saved_state.FORMAT and values["identity"] == core.identity
    assert (folder / values["arrays"]).is_file()
