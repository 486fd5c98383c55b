// How many of the points are drawn while the eye moves: as many as keep 30 frames a second.

const FRAME_MS = 33;
const SLOW_MS = 1.2 * FRAME_MS, FAST_MS = 0.8 * FRAME_MS; // between these the share stays: browsers wait for the screen
const LARGEST_STEP = 4; // by which the share falls at once; it grows by little, for points are not all of a frame's time
const GROWTH = 1.15;
const FEWEST_POINTS = 15_000;

export class Budget {
  /** Share of the points, above 0 to 1. */
  share = 1;

  /** Learn from a frame. @param share Of its points. @param took_ms Until it was drawn. @param points In all. */
  learn(share, took_ms, points) {
    if (took_ms > SLOW_MS) this.share = Math.min(this.share, share * Math.max(1 / LARGEST_STEP, FRAME_MS / took_ms));
    else if (took_ms < FAST_MS && share >= this.share) this.share = share * GROWTH;
    this.share = Math.min(1, Math.max(this.share, Math.min(1, FEWEST_POINTS / Math.max(points, 1))));
  }
}
