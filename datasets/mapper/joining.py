"""Landmarks and their arms: ids, directions, what a sighting adds, and two landmarks that become one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ..logs import SensedArm
from ..maps import LinkType
from .association import overlay, wrap_any
from .config import MapperConfig
from .memory import Arm, Known, Memory

#: A landmark keeps at most so many arms, false ones among them; a map shows the four best.
MAX_ARMS = 8


def landmark_id(landmark: Known) -> str:
    """Id in the map: the name that detections carry, else type and number."""
    return landmark.name if landmark.name is not None else f"{landmark.type}-{landmark.key}"


def direction_of(landmark: Known, towards: ArrayLike) -> float:
    """Direction [rad] of a landmark whose arms point ``towards`` (k,) [rad]: the mean of what each says."""
    angles = np.asarray(towards, dtype=float)
    off = np.array([arm.off for arm in landmark.arms])
    first = float(angles[0] - off[0])
    return first + float(np.mean([wrap_any(float(a - o) - first) for a, o in zip(angles, off, strict=True)]))


def add_arms(
    landmark: Known, sensed: Sequence[SensedArm], direction: float, config: MapperConfig
) -> list[tuple[int, float]]:
    """Add what was sensed to a landmark that faces ``direction`` [rad, from the robot]: (its arm, bearing) of each."""
    on = overlay(landmark.arms, sensed, direction, config)
    out: list[tuple[int, float]] = []
    for m, j in on.pairs:
        arm = landmark.arms[m]
        off = wrap_any(sensed[j].bearing - direction - arm.off) - on.residual
        arm.off += off / (arm.count + 1)
        out.append((m, sensed[j].bearing))
        _vote(arm, sensed[j].type)
    met = {j for _, j in on.pairs}
    for j, reading in enumerate(sensed):
        off = wrap_any(reading.bearing - direction)
        apart = all(abs(wrap_any(off - arm.off)) > config.arm_tolerance for arm in landmark.arms)
        if j not in met and apart and len(landmark.arms) < MAX_ARMS:
            landmark.arms.append(Arm(off, 0, {}))
            _vote(landmark.arms[-1], reading.type)
            out.append((len(landmark.arms) - 1, reading.bearing))
    return out


def _vote(arm: Arm, type_: LinkType) -> None:
    arm.count += 1
    arm.votes[type_] = arm.votes.get(type_, 0) + 1


def copied(landmark: Known) -> Known:
    """A landmark that can be changed without the other."""
    return msgspec.structs.replace(
        landmark,
        arms=[Arm(arm.off, arm.count, dict(arm.votes)) for arm in landmark.arms],
        sightings=list(landmark.sightings),
    )


def joined(
    landmarks: Mapping[int, Known],
    memory: Memory,
    pairs: Sequence[tuple[int, int]],
    config: MapperConfig,
    directions: Mapping[int, float],
) -> tuple[dict[int, Known], Memory]:
    """Landmarks and memory after each first one of ``pairs`` has become the second; the given ones stay as they are.

    ``directions`` [rad]: of each landmark that has arms.
    """
    new = {key: copied(landmark) for key, landmark in landmarks.items()}
    sightings = list(memory.sightings)
    for a, b in pairs:
        gone, kept = new.pop(a), new[b]
        if gone.turn is not None and kept.turn is None:
            kept.turn, kept.arms = gone.turn, gone.arms
            of_arm = list(range(len(gone.arms)))
        elif gone.turn is not None:
            of_arm = _merge_arms(kept, gone, directions[a] - directions[b], config)
        else:
            of_arm = []
        for k in gone.sightings:
            arms = [(of_arm[m], bearing) for m, bearing in sightings[k].arms]
            sightings[k] = msgspec.structs.replace(sightings[k], landmark=b, arms=_once(arms))
        kept.sightings = sorted([*kept.sightings, *gone.sightings])
        kept.first, kept.last = min(kept.first, gone.first), max(kept.last, gone.last)
        kept.name = kept.name if kept.name is not None else gone.name
    return new, msgspec.structs.replace(memory, sightings=sightings)


def _once(arms: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """No arm twice in one sighting: two arms of one landmark may be one of the other's."""
    first: dict[int, float] = {}
    for m, bearing in arms:
        first.setdefault(m, bearing)
    return list(first.items())


def _merge_arms(kept: Known, gone: Known, turn: float, config: MapperConfig) -> list[int]:
    """Arms of ``gone``, which faces ``turn`` [rad] from ``kept``, added to those of ``kept``; where each went."""
    sensed = [SensedArm(arm.type, arm.off + turn) for arm in gone.arms]
    on = overlay(kept.arms, sensed, 0.0, config)
    place = {j: m for m, j in on.pairs}
    for j, arm in enumerate(gone.arms):
        off = wrap_any(arm.off + turn - on.residual)
        if j not in place:
            near = [abs(wrap_any(off - own.off)) for own in kept.arms]
            if min(near) < config.arm_tolerance or len(kept.arms) >= MAX_ARMS:
                place[j] = near.index(min(near))
            else:
                place[j] = len(kept.arms)
                kept.arms.append(Arm(off, 0, {}))
        own = kept.arms[place[j]]
        own.count += arm.count
        for name, n in arm.votes.items():
            own.votes[name] = own.votes.get(name, 0) + n
    return [place[j] for j in range(len(gone.arms))]
