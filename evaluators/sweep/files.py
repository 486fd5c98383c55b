"""Files of a sweep: the table for programs, and the page for people."""

from collections.abc import Mapping

from mapper.evaluators.sweep.page import page_of
from mapper.evaluators.sweep.plan import BuildName, Plan
from mapper.evaluators.sweep.tables import sweep_records
from mapper.evaluators.tables.parquet import write_parquet
from mapper.evaluators.tables.table import Record, csv_text
from mapper.runtime.atomic import write_text
from mapper.runtime.resumable_jobs import JobResult

FILES = CSV, PARQUET, PAGE = "results.csv", "results.parquet", "summary.html"


def write_sweep(plan: Plan, results: Mapping[BuildName, JobResult], *, title: str) -> list[Record]:
    """Write a sweep's table and its page, and return the table.

    Args:
        plan: The builds, and the folder of their results.
        results: Results of the builds.
        title: Title of the page.
    """
    records = sweep_records(plan, results)
    write_text(plan.out / CSV, csv_text(records))
    write_parquet(plan.out / PARQUET, records)
    write_text(plan.out / PAGE, page_of(plan, records, title=title))
    return records
