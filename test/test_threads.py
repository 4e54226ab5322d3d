"""Work shared among threads that stay."""

import multiprocessing
import threading

import pytest

from cello3d_ros.threads import in_threads


def test_results_are_in_the_order_of_the_parts():
    assert in_threads(lambda k: 2 * k, range(100), 4) == list(range(0, 200, 2))


def test_the_threads_stay():
    for _ in range(3):
        in_threads(lambda k: k, range(10), 2)
    n = threading.active_count()
    for _ in range(20):
        in_threads(lambda k: k, range(10), 2)
    assert threading.active_count() == n


def test_one_thread_or_one_part_is_the_callers():
    own = threading.get_ident()
    for parts, n_threads in ((range(3), 1), (range(1), 4)):
        assert set(in_threads(lambda _: threading.get_ident(), parts, n_threads)) == {own}


def test_a_task_that_shares_its_work_does_not_wait_for_itself():
    inner = in_threads(lambda k: sum(in_threads(lambda i: i * k, range(5), 2)), range(6), 2)
    assert inner == [10 * k for k in range(6)]


def test_an_error_of_a_task_is_the_callers():
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 1 // k, range(3), 2)


def test_when_a_task_raises_no_other_runs_on():
    another, done, both = threading.Event(), [], threading.Barrier(2)

    def task(k):
        if k == 0:
            another.wait(30.0)
            raise ZeroDivisionError
        another.set()
        sum(range(300_000))
        done.append(k)

    with pytest.raises(ZeroDivisionError):
        in_threads(task, range(1000), 2)
    n = len(done)
    in_threads(lambda _: both.wait(30.0), range(2), 2)
    assert 0 < len(done) == n < 999


def _sum_in_threads(queue):
    queue.put(sum(in_threads(lambda k: k, range(10), 2)))


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    in_threads(lambda k: k, range(10), 2)
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_sum_in_threads, args=(queue,), daemon=True)
    child.start()
    child.join(30.0)
    assert child.exitcode == 0
    assert queue.get() == 45
