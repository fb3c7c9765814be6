"""The wait for jobs on a cluster, of which some may be cancelled or killed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


@contextmanager
def every_job(lost: Callable[[int, list[str], str], None]) -> Iterator[None]:
    """Let Hydra's launchers for clusters wait for every job, also after one that was killed.

    By themselves they raise at the first job without a result, and the results of the others are
    never seen. Here `lost` is told of such a job: its number, its overrides, and what became of it.
    """
    try:
        from submitit.core.core import Job
        from submitit.core.utils import FailedJobError, UncompletedJobError
    except ImportError:  # there is no launcher for a cluster either
        yield
        return
    results: Any = Job.results

    def patient(job: Any) -> Any:
        try:
            return results(job)
        except (FailedJobError, UncompletedJobError):
            overrides, _, number, *_ = job.submission().args  # as Hydra's launcher hands them over
            lost(number, overrides, f"{job.state}; its log is {job.paths.stderr}")
            return [SimpleNamespace(return_value=None)]  # what Hydra looks at

    setattr(Job, "results", patient)  # noqa: B010
    try:
        yield
    finally:
        setattr(Job, "results", results)  # noqa: B010
