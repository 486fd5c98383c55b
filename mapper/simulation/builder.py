"""Builder of the flat: collects boxes and the texture of each face, in mip-maps (Williams 1983)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.simulation.boxes import Boxes

LEVELS = 8
FACES = 6
"""−x, +x, −y, +y, −z, +z in the box's own axes; face 2·axis + side."""

_SHADE_BELOW, _SHADE_UPRIGHT, _SHADE_ABOVE = 0.78, 0.86, 1.0


class Atlas(NamedTuple):
    """Textures and their successive halvings, as plain arrays for compiled code.

    Attributes:
        texels: (T, 3) uint8 RGB, level after level, row after row.
        starts: (N, LEVELS) int64: where each level's first texel lies.
        heights_px: (N, LEVELS) int64.
        widths_px: (N, LEVELS) int64.
    """

    texels: NDArray[np.uint8]
    starts: NDArray[np.int64]
    heights_px: NDArray[np.int64]
    widths_px: NDArray[np.int64]


class Faces(NamedTuple):
    """Affine texture maps of N boxes' faces: texel = scale · metres from the face's top left + offset.

    Attributes:
        textures: (N, 6) int64 index in the atlas.
        scales: (N, 6, 2) float64 texels per metre along columns and rows.
        offsets: (N, 6, 2) float64 texels.
        shades: (N, 6) float64 brightness.
    """

    textures: NDArray[np.int64]
    scales: Array
    offsets: Array
    shades: Array


def build_atlas(images: Sequence[Image]) -> Atlas:
    """Return the mip-maps of (H, W, 3) uint8 images; each level averages 2×2 texels of the one before."""
    parts: list[NDArray[np.uint8]] = []
    starts, heights, widths = (np.zeros((len(images), LEVELS), dtype=np.int64) for _ in range(3))
    start = 0
    for i, image in enumerate(images):
        level: Image = image
        for k in range(LEVELS):
            if k > 0:
                size = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
                level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            starts[i, k], heights[i, k], widths[i, k] = start, *level.shape[:2]
            parts.append(level.reshape(-1, 3))
            start += level.shape[0] * level.shape[1]
    return Atlas(np.concatenate(parts), starts, heights, widths)


@dataclass(frozen=True, slots=True)
class Light:
    """Light from above and a little from one side.

    Attributes:
        yaw_rad: Direction that it comes from.
        swing: Relative excess of that side's brightness over the mean of both sides.
        gain: Brightness of all.
    """

    yaw_rad: float = 0.9
    swing: float = 0.10
    gain: float = 1.0


DAYLIGHT = Light()


@dataclass(frozen=True, slots=True)
class Skin:
    """Placement of a texture on a face.

    Attributes:
        texture: Index in the atlas.
        px_per_m: Scale; None stretches the image over the whole face.
        offset_m: Position of the face's top left corner in the image, columns and rows, metres.
    """

    texture: int
    px_per_m: float | None = None
    offset_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Place:
    """Frame of a piece of furniture: its middle on the floor, and its turn."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def world(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the world x and y of a point of the piece's frame."""
        cosine, sine = float(np.cos(self.yaw_rad)), float(np.sin(self.yaw_rad))
        return self.x_m + cosine * x_m - sine * y_m, self.y_m + sine * x_m + cosine * y_m


ORIGIN = Place()


@dataclass(slots=True)
class Builder:
    """Builder of the flat's boxes and faces."""

    textures: list[Image] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    skins: list[tuple[Skin, ...]] = field(default_factory=list)

    def texture(self, image: Image) -> int:
        """Add an image and return its index."""
        self.textures.append(image)
        return len(self.textures) - 1

    def box(
        self,
        name: str,
        place: Place,
        *,
        low: Sequence[float],
        size: Sequence[float],
        skin: Skin,
        faces: dict[int, Skin] | None = None,
        turn_rad: float = 0.0,
    ) -> None:
        """Add one box.

        Args:
            name: Name of the thing that it is part of.
            place: Frame in which ``low`` is given.
            low: The corner with the smallest x, y, z, metres.
            size: Extent along x, y, z, metres.
            skin: Look of every face that ``faces`` does not name.
            faces: Other looks, by face number.
            turn_rad: Turn of this box about its own vertical, besides the place's.
        """
        cx, cy = place.world(low[0] + size[0] / 2.0, low[1] + size[1] / 2.0)
        halves = tuple(extent / 2.0 for extent in size)
        self.names.append(name)
        self.rows.append((cx, cy, low[2] + halves[2], *halves, place.yaw_rad + turn_rad))
        self.skins.append(tuple((faces or {}).get(face, skin) for face in range(FACES)))

    def repeat(self, numbers: Sequence[int], *, shift_m: float) -> None:
        """Add copies of boxes, moved along x."""
        for i in numbers:
            x, *rest = self.rows[i]
            self.names.append(self.names[i])
            self.rows.append((x + shift_m, *rest))
            self.skins.append(self.skins[i])

    def boxes(self) -> Boxes:
        """Return the solids."""
        table = np.array(self.rows, dtype=np.float64).reshape(-1, 7)
        return Boxes(tuple(self.names), table[:, :3].copy(), table[:, 3:6].copy(), table[:, 6].copy())

    def faces(self, light: Light = DAYLIGHT) -> Faces:
        """Return the texture maps, in the order of the solids."""
        n = len(self.names)
        textures = np.zeros((n, FACES), dtype=np.int64)
        scales, offsets = np.zeros((n, FACES, 2)), np.zeros((n, FACES, 2))
        for i, (row, skins) in enumerate(zip(self.rows, self.skins, strict=True)):
            for face, skin in enumerate(skins):
                textures[i, face] = skin.texture
                size_m = 2.0 * np.array(face_halves(np.array(row[3:6]), face))
                if skin.px_per_m is None:
                    height, width = self.textures[skin.texture].shape[:2]
                    scales[i, face] = np.array([width, height]) / size_m
                else:
                    scales[i, face] = skin.px_per_m
                    offsets[i, face] = skin.px_per_m * np.array(skin.offset_m)
        return Faces(textures, scales, offsets, _shades(np.array(self.rows)[:, 6], light))


def face_halves(halves: Array, face: int) -> tuple[float, float]:
    """Return half a face's extent along its texture's columns and rows, metres."""
    axis = face // 2
    return (halves[1] if axis == 0 else halves[0]), (halves[1] if axis == 2 else halves[2])


def _shades(yaws_rad: Array, light: Light) -> Array:
    shades = np.empty((len(yaws_rad), FACES))
    for face, normal_rad in enumerate((np.pi, 0.0, -np.pi / 2, np.pi / 2)):
        shades[:, face] = _SHADE_UPRIGHT + light.swing * np.cos(yaws_rad + normal_rad - light.yaw_rad)
    shades[:, 4], shades[:, 5] = _SHADE_BELOW, _SHADE_ABOVE
    return light.gain * shades
