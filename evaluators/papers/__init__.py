"""The tables of the three papers, measured again."""
