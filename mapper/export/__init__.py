"""Writers of the products users take away."""
