"""Registration of pairs of frames from guesses that are wrong by known amounts."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from evaluators.compare.config import GuessConfig, TrialsConfig
from evaluators.compare.frames import Moment
from evaluators.compare.methods import Method, reason_of
from mapper.core.geometry import Transform, angle_between, inverse, rotation_exp, transform
from mapper.core.timebase import MAX_TRUTH_GAP_NS, Stamps, nearest
from mapper.core.trajectory import Trajectory
from mapper.registration.base import Alignment, failed

Outcome = Literal["right", "wrong", "none"]
"""What became of a registration: right, wrong but trusted, or no answer."""
NO_GUESS = -1
"""Stands for the guess of a method that has no use for one."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two frames of a log whose true motion is known.

    Attributes:
        number: Counts the pairs; the guesses are drawn by it.
        target: Index of the earlier frame.
        source: Index of the later one.
        T_target_source: (4, 4) true pose of the body at the source in the body at the target.
    """

    number: int
    target: int
    source: int
    T_target_source: Transform


@dataclass(frozen=True, slots=True)
class Trial:
    """One registration of one pair.

    Attributes:
        method: Its name.
        target_ns: Stamp of the target.
        source_ns: Stamp of the source.
        frames_apart: Between the two.
        guess: Which of the configured guesses; ``NO_GUESS`` if the method uses none.
        outcome: What became of it.
        translation_m: Distance from the true position; infinite without an answer.
        rotation_rad: Angle from the true rotation; infinite without an answer.
        prepare_ms: Of the CPU, for the target alone.
        align_ms: The same, for the source.
        reason: Why there is no answer.
    """

    method: str
    target_ns: int
    source_ns: int
    frames_apart: int
    guess: int
    outcome: Outcome
    translation_m: float
    rotation_rad: float
    prepare_ms: float
    align_ms: float
    reason: str


@dataclass(frozen=True, slots=True)
class RegistrationScore:
    """What a method's trials from one kind of guess come to.

    Attributes:
        method: Its name.
        guess: As in :class:`Trial`.
        trials: How many there were.
        right: How many were right.
        wrong: How many were wrong but trusted.
        none: How many gave no answer.
        translation_m: Median and 95th percentile of the right ones' errors; None without any.
        rotation_rad: The same of the angles.
        prepare_ms: Median over all trials.
        align_ms: Median over all trials.
    """

    method: str
    guess: int
    trials: int
    right: int
    wrong: int
    none: int
    translation_m: tuple[float, float] | None
    rotation_rad: tuple[float, float] | None
    prepare_ms: float
    align_ms: float


def pairs_of(stamps_ns: Stamps, truth: Trajectory, *, count: int, frames_apart: Sequence[int]) -> list[Pair]:
    """Return pairs of frames spread evenly over a log, as many of each distance as of the others if it can.

    Args:
        stamps_ns: (N,) stamps of all frames.
        truth: Frames that it does not cover are left out.
        count: How many pairs; all that there are, where the log has fewer.
        frames_apart: The distances; those of which the log has too few pairs leave their share to others.
    """
    index, gap_ns = nearest(truth.stamps_ns, stamps_ns)
    known = gap_ns <= MAX_TRUTH_GAP_NS
    T_truth_body = truth.T_world_body[index]
    starts = {gap: np.flatnonzero(known[:-gap] & known[gap:]) for gap in frames_apart}
    pairs: list[Pair] = []
    for wanted, gap in zip(_shares(count, [len(found) for found in starts.values()]), starts, strict=True):
        spread = np.linspace(0, len(starts[gap]) - 1, wanted).round().astype(int)
        for i in starts[gap][spread].tolist():
            pairs.append(Pair(len(pairs), i, i + gap, inverse(T_truth_body[i]) @ T_truth_body[i + gap]))
    return pairs


def guesses_for(pair: Pair, guesses: Sequence[GuessConfig], *, level: bool, seed: int) -> list[Transform]:
    """Return a guess of each kind: the truth, moved at random by that much at most.

    Distance and angle are drawn evenly from zero to their limits.

    Args:
        pair: With the truth; its number and the seed settle what is drawn.
        guesses: How far off.
        level: Off in x, y and heading only, as for a robot on level ground.
        seed: Of everything random.
    """
    drawn: list[Transform] = []
    for kind, guess in enumerate(guesses):
        rng = np.random.default_rng((seed, pair.number, kind))
        offset_m, turn_rad = guess.offset_m * rng.random(), guess.turn_rad * rng.random()
        direction, axis = rng.standard_normal(3), rng.standard_normal(3)
        if level:
            direction[2], axis = 0.0, np.array([0.0, 0.0, np.sign(axis[2])])
        direction, axis = direction / np.linalg.norm(direction), axis / np.linalg.norm(axis)
        drawn.append(pair.T_target_source @ transform(rotation_exp(turn_rad * axis), offset_m * direction))
    return drawn


def trials_of(
    method: Method,
    pair: Pair,
    moments: tuple[Moment, Moment],
    guesses: Sequence[Transform],
    config: TrialsConfig,
) -> list[Trial]:
    """Register a pair by one method: from every guess, or once if it has no use for them.

    Args:
        method: Which.
        pair: With the truth.
        moments: Target and source.
        guesses: (4, 4) T_target_source of the body.
        config: What counts as right.
    """
    kinds = range(len(guesses)) if method.uses_guess else (NO_GUESS,)
    return [
        _trial(method, pair, moments, kind, np.eye(4) if kind == NO_GUESS else guesses[kind], config)
        for kind in kinds
    ]


def _trial(
    method: Method,
    pair: Pair,
    moments: tuple[Moment, Moment],
    kind: int,
    T_guess: Transform,
    config: TrialsConfig,
) -> Trial:
    target, source = moments
    T_true = pair.T_target_source
    if not method.sees_images:
        T_guess, T_true = target.upright(T_guess), target.upright(T_true)
    began = prepared = time.process_time()
    try:
        aligner = method.registration().prepare(method.view(target))
        prepared = time.process_time()
        alignment = aligner.align(method.view(source), T_guess)
    except Exception as error:  # a library's breakdown is a result, and the other methods go on
        alignment = failed(f"broke down: {reason_of(error)}")
    aligned = time.process_time()
    outcome, translation_m, rotation_rad = judged(alignment, T_true, config)
    return Trial(
        method=method.name,
        target_ns=target.frame.stamp_ns,
        source_ns=source.frame.stamp_ns,
        frames_apart=pair.source - pair.target,
        guess=kind,
        outcome=outcome,
        translation_m=translation_m,
        rotation_rad=rotation_rad,
        prepare_ms=1e3 * (prepared - began),
        align_ms=1e3 * (aligned - prepared),
        reason=alignment.reason,
    )


def judged(
    alignment: Alignment, T_target_source: Transform, config: TrialsConfig
) -> tuple[Outcome, float, float]:
    """Return what an alignment is worth, and how far it is off in metres and radians."""
    if not alignment.converged:
        return "none", np.inf, np.inf
    T_found = alignment.T_target_source
    translation_m = float(np.linalg.norm(T_found[:3, 3] - T_target_source[:3, 3]))
    rotation_rad = angle_between(T_found[:3, :3], T_target_source[:3, :3])
    right = translation_m <= config.max_error_m and rotation_rad <= config.max_error_rad
    return "right" if right else "wrong", translation_m, rotation_rad


def registration_scores(trials: Sequence[Trial]) -> list[RegistrationScore]:
    """Return one score for each method and guess, in the order of their first trials by method."""
    methods = list(dict.fromkeys(trial.method for trial in trials))
    kinds = sorted({(methods.index(trial.method), trial.guess) for trial in trials})
    return [
        _score([trial for trial in trials if (trial.method, trial.guess) == (methods[m], guess)])
        for m, guess in kinds
    ]


def _score(trials: Sequence[Trial]) -> RegistrationScore:
    right = [trial for trial in trials if trial.outcome == "right"]
    outcomes = [trial.outcome for trial in trials]
    return RegistrationScore(
        method=trials[0].method,
        guess=trials[0].guess,
        trials=len(trials),
        right=len(right),
        wrong=outcomes.count("wrong"),
        none=outcomes.count("none"),
        translation_m=_middle_and_tail([trial.translation_m for trial in right]),
        rotation_rad=_middle_and_tail([trial.rotation_rad for trial in right]),
        prepare_ms=float(np.median([trial.prepare_ms for trial in trials])),
        align_ms=float(np.median([trial.align_ms for trial in trials])),
    )


def _middle_and_tail(errors: Sequence[float]) -> tuple[float, float] | None:
    if not errors:
        return None
    median, tail = np.percentile(errors, [50.0, 95.0])
    return float(median), float(tail)


def _shares(count: int, limits: Sequence[int]) -> list[int]:
    """Share a number out evenly, the first get what is left over, and none gets more than its limit."""
    shares = [0] * len(limits)
    for _ in range(min(count, sum(limits))):
        _, least = min((share, k) for k, share in enumerate(shares) if share < limits[k])
        shares[least] += 1
    return shares
