"""Places recognised by the visual words that their images share."""
