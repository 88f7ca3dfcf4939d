"""When each sound of a transcript is heard in a recording: a hidden Markov model and the Viterbi path through it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uika.motion.motion import MotionError
from uika.motion.phonemes import GAP, KIND, PAUSE, seconds_of
from uika.motion.sound_features import HOP, Features

# (loudness, hiss) of a kind of sound: means and standard deviations in dB.
_SOUNDS = {
    "silence": ((-45.0, -5.0), (9.0, 15.0)),
    "vowel": ((-5.0, -28.0), (6.0, 10.0)),
    "nasal": ((-11.0, -32.0), (6.0, 9.0)),
    "liquid": ((-9.0, -28.0), (7.0, 10.0)),
    "stop": ((-25.0, -8.0), (12.0, 15.0)),
    "voiced_stop": ((-17.0, -22.0), (9.0, 13.0)),
    "sibilant": ((-16.0, 12.0), (8.0, 9.0)),
    "voiced_sibilant": ((-16.0, 2.0), (8.0, 12.0)),
    "weak_fricative": ((-24.0, -3.0), (9.0, 12.0)),
    "voiced_fricative": ((-15.0, -20.0), (8.0, 13.0)),
}
_LOUDEST, _QUIETEST = 6.0, -70.0  # dB; beyond, how loud a frame is says no more
_STATES = 2  # frames that a sound lasts at least
_FASTEST, _SLOWEST = 32.0, 2.0  # sounds in a second of speech
_SPOKEN = -30.0  # dB


class Phone(NamedTuple):
    """One sound of the transcript in time."""

    symbol: str  # IPA, or PAUSE
    start: float  # seconds
    end: float


def align(symbols: list[str], heard: Features) -> list[Phone]:
    """The sounds of a transcript (`phonemes`) in a recording, in order and without holes; pauses are found.

    Each sound is a chain of states whose frames are normally distributed in loudness and hiss and that last as long as
    such sounds do on average; between words, and at both ends, silence may lie.

    Raises:
        MotionError: there are more sounds, or fewer, than anybody says in this time.
    """
    spoken = [PAUSE, *symbols, PAUSE]
    count = sum(symbol in KIND for symbol in spoken)
    voiced = HOP * max(1, int((heard.loudness > _SPOKEN).sum()))
    if not _SLOWEST < count / voiced < _FASTEST:
        raise MotionError(
            f"the transcript does not fit the recording: {count} sounds in {voiced:.1f} s of speech; "
            "give the words that are spoken, or leave the transcript out"
        )
    chain = [(i, k) for i, symbol in enumerate(spoken) for k in range(1 if symbol in (GAP, PAUSE) else _STATES)]
    owner = np.array([i for i, _ in chain])
    silent = np.array([spoken[i] in (GAP, PAUSE) for i in owner])
    path = _viterbi(_scores(heard)[:, _kinds(spoken)[owner]], *_transitions(spoken, owner), silent)
    found = owner[path]
    edges = np.flatnonzero(np.diff(found, prepend=-1))
    ends = np.append(edges[1:], len(found))
    return [
        Phone(PAUSE if spoken[found[a]] == GAP else spoken[found[a]], a * HOP, b * HOP)
        for a, b in zip(edges.tolist(), ends.tolist(), strict=True)
    ]


def estimated(symbols: list[str]) -> list[Phone]:
    """The sounds of a text in time without a recording, each as long as on average."""
    time, result = 0.0, []
    for symbol in (PAUSE, *symbols, PAUSE):
        if symbol != GAP:
            result.append(Phone(symbol, time, time + seconds_of(symbol)))
            time = result[-1].end
    return result


def _kinds(spoken: list[str]) -> NDArray[np.int64]:
    names = list(_SOUNDS)
    return np.array([names.index(KIND.get(symbol, "silence")) for symbol in spoken])


def _scores(heard: Features) -> NDArray[np.float64]:
    """Log likelihood [T, kinds] of each frame."""
    seen = np.stack((heard.loudness.clip(_QUIETEST, _LOUDEST), heard.hiss), -1)[:, None]
    mean, spread = (np.array([pair[k] for pair in _SOUNDS.values()]) for k in range(2))
    return -0.5 * (((seen - mean) / spread) ** 2).sum(-1) - np.log(spread).sum(-1)


def _transitions(spoken: list[str], owner: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log probabilities [S] of staying in a state and of leaving it, from the mean durations."""
    mean = np.array([max(seconds_of(s), 0.03) / HOP for s in spoken])[owner]
    states = np.array([1 if s in (GAP, PAUSE) else _STATES for s in spoken])[owner]
    stay = 1 - states / np.maximum(mean, states + 0.5)
    return np.log(stay), np.log1p(-stay)


def _viterbi(
    scores: NDArray[np.float64], stay: NDArray[np.float64], leave: NDArray[np.float64], silent: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The likeliest states [T] from the first to the last of a chain in which silent states may be jumped over."""
    T, S = scores.shape
    steps = np.zeros((T, S), np.int8)  # how many states back the best predecessor lies
    best = np.full(S, -np.inf)
    best[: 1 + int(silent[0])] = scores[0, : 1 + int(silent[0])]
    jump = np.full(S, -np.inf)
    jump[2:] = np.where(silent[1:-1], 0.0, -np.inf)
    for t in range(1, T):
        left = best + leave
        options = np.full((3, S), -np.inf)
        options[0] = best + stay
        options[1, 1:] = left[:-1]
        options[2, 2:] = left[:-2] + jump[2:]
        steps[t] = options.argmax(0)
        best = options.max(0) + scores[t]
    state: int = S - 1 if best[S - 1] >= best[S - 2] or not silent[-1] else S - 2
    if not np.isfinite(best[state]):
        raise MotionError("the transcript does not fit the recording: it has more sounds than the recording has time")
    path = np.empty(T, np.int64)
    for t in range(T - 1, -1, -1):
        path[t] = state
        state -= int(steps[t, state])
    return path
