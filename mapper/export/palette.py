"""The colours that every picture and viewer file shares, as (R, G, B) bytes."""

from mapper.graph.model import Origin

Rgb = tuple[int, int, int]

ESTIMATE: Rgb = (214, 69, 37)
DOUBTFUL: Rgb = (240, 176, 0)
TRUTH: Rgb = (45, 108, 178)
START: Rgb = (38, 145, 87)
END: Rgb = (30, 33, 41)
PLAN: Rgb = (124, 58, 196)
ACCEPTED: Rgb = (196, 40, 140)
REJECTED: Rgb = (176, 182, 192)
FACTORS: dict[Origin, Rgb] = {
    "odometry": (140, 146, 158),
    "loop": (196, 40, 140),
    "wheel": (224, 160, 32),
}
APPEARED: Rgb = (0, 114, 178)
VANISHED: Rgb = (213, 94, 0)
NOT_SEEN_AGAIN: Rgb = (150, 156, 166)
UNKNOWN_CELL: Rgb = (214, 218, 224)
FREE_CELL: Rgb = (255, 255, 255)
OCCUPIED_CELL: Rgb = (35, 41, 54)
