"""What odometry, gyroscope, compass and range scans say of a drive: rows 1 to 5 and 11 of ``docs/log-model.md``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import Compass, Gyro, Odometry, Scan, Sensors
from .building import Building
from .drive import Drive
from .robots import Driving

Array = NDArray[np.float64]

#: Numbers of a log are written with so many decimals: micrometres and microradians, far below every error.
DECIMALS = 6


@dataclass(frozen=True, slots=True)
class Systematic:
    """What is constant over a log: ``scale``, ``turn``, ``curve`` [rad/m], ``bias`` [rad/s], ``offset`` [rad]."""

    scale: float
    turn: float
    curve: float
    bias: float
    offset: float


def draw_systematic(sensors: Sensors, rng: np.random.Generator) -> Systematic:
    """The systematic errors of one log; the compass's ``offset`` any direction where its sigma is None."""
    scale, turn, curve, bias, offset = rng.normal(size=5)
    anywhere = rng.uniform(-np.pi, np.pi)
    return Systematic(
        scale * sensors.odometry_scale_sigma,
        turn * sensors.odometry_turn_scale_sigma,
        curve * sensors.odometry_curve_sigma,
        bias * sensors.gyro_bias_sigma,
        anywhere if sensors.compass_offset_sigma is None else offset * sensors.compass_offset_sigma,
    )


def odometry(driven: Drive, sensors: Sensors, systematic: Systematic, rng: np.random.Generator) -> list[Odometry]:
    """A pose by dead reckoning at each of the drive's times, from the origin (rows 1 to 3)."""
    forward, left, turn = driven.steps().T
    length = np.hypot(forward, left)
    distance_error, turn_error = rng.normal(size=(2, len(turn)))
    distance_error *= sensors.odometry_distance_sigma * np.sqrt(length)
    turn_error *= np.sqrt(
        sensors.odometry_turn_sigma**2 * length + sensors.odometry_turn_sigma_per_turn**2 * np.abs(turn)
    )
    D = (forward - distance_error) / (1 + systematic.scale)
    E = left / (1 + systematic.scale)
    W = (turn - turn_error - systematic.curve * D) / (1 + systematic.turn)
    theta = np.concatenate([[0.0], np.cumsum(W)])
    half = theta[:-1] + W / 2
    x = np.concatenate([[0.0], np.cumsum(np.cos(half) * D - np.sin(half) * E)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(half) * D + np.cos(half) * E)])
    rows = np.column_stack([driven.t, x, y, theta]).round(DECIMALS)
    return [Odometry(*row) for row in rows.tolist()]


def gyro(driven: Drive, sensors: Sensors, systematic: Systematic, rng: np.random.Generator) -> list[Gyro]:
    """The turning rate until the next reading at each time but the last (row 4); none without a gyroscope."""
    if sensors.gyro_sigma is None:
        return []
    time = np.diff(driven.t)
    rate = np.diff(driven.poses[:, 2]) / time + systematic.bias
    rate += rng.normal(size=len(rate)) * sensors.gyro_sigma / np.sqrt(time)
    return [Gyro(*row) for row in np.column_stack([driven.t[:-1], rate]).round(DECIMALS).tolist()]


def compass(
    building: Building,
    driven: Drive,
    sensors: Sensors,
    systematic: Systematic,
    every: int,
    rng: np.random.Generator,
) -> list[Compass]:
    """A reading at ``every``-th time (row 5); none without a compass."""
    if sensors.compass_sigma is None:
        return []
    t, poses = driven.t[::every], driven.poses[::every]
    heading = poses[:, 2] - building.floor.north - systematic.offset - building.bend(poses[:, :2])
    heading = se2.wrap(heading + rng.normal(size=len(t)) * sensors.compass_sigma)
    return [Compass(*row) for row in np.column_stack([t, heading]).round(DECIMALS).tolist()]


def scans(
    building: Building, driven: Drive, sensors: Sensors, driving: Driving, rng: np.random.Generator
) -> list[Scan]:
    """A scan at every ``driving.scan_every``-th time (row 11)."""
    start, step = round(driving.scan_start, DECIMALS), round(driving.scan_step, DECIMALS)
    bearings = start + step * np.arange(driving.scan_count)
    found = []
    for t, pose in zip(driven.t[:: driving.scan_every], driven.poses[:: driving.scan_every], strict=True):
        ranges = building.ranges(pose, bearings, sensors.scan_range)
        ranges = ranges + rng.normal(size=len(ranges)) * sensors.scan_sigma
        seen = (round(r, DECIMALS) if 0 <= r <= sensors.scan_range else None for r in ranges.tolist())
        found.append(Scan(round(float(t), DECIMALS), start, step, tuple(seen)))
    return found
