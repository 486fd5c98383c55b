"""Place recognition: by the visual words of images, and by the heights around a scanner."""
