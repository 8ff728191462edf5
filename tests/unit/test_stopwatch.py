import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import pytest

from asia._timer import Activity, ActivityTimer, TimeSpent


def wall(spent: Sequence[TimeSpent]) -> dict[Activity, float]:
    return {one.activity: one.wall for one in spent}


def adding(
    activity: Activity, seconds: float, processor: float = 0.0
) -> Callable[[ActivityTimer], None]:
    return lambda watch: watch.add(activity, seconds, processor)


def test_what_is_inside_another_activity_counts_once() -> None:
    watch = ActivityTimer()
    with watch.activity(Activity.AGENT):
        watch.add(Activity.LEDGER, 1000.0, 0.0)
    found = wall(watch.take())
    assert found[Activity.LEDGER] == 1000.0
    assert found.get(Activity.AGENT, 0.0) == 0.0  # shorter than what was measured inside


def test_an_activity_swallows_what_happens_in_it() -> None:
    watch = ActivityTimer()
    with watch.activity(Activity.CHECKS, swallows=True), watch.activity(Activity.SCORE):
        watch.add(Activity.FIT, 3.0, 2.0)
    found = watch.take()
    assert {one.activity for one in found} <= {Activity.CHECKS, Activity.OTHER}
    assert next(one for one in found if one.activity is Activity.CHECKS).processor >= 2.0


def test_the_thread_that_ends_last_gives_the_wall_and_all_give_the_processor() -> None:
    watch = ActivityTimer()
    first_has_ended, both_run = threading.Event(), threading.Barrier(2)

    def first() -> None:
        both_run.wait(60)
        watch.add(Activity.FIT, 5.0, 4.0)

    def last() -> None:
        both_run.wait(60)
        first_has_ended.wait(60)
        watch.add(Activity.SIMULATE, 7.0, 1.0)

    def run(jobs: Sequence[Callable[[], None]]) -> list[None]:
        with ThreadPoolExecutor(2) as pool:
            futures = [pool.submit(job) for job in jobs]
            futures[0].result()
            time.sleep(0.01)
            first_has_ended.set()
            return [future.result() for future in futures]

    watch.run(run, [first, last])
    found = {one.activity: one for one in watch.take()}
    assert found[Activity.FIT] == TimeSpent(Activity.FIT, 0.0, 4.0)
    assert (found[Activity.SIMULATE].wall, found[Activity.SIMULATE].processor) == (7.0, 1.0)


def test_jobs_that_fail_count_too() -> None:
    watch = ActivityTimer()

    def fails() -> None:
        watch.add(Activity.FIT, 2.0, 1.0)
        raise ValueError("it failed")

    with pytest.raises(ValueError, match="it failed"):
        watch.run(lambda jobs: [job() for job in jobs], [fails])
    assert wall(watch.take())[Activity.FIT] == 2.0


def test_a_thread_that_runs_no_job_changes_nothing() -> None:
    watch = ActivityTimer()
    thread = threading.Thread(target=adding(Activity.AGENT, 9.0), args=(watch,))
    thread.start()
    thread.join()
    assert Activity.AGENT not in wall(watch.take())


def test_what_is_taken_is_gone() -> None:
    watch = ActivityTimer()
    watch.add(Activity.FIT, 2.0, 1.0)
    assert Activity.FIT in wall(watch.take())
    assert Activity.FIT not in wall(watch.take())
