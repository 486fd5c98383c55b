"""Paged table: an array to whoever reads and writes it, of which only what was used lately is in memory."""

import numpy as np
import pytest

from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.landmarks import paged_table
from mapper.odometry.local_map.landmarks.landmark_kernels import count_observers, observations_of
from mapper.odometry.local_map.landmarks.paged_table import PAGE_ROWS, WORKING_SET_STEPS, PagedTable
from mapper.runtime.archive import Archive
from mapper.runtime.journal import Journal
from mapper.runtime.state_pickle import dumps, loads
from tests.support.desk_frames import odometry_after

ROWS = 8 * PAGE_ROWS


class Store:
    """An archive with its journal, and what a checkpoint does with both."""

    def __init__(self, folder):
        self.journal = Journal(folder / "journal")
        self.archive = Archive(self.journal, recent_bytes=0)

    def checkpoint(self, state):
        """Write a state, release what it left to the archive, and return its bytes."""
        data = dumps(state, archive=self.archive.place_of)
        self.journal.write(self.journal.take())
        self.archive.release(self.archive.take())
        return data

    def restored(self, data):
        return loads(data, archived=self.archive.at)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path)


def table_of(rows):
    table = PagedTable(number=((), np.int32), point=((3,), np.float64))
    table.append(rows, number=np.arange(rows), point=np.arange(3.0 * rows).reshape(-1, 3))
    return table


def forget(table, steps=WORKING_SET_STEPS + 32):
    for _ in range(steps):
        table.step()


def in_memory(table):
    return sum(page >= 0 for page in table._page_in)


@pytest.mark.parametrize("seed", range(4))
def test_it_is_an_array_to_whoever_reads_and_writes_it(store, seed):
    rng = np.random.default_rng(seed)
    table, rows = table_of(100), np.arange(100, dtype=np.int32)
    for _ in range(300):
        match rng.integers(5):
            case 0:
                new = rng.integers(0, 9000, rng.integers(2 * PAGE_ROWS)).astype(np.int32)
                ids = table.append(len(new), number=new, point=0.0)
                assert ids.tolist() == list(range(len(rows), len(rows) + len(new)))
                rows = np.concatenate([rows, new])
            case 1:
                ids = rng.choice(len(rows), 5, replace=False)
                table["number"][ids] += 1
                rows[ids] += 1
            case 2:
                table = store.restored(store.checkpoint(table))
            case 3:
                forget(table)
        ids = rng.integers(0, len(rows), 20)
        assert table["number"][ids].tolist() == rows[ids].tolist()
    assert table["number"][np.arange(table.size)].tolist() == rows.tolist()


def test_what_was_not_used_for_long_is_neither_in_memory_nor_in_a_state(store):
    table = table_of(ROWS)
    whole = store.checkpoint(table)
    for _ in range(WORKING_SET_STEPS + 32):
        table.step()
        table["number"][np.array([5])] = 7
    store.checkpoint(table)
    assert in_memory(table) == 1
    assert len(store.checkpoint(table)) < len(whole) / 6
    assert store.restored(store.checkpoint(table))["number"][np.array([5, PAGE_ROWS])].tolist() == [7, 1024]


def test_a_page_that_has_not_changed_is_not_written_again(store):
    table = table_of(ROWS)
    forget(table)
    store.checkpoint(table)
    end = store.journal.end
    assert table["point"][np.arange(ROWS)].sum() == np.arange(3.0 * ROWS).sum()
    assert in_memory(table) == 8
    forget(table)
    store.checkpoint(table)
    assert store.journal.end == end

    table["number"][np.array([0])] = 1
    forget(table)
    store.checkpoint(table)
    assert store.journal.end > end


def test_without_an_archive_all_of_it_stays_in_memory():
    table = table_of(ROWS)
    forget(table)
    assert in_memory(table) == 0
    assert table["number"][np.array([0, ROWS - 1])].tolist() == [0, ROWS - 1]
    assert loads(dumps(table))["number"][np.array([ROWS - 1])].tolist() == [ROWS - 1]


def test_an_id_of_nothing_reads_anything_and_nothing_more():
    table = table_of(10)
    assert len(table["number"][np.array([-1, 3, -1])]) == 3
    assert table["number"][np.array([-1, 3])][1] == 3
    assert PagedTable(number=((), np.int32))["number"][np.array([-1])].shape == (1,)


def test_compiled_code_follows_ids_through_pages_that_are_not_in_memory():
    rng = np.random.default_rng(0)
    landmark = rng.integers(0, 50, ROWS)
    observations = PagedTable(older=((), np.int32), keyframe=((), np.int32))
    older, newest = np.full(ROWS, -1), np.full(50, -1, np.int32)
    for e, which in enumerate(landmark):
        older[e], newest[which] = newest[which], e
    keyframe = np.arange(ROWS) // 100
    keyframe[rng.random(ROWS) < 0.3] = -1
    observations.append(ROWS, older=older, keyframe=keyframe)
    chosen = np.array([3, 17, 8])

    def found():
        columns = ("older", "keyframe")
        counts = observations.follow(count_observers, newest[chosen], 100, columns=columns)
        return counts.tolist(), *observations.follow(observations_of, newest[chosen], columns=columns)

    counts, first, grouped = found()
    expected = [np.flatnonzero((landmark == which) & (keyframe >= 0))[::-1] for which in chosen]
    assert counts == np.bincount(keyframe[np.concatenate(expected)], minlength=100).tolist()
    assert grouped.tolist() == np.concatenate(expected).tolist()
    assert first.tolist() == [0, *np.cumsum([len(group) for group in expected])]
    forget(observations)
    assert in_memory(observations) == 0
    again = found()
    assert in_memory(observations) == 8
    assert (again[0], again[1].tolist(), again[2].tolist()) == (counts, first.tolist(), grouped.tolist())


def test_tracking_does_not_depend_on_what_is_in_memory(frames, monkeypatch):
    def tracked():
        odometry = build_frame_odometry(LocalMapConfig())
        results = [odometry.track(odometry.observe(frame)) for frame in frames]
        poses = [*(step.T_world_body for step in results), *(factor.T_i_j for factor in odometry.finish())]
        return np.array(poses).tobytes()

    wanted = tracked()
    left = []
    leave = PagedTable._leave
    monkeypatch.setattr(paged_table, "WORKING_SET_STEPS", -1)
    monkeypatch.setattr(paged_table, "_EVERY_STEPS", 1)
    monkeypatch.setattr(PagedTable, "_leave", lambda table, page: (left.append(page), leave(table, page)))
    assert tracked() == wanted
    assert len(left) > 5 * len(frames)


def test_observations_follow_every_change_of_the_readout_time(frames):
    odometry = odometry_after(frames[:20])
    local_map = odometry._map
    observations = np.arange(local_map._observations.size)
    wanted = local_map._measured(observations)
    slope = local_map._observations["slope"][observations]
    assert slope.any()
    for seconds in (0.01, 0.018):
        before, local_map.readout.seconds = local_map.readout.seconds, seconds
        local_map.follow_readout()
        wanted[:, :2] += (seconds - before) * slope
        if seconds == 0.01:  # some of them are read in between
            local_map._measured(observations[::3])
    assert local_map._measured(observations).tobytes() == wanted.tobytes()
    assert local_map._measured(observations).tobytes() == wanted.tobytes()
