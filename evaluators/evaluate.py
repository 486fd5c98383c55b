"""Everything worth telling about one trajectory, with truth or without."""

from evaluators.metric import Metric
from evaluators.trajectory import AlignmentKind, Matched, align, associate, ate, rpe, start_end_offset
from mapper.trajectory import Trajectory

ALIGNED = {"none": "not aligned", "se3": "SE(3)-aligned", "sim3": "Sim(3)-aligned"}


def evaluate(
    estimate: Trajectory,
    truth: Trajectory | None,
    *,
    alignment: AlignmentKind = "se3",
    max_gap_s: float = 0.02,
    names: tuple[str, str] = ("the estimate", "the truth"),
) -> list[Metric]:
    """Return path length and start-to-end offset, and with truth ATE and RPE as well.

    The names state the alignment. RPE compares consecutive matched poses.

    Args:
        estimate: What is judged.
        truth: Where the body really was, or None if nobody knows.
        alignment: How the estimate is laid over the truth first.
        max_gap_s: Largest time between an estimated pose and its true one.
        names: What to call the two in an error, for instance their file names.

    Raises:
        DataError: The estimate is empty, no stamps match, or too few do.
    """
    offset = start_end_offset(estimate)
    own = [
        Metric("path length", estimate.path_length_m, "m"),
        Metric("start-to-end offset", offset.translation_m, "m"),
        Metric("start-to-end rotation", offset.rotation_rad, "rad"),
    ]
    if truth is None:
        return own
    matched = associate(estimate, truth, max_gap_s=max_gap_s, names=names)
    return [*_against_truth(matched, alignment), *own]


def _against_truth(matched: Matched, alignment: AlignmentKind) -> list[Metric]:
    similarity = align(matched, alignment)
    aligned = similarity.moved(matched)
    position, steps = ate(aligned), rpe(aligned)
    how = ALIGNED[alignment]
    metrics = [
        Metric("matched poses", len(matched), "pairs"),
        Metric(f"ATE RMSE, {how}", position.rmse, "m"),
        Metric(f"ATE mean, {how}", position.mean, "m"),
        Metric(f"ATE median, {how}", position.median, "m"),
        Metric(f"ATE std, {how}", position.std, "m"),
        Metric(f"ATE min, {how}", position.min, "m"),
        Metric(f"ATE max, {how}", position.max, "m"),
        Metric("RPE translation RMSE, consecutive", steps.translation_m.rmse, "m"),
        Metric("RPE rotation RMSE, consecutive", steps.rotation_rad.rmse, "rad"),
    ]
    if alignment == "sim3":
        metrics.append(Metric("scale of the estimate", similarity.scale, "×"))
    return metrics
