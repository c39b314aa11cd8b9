"""What pairs of landmarks propose, compiled: turns of their arm patterns, rotations, whole transformations.

Import through `mapfuse.datasets.compiled.kernels` only. Arrays are C-contiguous float64, int32 or int8.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import kernel

TWO_PI = 2 * np.pi
ARM = np.pi / 6  # `mapfuse.datasets.arms.ARM_TOLERANCE`
MAX_TURNS = 4
ROTATION_BINS = 180


@kernel
def _wrap(angle):
    return angle - TWO_PI * np.floor(angle / TWO_PI + 0.5)


@kernel
def turns_of_patterns(arms1, open1, label1, arms2, open2, label2):
    """Turns of every pair of patterns: how many (p1, p2), and their offsets (p1, p2, MAX_TURNS) [rad].

    A landmark of pattern a turned by ``heading1 - heading2 + offset`` lies on one of pattern b with all arms that meet
    agreeing, as `mapfuse.datasets.arms.turns` has it; without arms by its heading alone.
    """
    n1, n2 = len(label1), len(label2)
    count = np.zeros((n1, n2), dtype=np.int32)
    offset = np.zeros((n1, n2, MAX_TURNS))
    k1, k2 = arms1.shape[1], arms2.shape[1]
    for a in range(n1):
        for b in range(n2):
            if label1[a] != label2[b]:
                continue
            if open1[a].max() < 0 or open2[b].max() < 0:
                count[a, b] = 1
                continue
            most, n = 0, 0
            for m1 in range(k1):
                for m2 in range(k2):
                    if open1[a, m1] < 0 or open2[b, m2] < 0:
                        continue
                    rotation = arms1[a, m1] - arms2[b, m2]
                    same, against, shift = 0, 0, 0.0
                    for q2 in range(k2):
                        if open2[b, q2] < 0:
                            continue
                        nearest, least = -1, ARM
                        for q1 in range(k1):
                            if open1[a, q1] >= 0:
                                off = abs(_wrap(arms2[b, q2] + rotation - arms1[a, q1]))
                                if off < least:
                                    nearest, least = q1, off
                        if nearest >= 0:
                            shift += _wrap(arms1[a, nearest] - arms2[b, q2] - rotation)
                            if open1[a, nearest] == open2[b, q2]:
                                same += 1
                            else:
                                against += 1
                    if against > 0 or same == 0 or same < most:
                        continue
                    rotation = _wrap(rotation + shift / same)
                    if same > most:
                        most, n = same, 0
                    known = n >= MAX_TURNS
                    for t in range(n):
                        known = known or abs(_wrap(rotation - offset[a, b, t])) < ARM
                    if not known:
                        offset[a, b, n] = rotation
                        n += 1
            count[a, b] = n
    return count, offset


@kernel
def votes_of_patterns(start1, count):
    """How many votes a landmark of each pattern of map 2 casts (p2,)."""
    votes = np.zeros(count.shape[1], dtype=np.int64)
    for a in range(count.shape[0]):
        for b in range(count.shape[1]):
            votes[b] += count[a, b] * (start1[a + 1] - start1[a])
    return votes


@kernel
def rotations(start1, heading1, pattern2, heading2, count, offset):
    """How often pairs propose each rotation: votes (ROTATION_BINS,) over the full turn."""
    scale = ROTATION_BINS / TWO_PI
    of_pattern = np.zeros((len(start1) - 1, ROTATION_BINS))
    for a in range(len(start1) - 1):
        for k in range(start1[a], start1[a + 1]):
            of_pattern[a, int(np.floor(heading1[k] * scale)) % ROTATION_BINS] += 1
    votes = np.zeros(ROTATION_BINS)
    for j in range(len(pattern2)):
        b = pattern2[j]
        for a in range(len(start1) - 1):
            few = start1[a + 1] - start1[a] < ROTATION_BINS
            for t in range(count[a, b]):
                turn = offset[a, b, t] - heading2[j]
                if few:
                    for k in range(start1[a], start1[a + 1]):
                        votes[int(np.floor((heading1[k] + turn) * scale)) % ROTATION_BINS] += 1
                else:
                    shift = int(np.floor(turn * scale + 0.5))
                    for k in range(ROTATION_BINS):
                        votes[(k + shift) % ROTATION_BINS] += of_pattern[a, k]
    return votes


@kernel
def strongest_rotations(votes, reach, limit):
    """Peaks of a histogram over the circle, strongest first, in bins, until 98 % are within ``reach`` of one.

    The middle of a plateau counts as its peak. Votes are whole numbers.
    """
    n = len(votes)
    left, within = votes.copy(), np.zeros(n)
    centres = np.zeros(limit)
    remain = np.sum(votes)
    enough = 0.02 * remain
    found = 0
    while found < limit:
        best, k = -1.0, 0
        for b in range(n):
            total = 0.0
            for d in range(-reach, reach + 1):
                total += left[(b + d) % n]
            within[b] = total
            if total > best:
                best, k = total, b
        if best <= 0 or (found > 0 and remain <= enough):
            break
        shift, equal = 0, 0
        for b in range(n):
            if within[b] >= best * (1 - 1e-12):
                shift += (b - k + n // 2) % n - n // 2
                equal += 1
        plateau = shift / equal
        if abs(plateau) <= reach:
            k = int(np.rint(k + plateau)) % n
        total, moment = 0.0, 0.0
        for d in range(-reach, reach + 1):
            b = (k + d) % n
            total += left[b]
            moment += left[b] * d
            remain -= left[b]
            left[b] = 0.0
        centres[found] = k + 0.5 + (moment / total if total > 0 else 0.0)
        found += 1
    return centres[:found]


@kernel
def all_turns(members1, start1, heading1, members2, pattern2, heading2, count, offset, xy1, xy2, total):
    """Every T12 (total, 3) that a pair of landmarks proposes, and the pair's places (total, 2)."""
    T12s = np.zeros((total, 3))
    pair = np.zeros((total, 2), dtype=np.int32)
    n = 0
    for j in range(len(pattern2)):
        x2, y2 = xy2[members2[j], 0], xy2[members2[j], 1]
        b = pattern2[j]
        for a in range(len(start1) - 1):
            for t in range(count[a, b]):
                for k in range(start1[a], start1[a + 1]):
                    theta = _wrap(heading1[k] - heading2[j] + offset[a, b, t])
                    c, s = np.cos(theta), np.sin(theta)
                    i = members1[k]
                    T12s[n, 0] = xy1[i, 0] - c * x2 + s * y2
                    T12s[n, 1] = xy1[i, 1] - s * x2 - c * y2
                    T12s[n, 2] = theta
                    pair[n, 0], pair[n, 1] = i, members2[j]
                    n += 1
    return T12s[:n], pair[:n]
