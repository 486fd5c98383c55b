// Files that the page saves.

/** Save text or bytes as a file. */
export function save(name, ...parts) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** The points of a set with the colours that are shown, as binary PLY in metres. */
export function plyOf(set) {
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${set.count}\n${["x", "y", "z"].map((axis) => `property float ${axis}\n`).join("")}`
    + `${["red", "green", "blue"].map((channel) => `property uchar ${channel}\n`).join("")}end_header\n`;
  const bytes = new DataView(new ArrayBuffer(15 * set.count));
  for (let i = 0; i < set.count; i++) {
    for (let axis = 0; axis < 3; axis++) {
      bytes.setFloat32(15 * i + 4 * axis, set.low[axis] + set.step * set.places[4 * i + axis], true);
      bytes.setUint8(15 * i + 12 + axis, set.shades[4 * i + axis]);
    }
  }
  return [header, bytes];
}
