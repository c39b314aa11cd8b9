"""Dead reckoning between keyframes: relative pose, its covariance and its derivatives, one odometry step at a time.

Plain floats and no arrays: this runs at every odometry event, all else in the mapper at keyframes only.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..arms import wrap
from ..logs import Odometry, Sensors

Array = NDArray[np.float64]

#: The systematic errors that are states, in this order: share of distances, share of turns, curvature [rad/m], gyro
#: bias [rad/s]. What is measured is right after ``distance (1 + scale)``, ``turn (1 + turn) + curve distance``,
#: ``rate - bias``.
SYSTEMATIC = ("scale", "turn", "curve", "bias")
#: Wheels slip sideways by a little; without it, straight motion has a singular covariance [m^2 per m].
_SLIP = 1e-6
#: What is not known of a step that is a jump: position [m] and heading [rad], and speed [m/s] for as long as it took.
_JUMP = (0.3, 0.2, 0.5)
#: Steps [m] below this are never jumps, however short their time.
_NO_JUMP = 0.5


class Motion(msgspec.Struct, frozen=True):
    """The motion from one keyframe to the next.

    ``pose``: the later one seen from the earlier [m, m, rad], with the systematic errors at ``at``; ``jacobian``: its
    derivatives by turn scale, curvature and bias, (x, y, theta) of each (by the scale it is x, y over 1 + scale);
    ``covariance``: xx, xy, xt, yy, yt, tt. ``length`` [m]: the way travelled.
    """

    pose: tuple[float, float, float]
    at: tuple[float, float, float, float]
    jacobian: tuple[float, float, float, float, float, float, float, float, float]
    covariance: tuple[float, float, float, float, float, float]
    length: float

    def by_systematic(self) -> Array:
        """Derivatives (3, 4) of the pose by `SYSTEMATIC`."""
        j = self.jacobian
        x, y, _ = self.pose
        share = 1 + self.at[0]
        return np.array(
            [[x / share, j[0], j[3], j[6]], [y / share, j[1], j[4], j[7]], [0.0, j[2], j[5], j[8]]],
        )

    def covariance_matrix(self) -> Array:
        """Covariance (3, 3) of the pose."""
        xx, xy, xt, yy, yt, tt = self.covariance
        return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


class DeadReckoning(msgspec.Struct):
    """The motion since the last keyframe, integrated step by step.

    ``x``, ``y`` [m], ``theta`` [rad, not wrapped]: the robot seen from the keyframe. ``length`` [m]: the way since it.
    """

    # what is known of the robot: variances per metre, per radian, per second
    per_metre: float
    turn_per_metre: float
    turn_per_radian: float
    gyro_per_second: float
    max_speed: float
    # systematic errors as they are taken for now
    scale: float = 0.0
    turn: float = 0.0
    curve: float = 0.0
    bias: float = 0.0
    # the last odometry and gyro readings
    last: Odometry | None = None
    gyro_t: float | None = None
    gyro_rate: float = 0.0
    gyro_turn: float = 0.0
    gyro_time: float = 0.0
    jumps: int = 0
    # the motion since the keyframe
    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    length: float = 0.0
    cxx: float = 0.0
    cxy: float = 0.0
    cxt: float = 0.0
    cyy: float = 0.0
    cyt: float = 0.0
    ctt: float = 0.0
    jxk: float = 0.0
    jyk: float = 0.0
    jtk: float = 0.0
    jxc: float = 0.0
    jyc: float = 0.0
    jtc: float = 0.0
    jxb: float = 0.0
    jyb: float = 0.0
    jtb: float = 0.0

    @classmethod
    def of(cls, sensors: Sensors, max_speed: float) -> DeadReckoning:
        """Standing still, with the variances that the sensors are known to have."""
        gyro = sensors.gyro_sigma
        return cls(
            sensors.odometry_distance_sigma**2,
            sensors.odometry_turn_sigma**2,
            sensors.odometry_turn_sigma_per_turn**2,
            -1.0 if gyro is None else gyro**2,
            max_speed,
        )

    def gyro(self, t: float, rate: float) -> None:
        """A gyro reading [rad/s] at time ``t`` [s]; the one before held until now."""
        if self.gyro_t is not None:
            if t < self.gyro_t:
                return
            self.gyro_turn += self.gyro_rate * (t - self.gyro_t)
            self.gyro_time += t - self.gyro_t
        self.gyro_t = t
        self.gyro_rate = rate

    def odometry(self, event: Odometry) -> None:
        """One odometry event; the first one only says where the odometry's own frame is."""
        last = self.last
        self.last = event
        if last is None:
            self._gyro_until(event.t)
            return
        dt = event.t - last.t
        turned = event.theta - last.theta
        if not -pi < turned <= pi:
            turned = wrap(turned)
        gx, gy = event.x - last.x, event.y - last.y
        if gx == 0.0 and gy == 0.0 and turned == 0.0:
            # standing: the wheels say so for sure, and a gyro's drift says nothing
            self._gyro_until(event.t)
            return
        step = hypot(gx, gy)
        if step > _NO_JUMP and step > self.max_speed * dt:
            self._jump(event.t, dt)
            return
        middle = last.theta + turned / 2
        c, s = cos(middle), sin(middle)
        # seen from the robot, half way through its turn
        forward, left = c * gx + s * gy, c * gy - s * gx
        share = 1.0 + self.scale
        variance = self.turn_per_metre * step + 1e-14
        # a turn that is no more than the noise of a straight step adds none of its own
        if turned * turned > 4 * variance:
            variance += self.turn_per_radian * (turned if turned > 0 else -turned)
        true_turn = turned * (1.0 + self.turn) + self.curve * forward
        wheel_share = 1.0
        gyro_share_time = 0.0
        if self.gyro_per_second >= 0.0 and self.gyro_t is not None:
            self._advance_gyro(event.t)
            time = self.gyro_time
            if time > 0.0 and time >= 0.5 * dt:
                of_gyro = self.gyro_per_second * time + 1e-14
                # a gyro that covers a part of the step leaves the rest to the wheels
                wheel_share = of_gyro / (of_gyro + variance)
                gyro_share_time = (1.0 - wheel_share) * time
                true_turn = wheel_share * true_turn + (1.0 - wheel_share) * (self.gyro_turn - self.bias * time)
                variance *= wheel_share
            self.gyro_turn = self.gyro_time = 0.0
        self._step(
            forward * share,
            left * share,
            step,
            true_turn,
            variance,
            wheel_share * turned,
            wheel_share * forward,
            gyro_share_time,
        )

    def _step(
        self, forward: float, left: float, length: float, turn: float, variance: float, jk: float, jc: float, jb: float
    ) -> None:
        """Go ``forward`` and ``left`` [m] half way through a ``turn`` [rad] of that variance [rad^2].

        ``jk``, ``jc``, ``-jb``: derivatives of the turn by turn scale, curvature and bias.
        """
        middle = self.theta + turn / 2
        c, s = cos(middle), sin(middle)
        dx, dy = c * forward - s * left, s * forward + c * left
        # errors of the heading so far swing the step
        ctt, cxt, cyt = self.ctt, self.cxt, self.cyt
        along = self.per_metre * length
        side = _SLIP * length
        half = variance / 2
        self.cxx += dy * (dy * (ctt + half / 2) - 2 * cxt) + along * c * c + side * s * s
        self.cxy += dx * cxt - dy * cyt - dx * dy * (ctt + half / 2) + (along - side) * c * s
        self.cyy += dx * (dx * (ctt + half / 2) + 2 * cyt) + along * s * s + side * c * c
        self.cxt = cxt - dy * (ctt + half)
        self.cyt = cyt + dx * (ctt + half)
        self.ctt = ctt + variance
        jt = self.jtk + jk / 2
        self.jxk -= dy * jt
        self.jyk += dx * jt
        self.jtk += jk
        jt = self.jtc + jc / 2
        self.jxc -= dy * jt
        self.jyc += dx * jt
        self.jtc += jc
        if jb != 0.0:
            jt = self.jtb - jb / 2
            self.jxb -= dy * jt
            self.jyb += dx * jt
            self.jtb -= jb
        self.x += dx
        self.y += dy
        self.theta += turn
        self.length += length

    def _jump(self, t: float, dt: float) -> None:
        """The odometry began anew: where the robot went meanwhile is not known, but it can't be far."""
        self.jumps += 1
        self._gyro_until(t)
        away = _JUMP[0] + _JUMP[2] * max(0.0, dt)
        self.cxx += away * away
        self.cyy += away * away
        self.ctt += _JUMP[1] ** 2
        self.length += away

    def _advance_gyro(self, t: float) -> None:
        assert self.gyro_t is not None
        if t > self.gyro_t:
            self.gyro_turn += self.gyro_rate * (t - self.gyro_t)
            self.gyro_time += t - self.gyro_t
            self.gyro_t = t

    def _gyro_until(self, t: float) -> None:
        """Forget what the gyro said until time ``t``."""
        if self.gyro_t is not None:
            self.gyro_t = max(t, self.gyro_t)
        self.gyro_turn = self.gyro_time = 0.0

    def motion(self) -> Motion:
        """The motion since the keyframe as a value."""
        return Motion(
            (self.x, self.y, self.theta),
            (self.scale, self.turn, self.curve, self.bias),
            (self.jxk, self.jyk, self.jtk, self.jxc, self.jyc, self.jtc, self.jxb, self.jyb, self.jtb),
            (self.cxx + 1e-9, self.cxy, self.cxt, self.cyy + 1e-9, self.cyt, self.ctt + 1e-9),
            self.length,
        )

    def restart(self, scale: float, turn: float, curve: float, bias: float) -> None:
        """Here is the next keyframe; from now on these systematic errors are taken for the right ones."""
        self.scale, self.turn, self.curve, self.bias = scale, turn, curve, bias
        self.x = self.y = self.theta = self.length = 0.0
        self.cxx = self.cxy = self.cxt = self.cyy = self.cyt = self.ctt = 0.0
        self.jxk = self.jyk = self.jtk = self.jxc = self.jyc = self.jtc = self.jxb = self.jyb = self.jtb = 0.0


def seen_now(then: Odometry, now: Odometry, u: float, v: float) -> tuple[float, float, float]:
    """A point that was ahead ``u`` and left ``v`` [m] of the robot ``then``, as seen ``now``.

    Third is what to add to bearings of then, to have them now.
    """
    c, s = cos(then.theta), sin(then.theta)
    gx, gy = then.x + c * u - s * v - now.x, then.y + s * u + c * v - now.y
    c, s = cos(now.theta), sin(now.theta)
    return c * gx + s * gy, c * gy - s * gx, wrap(then.theta - now.theta)
