"""A loop detector's searches repeated from what they have found."""

from types import SimpleNamespace

import pytest

from mapper.core.errors import FrameError
from mapper.loops.base import Verification
from mapper.loops.verification_log import VerificationLog


class CountingVerifier:
    def __init__(self):
        self.described = self.verified = 0

    def describe(self, seen):
        self.described += 1
        return SimpleNamespace(stamp_ns=seen)

    def verify(self, i, j):
        self.verified += 1
        return Verification(i.stamp_ns + j.stamp_ns, "")


def test_a_repeated_search_costs_nothing_and_finds_the_same():
    verifier = CountingVerifier()
    log = VerificationLog(verifier)
    first, second = log.describe(1), log.describe(2)
    found = log.verify(first, second)
    search = log.take()
    assert log.take().place is None

    log.repeat(search)
    assert log.view() is log.describe(None) is second
    assert log.verify(first, second) is found
    assert (verifier.described, verifier.verified) == (2, 1)

    log.repeat(None)
    log.verify(second, log.describe(3))
    assert (verifier.described, verifier.verified) == (3, 2)


def test_a_frame_that_could_not_be_read_cannot_be_read_again():
    log = VerificationLog(CountingVerifier())
    log.repeat(log.take())
    with pytest.raises(FrameError):
        log.view()
