"""Verdict on a run: trusted, doubtful, or broken in parts, by its warnings."""

from collections.abc import Sequence

from mapper.run.manifest import RunWarning, Trial, Verdict

TRACKING_KINDS = frozenset({"lost", "doubtful"})
"""Kinds of warnings that other settings of the odometry may mend."""


def verdict_of(warnings: Sequence[RunWarning], trial: Trial | None = None) -> Verdict:
    """Return the verdict: the heaviest weight of any warning, and the sentences that weigh more than a note.

    Args:
        warnings: Warnings from ``find_warnings``.
        trial: Result of the trial of other settings, which is suggested for lost and doubtful frames.
    """
    heavy = [with_trial(warning, trial) for warning in warnings if warning.weight != "note"]
    weights = {warning.weight for warning in heavy}
    state = "broken in parts" if "break" in weights else "doubtful" if "doubt" in weights else "trusted"
    return Verdict(state=state, sentences=tuple(warning.text for warning in heavy))


def with_trial(warning: RunWarning, trial: Trial | None) -> RunWarning:
    """Return the warning with what a trial found as its suggestion, if it is one of tracking without any.

    Where surfaces do not show a motion, no setting does.
    """
    if trial is None or warning.suggestion or warning.kind not in TRACKING_KINDS or warning.weight == "note":
        return warning
    return warning.model_copy(update={"suggestion": trial.text})
