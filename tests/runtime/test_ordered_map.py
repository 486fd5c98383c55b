import threading

import pytest

from mapper.runtime.ordered_map import ordered_map


@pytest.mark.parametrize("workers", [0, 1, 3])
@pytest.mark.parametrize("ahead", [1, 4, 100])
def test_results_come_in_order_whatever_the_number_of_workers(workers, ahead):
    assert list(ordered_map(lambda x: x * x, range(50), workers=workers, ahead=ahead)) == [
        x * x for x in range(50)
    ]
    assert list(ordered_map(str, [], workers=workers, ahead=ahead)) == []


def test_a_slow_item_does_not_let_later_ones_overtake():
    may_finish = threading.Event()

    def work(x):
        if x == 0:
            assert may_finish.wait(timeout=10)
        else:
            may_finish.set()
        return x

    assert list(ordered_map(work, range(5), workers=2)) == [0, 1, 2, 3, 4]


def test_never_takes_more_than_it_was_told_to_hold():
    taken = []

    def items():
        for i in range(100):
            taken.append(i)
            yield i

    results = ordered_map(lambda x: x, items(), workers=2, ahead=5)
    for done in range(1, 21):
        next(results)
        assert len(taken) <= done + 5
    results.close()
    assert len(taken) <= 25


@pytest.mark.parametrize("workers", [0, 2])
def test_an_exception_surfaces_where_its_result_would(workers):
    def work(x):
        if x == 3:
            raise ValueError("three")
        return x

    results = ordered_map(work, range(10), workers=workers, ahead=8)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)


def test_stopping_early_leaves_no_thread_behind():
    before = threading.active_count()
    results = ordered_map(lambda x: x, range(1000), workers=3)
    next(results)
    results.close()
    assert threading.active_count() == before


def test_works_in_other_threads_than_the_callers():
    names = set(ordered_map(lambda _: threading.current_thread().name, range(20), workers=2))
    assert threading.current_thread().name not in names
    assert set(ordered_map(lambda _: threading.current_thread().name, range(3), workers=0)) == {
        threading.current_thread().name
    }
