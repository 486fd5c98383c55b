"""Writers of a run's products: files for other programs, pictures, recordings, reports."""
