"""Registration without a first guess by Hough voting (Nagy, Gálai & Benedek 2016).

The published steps, each in the module named after it:

1. ``ground_removal`` (§3.1): the ground is found on a grid and removed. ``ground_plane``, which is ours,
   levels scans of tilted sensors before.
2. ``object_detection`` (§3.2): what remains is divided into objects, or into occupied cells; each gives a
centre.
3. ``voting`` (§3.3, alg. 1): every pair of centres votes for a planar motion in the accumulator A[dx, dy, α].
4. ``aligner``: the motions at the accumulator's peaks are verified, which is ours, and refined (§3.4).
"""
