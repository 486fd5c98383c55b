"""Trials: pairs of frames registered from guesses that are wrong by known amounts."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse, rotation_exp, transform
from mapper.core.timebase import MAX_TRUTH_GAP_NS, Stamps, nearest
from mapper.core.trajectory import Trajectory
from mapper.evaluators.compare.config import GuessConfig, TrialsConfig
from mapper.evaluators.compare.methods import Method, PreparedFrame, reason_of
from mapper.evaluators.study.table import Record, Value, column
from mapper.registration.base import Alignment, failed

NO_GUESS = "not used"
"""The guess of a method that does not use one."""


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


def pairs_of(stamps_ns: Stamps, truth: Trajectory, *, count: int, frames_apart: Sequence[int]) -> list[Pair]:
    """Return pairs of frames spread evenly over a log, as many of each distance as of the others if it can.

    Args:
        stamps_ns: (N,) stamps of all frames.
        truth: Frames that it does not cover are left out.
        count: Number of pairs; all that there are, where the log has fewer.
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
        pair: Pair with its true motion; its number and the seed determine what is drawn.
        guesses: Sizes of the guesses' errors.
        level: Off in x, y and heading only, as for a robot on level ground.
        seed: Seed of all that is random.
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
    frames: tuple[PreparedFrame, PreparedFrame],
    guesses: Sequence[Transform],
    config: TrialsConfig,
) -> list[Record]:
    """Register a pair by one method: from every guess, or once if it does not use them.

    Args:
        method: The method.
        pair: Pair with its true motion.
        frames: Target and source.
        guesses: (4, 4) T_target_source of the body, one of each configured kind.
        config: The kinds of guesses, and what counts as right.

    Returns:
        A record for each registration, none of a method that only follows logs. Its errors are None without
        an answer, its times of the CPU.
    """
    if method.registration is None:
        return []
    if not method.uses_guess:
        return [_trial(method, pair, frames, NO_GUESS, np.eye(4), config)]
    kinds = zip(config.guesses, guesses, strict=True)
    return [_trial(method, pair, frames, kind.text, T_guess, config) for kind, T_guess in kinds]


def _trial(
    method: Method,
    pair: Pair,
    frames: tuple[PreparedFrame, PreparedFrame],
    guess: str,
    T_guess: Transform,
    config: TrialsConfig,
) -> Record:
    assert method.registration is not None
    target, source = frames
    T_true = pair.T_target_source
    if not method.sees_images:
        T_guess, T_true = target.upright(T_guess), target.upright(T_true)
    began = prepared = time.process_time()
    try:
        align = method.registration(method.view(target))
        prepared = time.process_time()
        alignment = align(method.view(source), T_guess)
    except Exception as error:  # a library's breakdown is a result, and the other methods go on
        alignment = failed(f"broke down: {reason_of(error)}")
    aligned = time.process_time()
    return {
        "method": method.name,
        "target_ns": target.frame.stamp_ns,
        "source_ns": source.frame.stamp_ns,
        "frames_apart": pair.source - pair.target,
        "guess": guess,
        **outcome_of(alignment, T_true, config),
        "prepare_ms": 1e3 * (prepared - began),
        "align_ms": 1e3 * (aligned - prepared),
        "reason": alignment.reason,
    }


def outcome_of(alignment: Alignment, T_target_source: Transform, config: TrialsConfig) -> dict[str, Value]:
    """Return the outcome of an alignment, right, wrong or none, and its errors in metres and radians."""
    if not alignment.converged:
        return {"outcome": "none", "translation_m": None, "rotation_rad": None}
    T_found = alignment.T_target_source
    translation_m = float(np.linalg.norm(T_found[:3, 3] - T_target_source[:3, 3]))
    rotation_rad = angle_between(T_found[:3, :3], T_target_source[:3, :3])
    right = translation_m <= config.max_error_m and rotation_rad <= config.max_error_rad
    errors = {"translation_m": translation_m, "rotation_rad": rotation_rad}
    known = {key: error if math.isfinite(error) else None for key, error in errors.items()}
    return {"outcome": "right" if right else "wrong", **known}


def registration_records(trials: Sequence[Record]) -> list[Record]:
    """Return one record for each method and kind of guess, in the order of the methods' first trials."""
    methods = dict.fromkeys(trial["method"] for trial in trials)
    guesses = dict.fromkeys(trial["guess"] for trial in trials)
    groups = {
        (method, guess): [trial for trial in trials if (trial["method"], trial["guess"]) == (method, guess)]
        for method in methods
        for guess in guesses
    }
    return [_summary(group) for group in groups.values() if group]


def _summary(trials: Sequence[Record]) -> Record:
    """Return how often a method was right from one kind of guess, and the errors of its right answers."""
    outcomes = [trial["outcome"] for trial in trials]
    right = [trial for trial in trials if trial["outcome"] == "right"]
    median_m, tail_m = _middle_and_tail(right, "translation_m")
    median_rad, tail_rad = _middle_and_tail(right, "rotation_rad")
    return {
        "method": trials[0]["method"],
        "guess_off_by": trials[0]["guess"],
        "trials": len(trials),
        "right": len(right),
        "wrong": outcomes.count("wrong"),
        "no_answer": outcomes.count("none"),
        "right_ratio": len(right) / len(trials),
        "median_m": median_m,
        "p95_m": tail_m,
        "median_rad": median_rad,
        "p95_rad": tail_rad,
        "prepare_ms": float(np.median(column(trials, "prepare_ms"))),
        "align_ms": float(np.median(column(trials, "align_ms"))),
    }


def _middle_and_tail(trials: Sequence[Record], key: str) -> tuple[float, float] | tuple[None, None]:
    if not trials:
        return None, None
    median, tail = np.percentile(column(trials, key), [50.0, 95.0])
    return float(median), float(tail)


def _shares(count: int, limits: Sequence[int]) -> list[int]:
    """Share a number out evenly, the first get what is left over, and none gets more than its limit."""
    shares = [0] * len(limits)
    for _ in range(min(count, sum(limits))):
        _, least = min((share, k) for k, share in enumerate(shares) if share < limits[k])
        shares[least] += 1
    return shares
