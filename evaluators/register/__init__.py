"""One registration of two clouds, step by step."""
