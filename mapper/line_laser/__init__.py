"""A sensor of one laser line and one camera: from the stripe in the image to a map."""
