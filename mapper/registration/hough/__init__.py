"""Registration without a first guess by Hough voting (Nagy, Gálai & Benedek 2016).

The published steps, each in the module of its name; ours are marked with a star:

1. ``ground``*: the level frame of a tilted scan, by the plane under the sensor.
2. ``ground`` (§3.1): the ground is found on a grid; what stands on it are obstacles.
3. ``description`` (§3.2): the centres of objects, or of occupied cells.
4. ``voting`` (§3.3, alg. 1): every pair of centres votes in the accumulator A[dx, dy, α].
5. ``refinement``*: the accumulator's peaks are moved to most overlap, and ground is put on ground.
6. ``aligner``*: candidates are scored by the free-space check of both scans.
7. ``refinement`` (§3.4): the best are refined by NDT, or by GICP*; the answer is accepted or refused.

``description`` holds steps 1 to 3 of one scan, ``aligner`` runs them all.
"""
