"""Finding of a check."""

from dataclasses import dataclass
from typing import Literal

from mapper.core.errors import DataError

Verdict = Literal["well", "warning", "failed"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes:
        name: Name of the check.
        verdict: "warning" is worth knowing; "failed" keeps some verb from working.
        detail: Result in one line.
        remedy: Instruction to the user; empty when all is well.
    """

    name: str
    verdict: Verdict
    detail: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if (self.verdict == "well") == bool(self.remedy):
            raise DataError(f"{self.name}: verdict {self.verdict!r} with remedy {self.remedy!r}")
