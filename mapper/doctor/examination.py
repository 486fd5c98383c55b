"""All checks of the examination, in the order in which they are reported."""

from collections.abc import Callable

from mapper.doctor import machine
from mapper.doctor.finding import Finding
from mapper.doctor.libraries import Requirement, check_library, requirements
from mapper.doctor.self_tests import SELF_TESTS
from mapper.doctor.system_libraries import check_system_libraries
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress

_MACHINE: tuple[Callable[[], Finding], ...] = (
    machine.check_python,
    machine.check_glibc,
    machine.check_threads,
    machine.check_memory,
    machine.check_disk,
    machine.check_kernels,
    machine.check_bytecode,
    check_system_libraries,
)


def examine(*, progress: Progress = SILENT) -> list[Finding]:
    """Check the machine, then try every library in a process of its own, one per processor at a time."""
    wanted = requirements()
    findings = [look() for look in _MACHINE]
    with progress.stage("try") as report:
        tried = ordered_map(
            lambda name: check_library(name, wanted.get(name, Requirement())),
            SELF_TESTS,
            workers=machine.processors(),
        )
        for done, finding in enumerate(tried, start=1):
            findings.append(finding)
            report(done, len(SELF_TESTS))
    return findings
