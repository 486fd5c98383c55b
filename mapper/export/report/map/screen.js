// Uniform of every material that draws in pixels.

/** Pixels drawn per CSS pixel. */
export const ratio = { value: 1 };
