"""The middle line of a road, and places along it.

A place on a street is (s, d): metres along the road's middle and metres to the right of it.
"""

import numpy as np

STEP = 0.25  # metres between the stored points of a track
SMOOTHING = 3.0  # metres; a driver turns the wheel, the curvature does not jump
SHARP, SHORT = 60, 25  # a piece that turns so many degrees in so few metres is a corner


class Track:
    """The middle line of a road, its points stored every STEP metres.

    s, x, z, heading, curvature: (n,), metres, radians to the right of z, and 1/m, positive to the right.
    corners: s at which sharp turns begin. closed: whether it ends where it starts, so that s goes on round it.
    """

    def __init__(self, pieces, start, stop, origin=(0.0, 0.0), heading=0.0, repeat=True, closed=False):
        """pieces: (metres, degrees to the right) each, from s = 0, repeated up to `stop` or followed by a straight.

        start, stop: s of both ends, start <= 0; before s = 0 the road is straight. origin, heading: at s = 0.
        """
        self.s = start + STEP * np.arange(int(np.ceil((stop - start) / STEP)) + 1)
        self.corners = []
        self.closed = closed
        curvature = np.zeros(len(self.s))
        where = 0.0
        while pieces and where < stop:
            for length, degrees in pieces:
                curvature[(self.s >= where) & (self.s < where + length)] = np.radians(degrees) / length
                if abs(degrees) >= SHARP and length < SHORT:
                    self.corners.append(where)
                where += length
            if not repeat:
                break
        window = int(SMOOTHING / STEP)
        padded = np.pad(curvature, (window // 2, window - 1 - window // 2), mode="edge")
        total = np.concatenate([[0.0], np.cumsum(padded)])
        self.curvature = (total[window:] - total[:-window]) / window
        # The heading is the integral of the curvature, the place that of the heading's direction (both by trapezia).
        first = int(round(-start / STEP))
        turn = np.concatenate([[0.0], np.cumsum(0.5 * (self.curvature[1:] + self.curvature[:-1])) * STEP])
        self.heading = heading + turn - turn[first]
        middle = 0.5 * (self.heading[1:] + self.heading[:-1])
        x = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * STEP])
        z = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * STEP])
        self.x, self.z = origin[0] + x - x[first], origin[1] + z - z[first]

    def along(self, s):
        """s itself, or on a closed track the same place between both ends."""
        return s % self.s[-1] if self.closed else s

    def at(self, s, d=0.0):
        """(x, z, heading) of places (s, d), numbers or arrays of one shape."""
        s = self.along(s)
        heading = np.interp(s, self.s, self.heading)
        x = np.interp(s, self.s, self.x) + d * np.cos(heading)
        z = np.interp(s, self.s, self.z) - d * np.sin(heading)
        return x, z, heading
