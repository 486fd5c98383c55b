"""Bundle adjustment, and the residuals that it leaves."""
